"""One observation from a file, or from pixels and a header in memory: the only place where heliopsf understands an image.

A deconvolution, a transit, a flare, a measurement of arms and the comparison of a product all read through this module, so a
file has one mask, one unit and one saturation level everywhere.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.gain import saturation_for
from psfcore.fits.hdus import read_pixels
from psfcore.fits.header import (
    IMAGE,
    FitsLimits,
    HeaderSummary,
    Neighbour,
    check_not_deconvolved,
    content_of,
    known_instrument,
    optional_exposure_s,
    read_contents,
    read_summary,
)
from psfcore.fits.lost import check_exposure, count_of_lost, lost_pixels
from psfcore.fits.saturation import with_saturation
from psfcore.fits.units import check_linear, unit_of
from psfcore.image import Image, MaskBit
from psfcore.instruments.model import load_instrument

# Names of images that describe another image: its mask, its errors, the quality of its pixels.
_PLANES = ("MASK", "UNCERT", "UNCERTAINTY", "DQF", "DQ", "ERR", "ERROR", "QUALITY", "VARIANCE")
_FULL_SCALES = tuple(2**bits - 1 for bits in (8, 10, 12, 14, 15, 16))


def read_observation(
    path: str | Path, limits: FitsLimits, *, saturation_dn: float | None = None, hdu: int | None = None
) -> Image:
    """Read an image of a file and mask its unusable pixels.

    saturation_dn: the saturation level in DN of one exposure; None: the level is taken from the header or the
    instrument file, and the pixels are tested, see `psfcore.fits.saturation`. hdu: number of the HDU; None: the first
    2-D image. Raises HeaderError for an unusable header; DataError "unreadable-pixels", and the errors of
    `observation_of`.
    """
    summary, neighbours = read_contents(path, limits, hdu=hdu, whole=True)
    pixels, header = read_pixels(path, summary, limits)
    ours = {one.name.upper(): one for one in neighbours if one.shape == summary.shape}
    if summary.content == IMAGE and "MASK" in ours:  # as CCDData writes it
        excluded, _ = read_pixels(path, read_summary(path, limits, hdu=ours["MASK"].hdu), limits)
        pixels[excluded != 0] = np.nan
    image = observation_of(pixels, header, saturation_dn=saturation_dn, stored_as_integer=summary.bitpix > 0)
    if hdu is not None or summary.content != IMAGE:
        return image
    return image.warned(_unused_images(summary, neighbours))


def _unused_images(summary: HeaderSummary, neighbours: list[Neighbour]) -> dict[str, str]:
    """The warning about images of a file that are not used."""
    others = [
        f"{one.hdu} ({one.name})" if one.name else str(one.hdu)
        for one in neighbours
        if one.name.upper() not in _PLANES
    ]
    if not others:
        return {}
    return {
        "several-images": f"the file has {len(others) + 1} images; HDU {summary.hdu} is used. --hdu (hdu in a request) takes "
        f"another one: {', '.join(others[:5])}{', ...' if len(others) > 5 else ''}"
    }


def check_exposure_of_sun(header: Header) -> None:
    """Raise DataError if the header says that a deconvolution of the image makes no sense.

    Codes: "already-deconvolved", "psf-as-image", "not-an-exposure" (a dark, an LED frame, ...), and "bad-unit" for pixels that
    are not proportional to the light.
    """
    check_not_deconvolved(content_of(header))
    check_exposure(header)
    check_linear(header)


def observation_of(
    pixels: NDArray[np.float64],
    header: Header,
    *,
    saturation_dn: float | None = None,
    stored_as_integer: bool = False,
) -> Image:
    """The image of pixels [y, x] and a header, with its unusable pixels masked.

    stored_as_integer: whether the pixels are the numbers of an A/D converter, without a calibration. Raises DataError
    "not-2d", "too-small", "no-exposure", "saturation-unit", "all-nan", "all-saturated", "no-signal".
    """
    lost = lost_pixels(pixels, header)
    if lost is not None:
        pixels = np.where(lost, np.nan, pixels)
    mask = np.where(np.isfinite(pixels), np.uint8(0), np.uint8(MaskBit.NONFINITE))
    warnings = {}
    if lost is not None:
        mask[lost] |= int(MaskBit.LOST)
        count, stated = int(np.count_nonzero(lost)), count_of_lost(header)
        warnings["lost"] = (
            f"{count} pixels were lost on the way to the ground; they are not used, and QUALITY marks them"
            + (f" (the header counts {stated})" if stated not in (0, count) else "")
        )
    image = Image(pixels, mask, header, unit_of(header).text, optional_exposure_s(header), warnings=warnings)
    name = known_instrument(header)
    of_instrument = None if name is None else saturation_for(load_instrument(name), header)
    image = with_saturation(image, requested_dn=saturation_dn, instrument_dn=of_instrument)
    _check_signal(image, stored_as_integer=stored_as_integer)
    return image


def _check_signal(image: Image, *, stored_as_integer: bool) -> None:
    valid = image.valid
    if not valid.any():
        finite = image.finite
        if not finite.any():
            raise DataError(
                "all-nan", "expected finite pixels; got only NaN, infinite or BLANK: use another image"
            )
        level = image.pixels[finite].min()
        raise DataError(
            "all-saturated",
            f"expected pixels below saturation; all finite pixels are at {level:g} or above: check the level",
        )
    values = image.pixels if valid.all() else image.pixels[valid]
    smallest, largest = float(values.min()), float(values.max())
    if smallest == largest <= 0:
        raise DataError("no-signal", f"expected light; all pixels are {largest:g}: use another image")
    if smallest == largest and stored_as_integer and largest in _FULL_SCALES:
        text = f"all pixels are {largest:g}, the largest value of an A/D converter"
        message = f"expected pixels below saturation; {text}: use another image"
        raise DataError("all-saturated", message)
