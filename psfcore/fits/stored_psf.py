"""A stored PSF, without its pixels in this process: check that a file can be a PSF, and write the central part of one.

A FITS image stores its rows one after the other (FITS standard 4.0, section 3.3.2), so a cut-out consists of a range
of bytes from each row. The image must be uncompressed and in the first HDU. Every PSF that heliopsf writes is stored
in this way. A cut-out is read in pieces, because a server may send many of them at the same time.
"""

from __future__ import annotations

import math
import os
import sys
from array import array
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from psfcore.errors import DataError
from psfcore.fits.blocks import BLOCK_BYTES, FitsLimits
from psfcore.fits.cards import without_cards
from psfcore.fits.header import PRODUCT, HeaderSummary, read_first_image
from psfcore.limited import run_limited

if TYPE_CHECKING:
    from astropy.io.fits import Header

_FLOATS = {-32: "f", -64: "d"}
_PIECE_BYTES = 2**18
# Cards that describe the whole image and would be wrong in a cut-out.
_DROPPED = ("EXTEND", "CHECKSUM", "DATASUM", "DATAMIN", "DATAMAX", "DATAMEAN", "PCOUNT", "GCOUNT")


def check_is_psf(path: str | Path, summary: HeaderSummary, limits: FitsLimits) -> None:
    """Raise DataError if a file is not a PSF. The weights are read in a process of its own.

    summary: the summary of the file's header. Codes: those of `check_no_product`; "psf-nonfinite", "psf-negative", "psf-sum",
    "psf-not-centred", "psf-off-centre" for weights that no PSF can have; "unreadable-pixels"; and the codes of HeaderError.
    """
    check_no_product(summary)
    with open(os.devnull, "wb") as unused:
        run_limited(read_weights, path, unused, pixels=math.prod(summary.shape), limits=asdict(limits))


def check_no_product(summary: HeaderSummary) -> None:
    """Raise DataError "image-as-psf" if the header says that a file is a deconvolved image."""
    if summary.content == PRODUCT:
        raise DataError(
            "image-as-psf",
            "expected a PSF; the header (PSFID) says that the file is a deconvolved image: name the file of a PSF",
        )


def read_weights(target: BinaryIO, *, path: str, limits: dict[str, int]) -> dict[str, Any]:
    """Read a PSF and check it. Nothing is written to ``target``. Raises the errors of `psfcore.fits.psfs.read_psf`."""
    from psfcore.fits.psfs import read_psf  # loads the numerical libraries

    read_psf(path, FitsLimits(**limits), parts=False)
    return {}


@dataclass(frozen=True)
class Cutout:
    """A FITS file that holds the central (size, size) px of a PSF. The centre of the PSF is at [size // 2, size // 2].

    header: the bytes of its header. path, shape, bitpix: the file of the PSF, and its image; first: the place of its first
    pixel in the file, bytes.
    """

    header: bytes
    path: Path
    first: int
    shape: tuple[int, int]
    bitpix: int
    size: int

    @property
    def length(self) -> int:
        """Number of bytes of the FITS file."""
        data = self.size**2 * abs(self.bitpix) // 8
        return len(self.header) + data + -data % BLOCK_BYTES

    def pieces(self) -> Iterator[bytes]:
        """The bytes of the FITS file, one piece after the other.

        Raises OSError, and EOFError if the PSF's file has become shorter.
        """
        yield self.header
        yield from self.rows()
        yield bytes(-(self.size**2) * abs(self.bitpix) // 8 % BLOCK_BYTES)

    def rows(self) -> Iterator[bytes]:
        """The pixels with the type and byte order of the file, a few rows at a time. Raises the errors of ``pieces``."""
        (ny, nx), pixel_bytes = self.shape, abs(self.bitpix) // 8
        top, left = ny // 2 - self.size // 2, nx // 2 - self.size // 2
        row_bytes, piece = self.size * pixel_bytes, bytearray()
        with self.path.open("rb") as file:
            for row in range(top, top + self.size):
                file.seek(self.first + (row * nx + left) * pixel_bytes)
                pixels = file.read(row_bytes)
                if len(pixels) < row_bytes:
                    raise EOFError(f"expected {row_bytes} bytes of row {row} of the PSF; got {len(pixels)}")
                piece += pixels
                if len(piece) >= _PIECE_BYTES:
                    yield bytes(piece)
                    piece.clear()
        yield bytes(piece)

    def write(self, target: Path) -> None:
        """Write the FITS file. Raises the errors of ``pieces``."""
        with target.open("wb") as file:
            file.writelines(self.pieces())


def cutout(path: Path, size: int, limits: FitsLimits) -> Cutout:
    """Prepare the cut-out of the central (size, size) px of a PSF. The pixels are read once, for their sum.

    Raises DataError "cutout-too-large" if the PSF is smaller, and "cutout-not-plain" if the file is compressed or does not
    store the weights as plain floats.
    """
    summary, image = read_first_image(path, limits)
    ny, nx = summary.shape
    if not 1 <= size <= min(ny, nx):
        raise DataError("cutout-too-large", f"expected a size of 1 to {min(ny, nx)} px; got {size}")
    if summary.hdu != 0 or summary.codec is not None or summary.gzipped or summary.bitpix not in _FLOATS:
        raise DataError(
            "cutout-not-plain",
            "expected a PSF stored as uncompressed floats in the first HDU; this PSF is compressed, stored as integers, or "
            "in a later HDU. Download the file and run `heliopsf psf cutout` on it",
        )
    if "BSCALE" in image.header or "BZERO" in image.header:
        raise DataError(
            "cutout-not-plain",
            "expected a PSF without BSCALE and BZERO. Download the file and run `heliopsf psf cutout` on it",
        )
    part = Cutout(b"", path, image.start, (ny, nx), summary.bitpix, size)
    total = math.fsum(chain.from_iterable(_weights(piece, summary.bitpix) for piece in part.rows()))
    header = _cut_header(image.header, (ny, nx), size, total)
    return replace(part, header=header.tostring().encode("ascii"))


def _weights(piece: bytes, bitpix: int) -> array[float]:
    """The pixels of a piece as numbers."""
    weights: array[float] = array(_FLOATS[bitpix], piece)
    if sys.byteorder == "little":
        weights.byteswap()
    return weights


def _cut_header(header: Header, shape: tuple[int, int], size: int, total: float) -> Header:
    cut = without_cards(header, _DROPPED)
    for axis, whole in ((1, shape[1]), (2, shape[0])):
        cut[f"NAXIS{axis}"] = size
        if f"CRPIX{axis}" in cut:
            cut[f"CRPIX{axis}"] -= whole // 2 - size // 2
    cut["PSFSUM"] = (total, "sum of weights on this array")
    cut["REACH"] = (math.hypot(size // 2, size // 2), "[pixel] farthest pixel from the centre")
    cut.add_history(f"central {size} x {size} px of {shape[1]} x {shape[0]}, not renormalised")
    return cut
