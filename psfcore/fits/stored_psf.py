"""A stored PSF, without its pixels in this process: check that a file can be a PSF, and write the central part of
one.
"""

from __future__ import annotations

import math
import os
from dataclasses import asdict
from pathlib import Path
from typing import BinaryIO

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.cards import without_cards
from psfcore.fits.header import PRODUCT, HeaderSummary, field_hdus, read_summary, shape_of
from psfcore.limited import run_limited

_FIELD_CARDS = ("EXTNAME", "XPOWER", "YPOWER", "FIELDNX", "FIELDNY")
# Cards that say how the file stores its image, and would be wrong in a cut-out.
_STORAGE = ("EXTEND", "PCOUNT", "GCOUNT", "BSCALE", "BZERO", "BLANK")


def check_is_psf(path: str | Path, summary: HeaderSummary, limits: FitsLimits) -> None:
    """Raise DataError if a file is not a PSF. The weights are read in a process of its own.

    Codes: those of `check_no_product`; "psf-nonfinite", "psf-negative", "psf-sum", "psf-not-centred", "psf-off-centre",
    "psf-field" for weights that no PSF can have; "unreadable-pixels"; and the codes of HeaderError.

    Parameters
    ----------
    summary
        The summary of the file's header.
    """
    check_no_product(summary)
    pixels = math.prod(summary.shape) + _field_pixels(path, limits)
    with open(os.devnull, "wb") as unused:
        run_limited(read_weights, path, unused, pixels=pixels, limits=asdict(limits))


def _field_pixels(path: str | Path, limits: FitsLimits) -> int:
    """The number of pixels of all terms of a PSF that changes over the field."""
    return sum(math.prod(shape_of(hdu.header)) for hdu in field_hdus(path, limits))


def check_no_product(summary: HeaderSummary) -> None:
    """Raise DataError "image-as-psf" if the header says that a file is a deconvolved image."""
    if summary.content == PRODUCT:
        raise DataError(
            "image-as-psf",
            "expected a PSF; the header (PSFID) says that the file is a deconvolved image: name the file of a PSF",
        )


def read_weights(target: BinaryIO, *, path: str, limits: dict[str, int]) -> dict[str, object]:
    """Read a PSF and check it. Nothing is written to ``target``. Raises the errors of `psfcore.fits.psfs.read_psf`."""
    from psfcore.fits.psfs import read_psf  # loads the numerical libraries

    read_psf(path, FitsLimits(**limits), parts=False)
    return {}


def write_cutout(path: str | Path, size: int, limits: FitsLimits, target: BinaryIO) -> None:
    """Write the central (size, size) px of a PSF to ``target`` as a FITS file, in a process of its own.

    The weights are not renormalised. The centre of the PSF is at [size // 2, size // 2]. The cards are those of the
    PSF. Raises HeaderError, DataError "cutout-too-large" if the PSF is smaller, and "unreadable-pixels".
    """
    shape = read_summary(path, limits).shape
    if not 1 <= size <= min(shape):
        raise DataError("cutout-too-large", f"expected a size of 1 to {min(shape)} px; got {size}")
    pixels = math.prod(shape) + _field_pixels(path, limits)
    run_limited(cut_psf, path, target, pixels=pixels, size=size, limits=asdict(limits))


def cut_psf(target: BinaryIO, *, path: str, size: int, limits: dict[str, int]) -> dict[str, object]:
    """Write the cut-out of a PSF to ``target``. Call it in a limited process (`psfcore.limited`)."""
    from astropy.io import fits

    from psfcore.fits.hdus import read_pixels  # loads the numerical libraries
    from psfcore.fits.viewing.regions import moved_header
    from psfcore.psf import crop_or_pad

    allowed = FitsLimits(**limits)
    stored = read_pixels(path, allowed)
    ny, nx = stored.pixels.shape
    rows, columns = (slice(n // 2 - size // 2, n // 2 - size // 2 + size) for n in (ny, nx))
    part = stored.pixels[rows, columns]
    cut = moved_header(without_cards(stored.header, _STORAGE), columns, rows)
    cut["PSFSUM"] = (math.fsum(part.ravel()), "sum of weights on this array")
    cut["REACH"] = (math.hypot(size // 2, size // 2), "[pixel] farthest pixel from the centre")
    cut.add_history(f"central {size} x {size} px of {nx} x {ny}, not renormalised")
    hdus = [fits.PrimaryHDU(part.astype("f8" if stored.bits == -64 else "f4"), cut)]
    for hdu in field_hdus(path, allowed):
        term = crop_or_pad(read_pixels(path, allowed, hdu=hdu.number).pixels, size).astype("f4")
        hdus.append(fits.ImageHDU(term, fits.Header([hdu.header.cards[key] for key in _FIELD_CARDS])))
    fits.HDUList(hdus).writeto(target)
    return {}
