"""Read the pixels of one HDU, and write a list of HDUs to a file.

A file that this module writes has the cards CHECKSUM and DATASUM, but no date of writing. Equal content therefore
gives equal bytes.
"""

from __future__ import annotations

import errno
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.io.fits.hdu.compressed._compression import CfitsioException
from astropy.io.fits.verify import VerifyError
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.header import HeaderSummary
from psfcore.fits.tiled.compression import compression_of
from psfcore.fits.tiled.tiles import check_tiles
from psfcore.whole_files import probe

_CHECKSUM_COMMENT = "computed when the file was written"
_RIGHT = 1  # astropy returns this value if the checksum card exists and its value is correct
# Exceptions that astropy raises for a damaged data unit. The position of the damage decides which exception
# astropy raises.
PIXEL_TROUBLE = (
    CfitsioException,  # raised when RICE decoding fails; astropy has no public name for it
    VerifyError,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    RuntimeError,
    AssertionError,  # astropy raises it for the name of a column
    struct.error,
    zlib.error,
)


def read_pixels(path: str | Path, summary: HeaderSummary) -> tuple[NDArray[np.float64], fits.Header]:
    """Pixels [y, x] (float64) and header of the image that `summary` describes. Raises the errors of `opened_image`."""
    with opened_image(path, summary) as hdu:
        header = hdu.header.copy()
        data = hdu.data
        pixels = np.array(data, dtype=np.float64)
    if pixels.shape != summary.shape:
        raise _other_shape(summary, pixels.shape)
    return pixels, header


@contextmanager
def opened_image(path: str | Path, summary: HeaderSummary) -> Iterator[Any]:
    """The HDU of the image that `summary` describes, opened and checked. Its pixels are read in the block.

    Raises DataError "unreadable-pixels", "bad-tile" or "tile-too-large", and OSError if the disk fails.
    """
    with readable_pixels(path, f"HDU {summary.hdu}"):
        if summary.codec is not None:
            _check_tiles(path, summary)
        # uint=False: otherwise astropy converts unsigned integers (BZERO 32768) before it applies BLANK.
        # If an HDU is the first, astropy also inspects the next HDU, which was not checked. For a plain image, astropy
        # must not prepare that HDU for decompression.
        options = {"uint": False, "disable_image_compression": summary.codec is None}
        with fits.open(path, mode="readonly", memmap=False, lazy_load_hdus=True, **options) as hdus:
            hdu = hdus[summary.hdu]
            if hdu.shape != summary.shape:
                raise _other_shape(summary, hdu.shape)
            yield hdu


@contextmanager
def readable_pixels(path: str | Path, part: str) -> Iterator[None]:
    """Raise DataError "unreadable-pixels" for the errors of astropy in the block. part: the name of the part, for the
    message."""
    try:
        yield
    except DataError:
        raise
    except PIXEL_TROUBLE as error:
        _raise_if_storage(error)
        wanted = f"expected readable pixels in {part} of {Path(path).name}"
        message = f"{wanted}; got: {error!s:.120}: copy or make the file again"
        raise DataError("unreadable-pixels", message) from None


def _other_shape(summary: HeaderSummary, got: tuple[int, ...]) -> DataError:
    return DataError(
        "unreadable-pixels", f"expected {summary.shape} pixels, as the header declares; got {got}"
    )


class _TableHeap:
    """The heap after the rows of a binary table. It holds the compressed tiles."""

    def __init__(self, hdu: fits.BinTableHDU, first: int) -> None:
        place = hdu.fileinfo()
        self._file = place["file"]
        self._first = place["datLoc"] + first

    def read(self, offset: int, count: int) -> bytes:
        self._file.seek(self._first + offset)
        return bytes(self._file.read(count))


def _check_tiles(path: str | Path, summary: HeaderSummary) -> None:
    """Check the tiles, and the header again as astropy reads it. Raises HeaderError and the errors of `check_tiles`."""
    with fits.open(path, memmap=False, lazy_load_hdus=True, disable_image_compression=True) as hdus:
        table = hdus[summary.hdu]
        ny, nx = summary.shape
        image = compression_of(table.header, nx, ny)
        check_tiles(np.asarray(table.data).view(np.ndarray), image, _TableHeap(table, image.first))


def _raise_if_storage(error: Exception) -> None:
    """Raise the error again if the disk caused it.

    Do nothing if the content of the file caused it, such as a negative size.
    """
    if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
        raise error


def ascii_text(text: str) -> str:
    """Convert a text to printable ASCII, as FITS requires. White space becomes a space; other characters become '?'."""
    return "".join(c if " " <= c <= "~" else " " if c.isspace() else "?" for c in text)


def as_written(hdu: Any) -> bool:
    """Whether an HDU is unchanged since `write_hdus` wrote it: its checksums are correct, and `write_hdus` computed
    them."""
    sums = ("CHECKSUM", "DATASUM")
    ours = all(key in hdu.header and hdu.header.comments[key] == _CHECKSUM_COMMENT for key in sums)
    return ours and hdu.verify_datasum() == hdu.verify_checksum() == _RIGHT


def write_hdus(path: str | Path, hdus: list[Any]) -> None:
    """Write HDUs with checksums, but without a date of writing.

    Raises OSError. If the system refuses to write, for example because the disk is full, the error has the system's
    error number.
    """
    hdus[0].header["EXTEND"] = True
    for hdu in hdus:
        hdu.verify("silentfix")
        hdu.add_checksum(when=_CHECKSUM_COMMENT)
    # Pass an open file. If astropy gets a name such as x.fits.gz, it compresses the file because of the ending.
    with Path(path).open("wb") as file:
        try:
            fits.HDUList(hdus).writeto(file, output_verify="silentfix")
        except OSError as error:
            if error.errno is None:
                # numpy and astropy say how many bytes were written, but not why writing stopped. If the disk is full,
                # this probe fails too, with the error of the system.
                probe(Path(path))
            raise
