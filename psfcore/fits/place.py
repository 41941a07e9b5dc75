"""Where the pixels of an image lie on the detector, from its header: for a PSF that changes over the field.

An image as large as the detector, divided by the binning, shows the whole detector. A part of it must say which part:

| cards | counted from | telescopes |
|---|---|---|
| PXBEG1, PXEND1, PXBEG2, PXEND2: first and last pixel that was read | 1 | EUI and others |
| P1COL, P2COL, P1ROW, P2ROW: first and last pixel that was read | 0 | Hinode/XRT |
| X0_MP, Y0_MP: the pixel of the Sun's centre on the detector; CRPIX1, CRPIX2: on the cut-out | 0; 1 | SDO/AIA |

The part must have as many pixels as these cards say: software that cuts an image may keep the cards of the whole.
"""

from __future__ import annotations

from psfcore.errors import DataError
from psfcore.fits.cards import Cards, optional_number, optional_text
from psfcore.fits.frame import Matrix
from psfcore.psf_field import Place

_WINDOW = (("PXBEG1", "PXEND1"), ("PXBEG2", "PXEND2"))
_WINDOW_OF_XRT = (("P1COL", "P2COL"), ("P1ROW", "P2ROW"))
# Largest distance of a position on the detector from a whole pixel, px.
_WHOLE_PX = 0.02


def place_of(
    header: Cards,
    shape: tuple[int, int] | None,
    detector: tuple[int, int],
    factor: int,
    turn: Matrix | None,
    readout_px: int | None = None,
) -> Place:
    """The place of an image on a detector. Raises DataError "psf-place", which says what the header does not tell.

    Parameters
    ----------
    shape
        Shape (ny, nx) of the image; None: as NAXIS1 and NAXIS2 say.
    detector
        Size (nx, ny) of the detector, px.
    factor
        Pixels of the detector in a pixel of the image, along each axis.
    turn
        The matrix T of `psfcore.fits.frame` with the values -1, 0 and 1; None: the image was turned by another angle.
    readout_px
        Size of the whole detector in px, in whose pixels the cards of a part count; None: unknown. The PSF may have
        been made for a part of it.
    """
    if turn is None:
        raise _unknown("an image that was turned by quarter turns at most", "use the image before the turn")
    sides = [optional_number(header, f"NAXIS{axis}") for axis in (1, 2)]
    nx, ny = shape[::-1] if shape is not None else sides
    if nx is None or ny is None:
        raise _unknown("the size of the image", "add the cards NAXIS1 and NAXIS2")
    along = []
    for axis, count in enumerate((int(nx), int(ny))):
        on_detector = 0 if turn[0][axis] else 1
        first = _first_pixel(header, on_detector, count, detector[on_detector], factor, readout_px)
        first_px = first + (factor - 1) / 2
        last_px = first_px + (count - 1) * factor
        step = 2 / (detector[on_detector] - 1)
        along.append(
            (first_px * step - 1, factor * step)
            if turn[on_detector][axis] > 0
            else (last_px * step - 1, -factor * step)
        )
    return Place(along[0], along[1])


def _first_pixel(
    header: Cards, axis: int, count: int, size: int, factor: int, readout_px: int | None
) -> float:
    """The first pixel of the detector, from 0, that an image shows along an axis (0: x) of the detector.

    Parameters
    ----------
    count
        Pixels of the image along this axis.
    size
        Pixels of the detector along this axis.
    """
    if count == size // factor:
        return 0.0
    if readout_px not in (None, size):
        raise _unknown(
            f"the part of {size} px for which the PSF was made, of {readout_px} px of the detector along {'xy'[axis]}",
            f"use an image of all {size} px",
        )
    of_xrt = (optional_text(header, "INSTRUME") or "").upper() == "XRT"
    keys, counted_from = (_WINDOW_OF_XRT[axis], 0) if of_xrt else (_WINDOW[axis], 1)
    begin, end = (optional_number(header, key) for key in keys)
    of_sun = optional_number(header, f"{'XY'[axis]}0_MP")
    reference = optional_number(header, f"CRPIX{axis + 1}")
    if begin is not None and end is not None:
        first, last = begin - counted_from, end - counted_from
    elif of_sun is not None and reference is not None and factor == 1:
        first = of_sun + 1 - reference
        last = first + count - 1
    else:
        raise _unknown(
            f"the part of the detector of {size} px that {count} px along {'xy'[axis]} show",
            f"add the cards {keys[0]} and {keys[1]}, its first and last pixel counted from {counted_from}, or use the "
            "whole image",
        )
    if round(last - first) + 1 != count * factor or not -_WHOLE_PX <= first <= last <= size - 1 + _WHOLE_PX:
        raise _unknown(
            f"cards for {count * factor} px of the {size} px of the detector along {'xy'[axis]}",
            f"correct the cards {keys[0]} and {keys[1]}, which say {first:g} to {last:g} from 0",
        )
    return first


def _unknown(missing: str, advice: str) -> DataError:
    return DataError(
        "psf-place",
        f"expected {missing}, because the PSF changes over the field; the header does not tell it: {advice}, or use a "
        "PSF without terms FIELD",
    )
