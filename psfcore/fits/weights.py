"""Check that a file can be a PSF before it is accepted: its header, and its weights if they are stored plainly.

The weights are read in pieces with the standard library, so that the web process can check an upload. Tile-compressed
weights are not read; the jobs that use the PSF check them.
"""

from __future__ import annotations

import math
import os
import sys
from array import array
from collections.abc import Iterator
from pathlib import Path

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits, Source, enter_data, open_source
from psfcore.fits.header import PRODUCT, PSF, HeaderSummary, optional_number
from psfcore.weight_rules import (
    REACH_GRID_PX,
    check_core,
    check_finite,
    check_weights,
    core_offset_px,
    is_peak,
)

_TYPES = {8: "B", 16: "h", 32: "i", 64: "q", -32: "f", -64: "d"}


def check_is_psf(path: str | os.PathLike[str], summary: HeaderSummary, limits: FitsLimits) -> None:
    """Raise DataError if a file is certainly not a PSF.

    summary: the summary of the file's header. Codes: "image-as-psf" for a product, or for a compressed image with an
    exposure time; "psf-nonfinite", "psf-negative", "psf-sum", "psf-not-centred", "psf-off-centre" for weights that no PSF can have; and the
    codes of HeaderError.
    """
    if summary.content == PRODUCT:
        raise DataError(
            "image-as-psf",
            "expected a PSF; the header (PSFID) says that the file is a deconvolved image: name the file of a PSF",
        )
    if summary.codec is None:
        _check_pixels(Path(path), summary, limits)
    elif summary.content != PSF and summary.exposure_s is not None:
        raise DataError(
            "image-as-psf",
            f"expected a PSF; the header has an exposure time ({summary.exposure_s:g} s), so the file is an image. If it "
            "is a PSF, store it uncompressed: its weights are then checked instead",
        )


def _check_pixels(path: Path, summary: HeaderSummary, limits: FitsLimits) -> None:
    ny, nx = summary.shape
    rows, columns = _reach(ny), _reach(nx)
    smallest, largest, total, anywhere, centre = math.inf, -math.inf, 0.0, 0.0, 0.0
    core: list[list[float]] = []
    with open_source(path, limits) as source:
        header = enter_data(source, summary.hdu, limits)
        for row, stored in enumerate(_rows(source, summary)):
            smallest, largest = min(smallest, min(stored)), max(largest, max(stored))
            anywhere += sum(stored)
            if row in rows:
                total += sum(stored[columns.start : columns.stop])
            if row == ny // 2:
                centre = stored[nx // 2]
            if abs(row - ny // 2) <= 1 and nx >= 3:
                core.append(list(stored[nx // 2 - 1 : nx // 2 + 2]))
    check_finite(anywhere)
    # Stored numbers become weights by BSCALE and BZERO (FITS standard 4.0, Eq. 3).
    scale = optional_number(header, "BSCALE")
    scale = 1.0 if scale is None else scale
    zero = optional_number(header, "BZERO") or 0.0
    smallest, largest = sorted((scale * smallest + zero, scale * largest + zero))
    centre, total = scale * centre + zero, scale * total + zero * len(rows) * len(columns)
    check_weights(smallest, largest, total)
    if not is_peak(centre, largest):
        raise DataError(
            "psf-not-centred",
            f"expected the largest weight, {largest:.3g}, at [y, x] = {(ny // 2, nx // 2)}; got {centre:.3g} there: "
            "shift the PSF so that its peak is in this pixel",
        )
    if len(core) == 3:
        weights = [[scale * value + zero for value in line] for line in core]
        check_core(
            core_offset_px(*(sum(column) for column in zip(*weights, strict=True))),
            core_offset_px(*(sum(line) for line in weights)),
        )


def _reach(size: int) -> range:
    """The central pixels of an axis over which the weights are summed."""
    kept = min(size, REACH_GRID_PX)
    first = size // 2 - kept // 2
    return range(first, first + kept)


def _rows(source: Source, summary: HeaderSummary) -> Iterator[array[float]]:
    """The rows of an image, one after the other, as the numbers that the file stores (before BSCALE and BZERO)."""
    ny, nx = summary.shape
    for _ in range(ny):
        stored: array[float] = array(_TYPES[summary.bitpix])
        stored.frombytes(source.read(nx * stored.itemsize))
        if sys.byteorder == "little":
            stored.byteswap()
        yield stored
