"""The noise of the camera of an image: published for its telescope, or measured in the image (photon transfer).

The pixels are divided into classes of equal brightness D, the mean of 3 x 3 pixels. The variance V of a pixel follows
from the second differences in a class (`psfcore.deconvolve.assess.artefacts`), whose noise is independent of that of
the mean. The figures of the camera follow from

    V = g D + r^2                                                                          Eq. (1)

g is the median of the slopes between all pairs of classes (Theil 1950, Indag. Math. 12, 85), and r^2 the median of V -
g D of the fainter half of the classes, so a few classes with much structure change neither. Their uncertainties are
those of the mean of the four quarters of the image.

Structure on the scale of a pixel raises V. Noise that neighbouring pixels share lowers it: in images of the EUV
channels of AIA, whose charge spreads over several pixels, the measured g is 0.4 of the published one. The published
figures are used, because they also hold for means of pixels; for a single pixel they are an upper limit.

| symbol | name | unit |
|---|---|---|
| D | brightness of a pixel in one exposure | DN |
| V | its variance | DN^2 |
| g, r | photon_gain_dn, read_noise_dn | DN |
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, uniform_filter
from scipy.special import ndtri

from psfcore.arrays import Flags
from psfcore.deconvolve.assess.artefacts import classes_of, second_differences
from psfcore.deconvolve.assess.compared import filled
from psfcore.deconvolve.assess.ranks import Portions
from psfcore.errors import DataError
from psfcore.fits.cards import optional_text
from psfcore.fits.header import known_instrument
from psfcore.fits.units import dn_per_unit, parse_unit
from psfcore.image import Image
from psfcore.instruments.model import load_instrument
from psfcore.noise import Noise

_AIA = "SolarSoft, aia_V3_error_table.txt; Boerner et al. 2012, Solar Physics 275, 41, Table 6"
# Photon gain (DN per photon) and read noise (DN rms) of images that are not binned.
PUBLISHED = {
    "aia_94": (1.975, 1.14),
    "aia_131": (1.473, 1.18),
    "aia_171": (1.122, 1.15),
    "aia_193": (0.962, 1.20),
    "aia_211": (0.880, 1.20),
    "aia_304": (0.611, 1.14),
    "aia_335": (0.576, 1.18),
}
_BLOCK_ROWS, _MOST_PIXELS = 64, 2**20
_LOWEST = 0.75
# Mean of this share of the absolute values of a normal distribution with variance 1.
_LOWEST_MEAN = math.sqrt(2 / math.pi) * -math.expm1(-(ndtri((1 + _LOWEST) / 2) ** 2) / 2) / _LOWEST

Plane = NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class CameraNoise(Noise):
    """The noise of a camera, and where its figures come from.

    Attributes
    ----------
    basis
        A text with the source.
    sigma
        Standard errors of photon gain and read noise (DN), if they were measured.
    """

    source: Literal["given", "published", "measured", "uncertainty"]
    basis: str
    sigma: tuple[float, float] | None = None

    def __str__(self) -> str:
        figures = (self.photon_gain_dn, self.read_noise_dn)
        texts = [f"{value:.4g}" for value in figures]
        if self.sigma is not None:
            texts = [f"{value:.3g} +- {error:.1g}" for value, error in zip(figures, self.sigma, strict=True)]
        return f"photon gain {texts[0]} DN, read noise {texts[1]} DN, {self.source} ({self.basis})"

    def as_json(self) -> dict[str, object]:
        """The figures and their source."""
        figures = {"photon_gain_dn": self.photon_gain_dn, "read_noise_dn": self.read_noise_dn}
        return {**figures, "source": self.source, "sigma": self.sigma, "text": str(self)}


def camera_noise(image: Image, given: Noise | None, *, binning: int) -> CameraNoise:
    """The noise of an image: the given noise, or else the published noise, or else the measured noise.

    Raises DataError "no-noise-figures" if no noise is known and the pixels show none, and "no-exposure".

    Parameters
    ----------
    binning
        Binning of the image: one of its pixels is the mean of binning x binning pixels of the camera.
    """
    if isinstance(given, CameraNoise):
        return given
    if given is not None:
        return CameraNoise(
            given.photon_gain_dn, given.read_noise_dn, source="given", basis="given by the user"
        )
    name = known_instrument(image.header)
    if name is None or parse_unit(image.unit).kind == "other":
        return measured_noise(image)
    figures, basis = PUBLISHED.get(name), _AIA
    mode = load_instrument(name).gain_mode(optional_text(image.header, "GAINCOMB"))
    if mode is not None and mode.photon_gain_dn is not None and mode.read_noise_dn is not None:
        figures, basis = (mode.photon_gain_dn, mode.read_noise_dn), f"instrument file {name} ({mode.basis})"
    if figures is None:
        return measured_noise(image)
    gain, read = figures[0] / binning**2, figures[1] / binning
    return CameraNoise(gain, read, source="published", basis=basis)


def measured_noise(image: Image, sigma: Plane | None = None) -> CameraNoise:
    """The noise that the pixels show, Eq. (1).

    Raises DataError "no-noise-figures", and "no-exposure" for a rate without an exposure time.

    Parameters
    ----------
    sigma
        Standard deviation [y, x] of each pixel, if it is known.
    """
    dn = dn_per_unit(image)
    # Blocks of rows from all parts of a large image are enough.
    blocks = np.arange(len(image.pixels)) // _BLOCK_ROWS
    rows = blocks % -(-image.pixels.size // _MOST_PIXELS) == 0
    # A second difference needs all nine pixels.
    counted = binary_erosion(image.valid[rows], np.ones((3, 3), dtype=np.bool_), border_value=True)
    pixels, errors = filled(image.pixels[rows]), None if sigma is None else sigma[rows]
    ny, nx = (side // 2 for side in counted.shape)
    quarters = (np.s_[:ny, :nx], np.s_[:ny, nx:], np.s_[ny:, :nx], np.s_[ny:, nx:])
    whole, *parts = (
        _transfer(pixels[box], counted[box], None if errors is None else errors[box])
        for box in (np.s_[:, :], *quarters)
    )
    if whole is None or not any(whole):
        raise DataError(
            "no-noise-figures",
            "expected noise figures, or pixels whose scatter shows them; got neither: give photon gain and read noise "
            "(noise=(GAIN, READ) in Python, --noise GAIN READ on the command line, noise in a request)",
        )
    errors = np.std([part for part in parts if part is not None] or [whole], axis=0) / 2
    return CameraNoise(
        whole[0] * dn,
        whole[1] * dn,
        source="measured" if sigma is None else "uncertainty",
        basis="photon transfer in the image" if sigma is None else "the uncertainty of the image",
        sigma=(float(errors[0]) * dn, float(errors[1]) * dn),
    )


def _mean_of_lowest(values: Plane) -> float:
    """The mean of the lowest three quarters of the values, which few large ones do not change."""
    count = max(1, int(_LOWEST * values.size))
    return float(np.partition(values, count - 1)[:count].mean())


def _transfer(pixels: Plane, counted: Flags, sigma: Plane | None) -> tuple[float, float] | None:
    """G and r of Eq. (1) in the unit of the pixels; None for too few pixels."""
    classes = classes_of(Portions.of(uniform_filter(pixels, 3)[counted]))
    if not classes.centres.size:
        return None
    members = [classes.numbers == number for number in range(classes.centres.size)]
    if sigma is None:
        differences = second_differences(pixels, counted)
        levels = [_mean_of_lowest(differences[part]) / _LOWEST_MEAN for part in members]
    else:
        levels = [float(np.median(sigma[counted][part])) for part in members]
    brightness, variance = np.asarray(classes.centres, np.float64), np.array(levels) ** 2
    first, second = np.triu_indices(len(brightness), 1)
    steps = brightness[second] - brightness[first]
    rising = steps > 0
    slopes = (variance[second] - variance[first])[rising] / steps[rising]
    gain = max(0.0, float(np.median(slopes))) if rising.any() else 0.0
    read = float(np.median((variance - gain * brightness)[: len(brightness) // 2]))
    if read < 0:  # all of it is photon noise
        lit = brightness > 0
        return float(np.median(variance[lit] / brightness[lit])), 0.0
    return gain, float(np.sqrt(read))
