"""Adapts a PSF to the pixels of an image, which may be binned, turned or a cut-out.

A binned pixel is the mean of n x n pixels. For a scene that is constant within binned pixels, the binned PSF is

    K[M] = sum over d of t(d) h[n M + d],   t(d) = (1 - |d| / n) for |d| < n       Eq. (1), on each axis

t is the convolution of two boxes of n pixels: one box is a binned pixel of the scene, the other is a binned pixel of
the image. If n is even, the centre of a box lies half a pixel beside the centre of a pixel. The two boxes are shifted
in opposite directions, so the shifts cancel, and K is centred at [size // 2, size // 2] for even and odd factors. In
other words, K is the share of a point source's light that a binned pixel of the image receives, averaged over all
positions of the source within a binned pixel of the scene. The sum of t(n M + d) over M is 1 for each d, so no light is
lost. A delta function stays a delta function.

A cut-out, or a window that starts at another pixel of the detector (PXBEG), has the same PSF as the whole image, if
one PSF is used for the whole field: only the difference of two positions matters. A PSF that changes over the field
(`psfcore.psf_field`) needs the place of the pixels on the detector. Near the edges of a window, light from outside the
window enters the image; no choice of the PSF can correct this.

If the image was turned by quarter turns or flipped after it was taken, so is the PSF of its detector, which is exact.
Its core and its arms are too narrow to be interpolated, so for other angles a PSF is built anew from the instrument
file.

| symbol | name | unit |
|---|---|---|
| h | kernel, centre at [size // 2, size // 2] | - |
| K | kernel for binned pixels | - |
| n | factor | px |
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.cards import Cards
from psfcore.fits.channel import PsfOrigin, binning_factor
from psfcore.fits.frame import SILENT_DEG, UNIT, Matrix, frame_of, plate_scale_arcsec
from psfcore.fits.place import place_of
from psfcore.image import Image
from psfcore.instruments.files import instrument_names
from psfcore.instruments.model import load_instrument
from psfcore.psf import LARGEST_SUM, PLATE_SCALE_TOLERANCE, REACH_GRID_PX, Psf, crop_centred, with_kernels
from psfcore.psf_field import FieldTerm, Place

LARGEST_FACTOR = 64
Kernel = NDArray[np.float64]
Scaled = TypeVar("Scaled", Psf, PsfOrigin)


@dataclass(frozen=True)
class Sampling:
    """The pixels of an image, as a PSF needs them: the binning factor, the quarter turn or flip of the detector, and
    for a PSF that changes over the field the place on the detector.
    """

    factor: int
    turn: Matrix
    place: Place | None = None

    def of(self, psf: Psf) -> Psf:
        """The PSF on these pixels."""
        fitted = turned(rebinned(psf, self.factor), self.turn)
        return fitted if self.place is None else replace(fitted, place=self.place)


def with_scale(psf: Scaled, plate_scale_arcsec: float | None) -> Scaled:
    """The PSF with this plate scale, if its file gives none. Raises DataError "plate-scale-known" for another scale."""
    if plate_scale_arcsec is None or psf.plate_scale_arcsec == plate_scale_arcsec:
        return psf
    if psf.plate_scale_arcsec is not None:
        raise DataError(
            "plate-scale-known",
            f"expected a PSF without plate scale; PSF {psf.name} has {psf.plate_scale_arcsec:g} arcsec/px: leave the "
            "plate scale out",
        )
    return replace(psf, plate_scale_arcsec=plate_scale_arcsec)


AS_BUILT = Sampling(1, UNIT)


def sampling_of(psf: Psf, header: Cards, shape: tuple[int, int] | None = None) -> Sampling:
    """How an image samples a PSF of its detector. Raises DataError "plate-scale-mismatch", and "psf-place" if the PSF
    changes over the field and the place of the image is not known.

    Parameters
    ----------
    shape
        Shape (ny, nx) of the image; None: as the header says.
    """
    turn = UNIT if psf.instrument is None or psf.turn_deg != 0 else frame_of(header).quarter_turns
    factor = binning_factor(psf, header)
    place = None
    if psf.place is not None:
        known = psf.instrument in instrument_names()
        readout_px = load_instrument(str(psf.instrument)).detector.pixels if known else None
        place = place_of(header, shape, psf.place.detector, factor, turn, readout_px)
        place = None if place == psf.place else place
    return Sampling(factor, turn or UNIT, place)


def psf_for_image(psf: Psf, header: Header) -> Psf:
    """The PSF for the pixels of an image with this header: `psf` itself, or `psf` rebinned and turned with the
    image.
    """
    return sampling_of(psf, header).of(psf)


def turned(psf: Psf, turn: Matrix) -> Psf:
    """The PSF of an image that was turned.

    Parameters
    ----------
    turn
        The matrix T of `psfcore.fits.frame`, with the values -1, 0 and 1.
    """
    if turn == UNIT:
        return psf
    found = with_kernels(psf, lambda kernel: _turned(kernel, turn))
    terms = found.field_terms
    if turn[0][0] == 0:  # x of the detector is y of the image
        terms = tuple(FieldTerm(term.kernel, term.y_power, term.x_power) for term in terms)
    return replace(
        found,
        field_terms=terms,
        version=f"{psf.version}+turned",
        provenance={**psf.provenance, "turned": str(turn)},
    )


def _turned(kernel: Kernel, turn: Matrix) -> Kernel:
    """K[p] = h[T p], p: the offset (x, y) from the centre."""
    (a, b), (c, d) = turn
    ny, nx = kernel.shape
    # With one more row and column, an array of even size has an offset on each side for each offset on the other.
    whole = np.pad(kernel, ((0, 1 - ny % 2), (0, 1 - nx % 2)))
    size = whole.shape if b == 0 else whole.shape[::-1]
    y, x = np.meshgrid(*(np.arange(n) - n // 2 for n in size), indexing="ij")
    column, row = (np.rint(a * x + b * y).astype(int), np.rint(c * x + d * y).astype(int))
    placed = whole[row + whole.shape[0] // 2, column + whole.shape[1] // 2]
    return np.ascontiguousarray(placed[: (ny, nx)[b != 0], : (nx, ny)[b != 0]])


def frame_warnings(psf: Psf, header: Cards) -> dict[str, str]:
    """Warnings about the frames and the plate scales of an image and its PSF: sentences by their codes."""
    frame, warnings = frame_of(header), {}
    turn = frame.quarter_turns
    how = "mirrored" if frame.flipped else f"turned by {frame.turn_deg:.3g} degrees"
    if not frame.flipped and abs(frame.turn_deg - psf.turn_deg) <= SILENT_DEG < abs(psf.turn_deg):
        warnings["frame"] = (
            f"the image is {how} against the detector and interpolated; the PSF was built at this angle: the image "
            "before the turn gives a better result"
        )
    elif psf.turn_deg:
        warnings["frame"] = (
            f"the PSF was built for images that are turned by {psf.turn_deg:.3g} degrees; the image is {how}: use "
            "another PSF"
        )
    elif turn is None:
        advice = "use the image before the turn"
        warnings["frame"] = (
            f"the image is {how} against the detector and interpolated; the PSF is not turned: {advice}"
        )
    elif turn != UNIT and psf.instrument is None:
        warnings["frame"] = f"the image is {how} against the detector; the PSF is used as it stands"
    elif turn != UNIT:
        warnings["frame"] = f"the image is {how} against the detector; the PSF was turned with it"
    if frame.interpolated is not None:
        warnings["interpolated"] = f"the pixels are not those of the detector: {frame.interpolated}"
    scales = {"PSF": psf.plate_scale_arcsec, "image": frame.scale_arcsec[0]}
    unknown = [name for name, scale in scales.items() if scale is None]
    if len(unknown) == 1:  # two arrays in memory have no scales to compare
        warnings["plate-scale"] = (
            f"the plate scales of image and PSF were not compared: {unknown[0]} without plate scale (CDELT1 with a "
            "unit of angle); a binned image would need another PSF"
        )
    return warnings


def check_compatible(image: Image, psf: Psf) -> None:
    """Raise DataError "plate-scale-mismatch" if both plate scales are known and differ by more than 1 %."""
    if psf.plate_scale_arcsec is None:
        return
    for axis in (1, 2):
        scale = plate_scale_arcsec(image.header, axis)
        if scale is None:
            continue
        if abs(scale / psf.plate_scale_arcsec - 1) > PLATE_SCALE_TOLERANCE:
            expected = f"{psf.plate_scale_arcsec:g} arcsec/px, the plate scale of PSF {psf.name}"
            raise DataError(
                "plate-scale-mismatch",
                f"expected {expected}; got CDELT{axis} = {scale:g} arcsec/px: choose a PSF of the same instrument and "
                "binning",
            )


def rebinned(psf: Psf, factor: int) -> Psf:
    """Rebin the PSF and its components for pixels that are means of factor x factor pixels.

    Raises DataError "bad-binning" if the factor is out of range or larger than half the kernel.
    """
    if factor == 1:
        return psf
    smallest = min(psf.kernel.shape)
    if not 1 <= factor <= min(LARGEST_FACTOR, max(1, smallest // 2)):
        raise DataError(
            "bad-binning",
            f"expected a binning factor of 1 to {min(LARGEST_FACTOR, max(1, smallest // 2))}; got {factor}",
        )
    scale = psf.plate_scale_arcsec
    return replace(
        with_kernels(psf, lambda kernel: rebinned_kernel(kernel, factor)),
        version=f"{psf.version}+bin{factor}",
        plate_scale_arcsec=None if scale is None else scale * factor,
        provenance={**psf.provenance, "binning": factor},
        place=None if psf.place is None else psf.place.binned(factor),
    )


def rebinned_kernel(kernel: Kernel, factor: int) -> Kernel:
    """Eq. (1) along both axes; the sum of the used weights is unchanged. Of a larger array that sums to 1 over the full
    reach (in unbinned pixels), only the weights within the reach are used.
    """
    inner = crop_centred(kernel, (min(kernel.shape[0], REACH_GRID_PX), min(kernel.shape[1], REACH_GRID_PX)))
    if inner.sum() < 2 - LARGEST_SUM and kernel.sum() <= LARGEST_SUM:  # it sums to 1 over the whole array
        inner = kernel
    rows = _rebin_axis(inner, factor)
    return np.ascontiguousarray(_rebin_axis(rows.T, factor).T)


def _rebin_axis(kernel: Kernel, factor: int) -> Kernel:
    """Eq. (1) along the first axis: each weight is divided between the two nearest binned offsets."""
    offset = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    low, past = np.divmod(offset, factor)
    half = int(max(-low.min(), low.max() + 1))
    out = np.zeros((2 * half + 1, *kernel.shape[1:]))
    upper = (past / factor)[:, None]
    np.add.at(out, low + half, (1 - upper) * kernel)
    np.add.at(out, low + half + 1, upper * kernel)
    return out
