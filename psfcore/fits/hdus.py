"""Read the pixels of one HDU, and write a list of HDUs to a file.

A file that this module writes has the cards CHECKSUM and DATASUM, but no date of writing. Equal content therefore
gives equal bytes.
"""

from __future__ import annotations

import errno
import math
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO

import numpy as np
from astropy.io import fits
from astropy.io.fits.hdu.compressed._compression import CfitsioException
from astropy.io.fits.verify import VerifyError
from numpy.typing import NDArray

from psfcore.errors import DataError, HeaderError
from psfcore.files import probe
from psfcore.fits.blocks import FitsLimits, Hdu, Source, first_image, open_source, skip_data, walk
from psfcore.fits.cards import optional_number
from psfcore.fits.compression import may_hold_unwritten_memory
from psfcore.fits.header import HeaderSummary, is_plane, shape_of, summary_of
from psfcore.limited import fill_new_memory, run_limited, scratch_file

_CHECKSUM_COMMENT = "computed when the file was written"
# The cards of a tile-compressed image that describe the table of its tiles. FITS standard 4.0, sections 7.3 and 10.1.
TABLE_CARD = re.compile(
    r"XTENSION|BITPIX|NAXIS\d*|PCOUNT|GCOUNT|CHECKSUM|DATASUM|ZHECKSUM|ZDATASUM|"
    r"TFIELDS|THEAP|T(TYPE|FORM|UNIT|NULL|SCAL|ZERO|DISP|DIM)\d+|"
    r"ZIMAGE|ZSIMPLE|ZEXTEND|ZTENSION|ZBITPIX|ZNAXIS\d*|ZPCOUNT|ZGCOUNT|ZTILE\d+|ZCMPTYPE|ZNAME\d+|ZVAL\d+|"
    r"ZQUANTIZ|ZDITHER0|ZBLANK|ZSCALE|ZZERO|ZMASKCMP|ZBLOCKED"
)
_TYPES = {8: "u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}
_OTHER_FILLING = 0x2A
_PIECE_BYTES = 2**23  # a large image is read in pieces, so that it is in memory only once
_NUMBERS = {name: np.dtype(name) for name in ("uint8", "int16", "int32", "int64", "float32", "float64")}
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
    re.error,  # astropy takes some keywords as patterns
    AssertionError,  # astropy raises it for the name of a column
    struct.error,
    zlib.error,
)


@dataclass(frozen=True, eq=False)
class StoredImage:
    """Pixels [y, x] (float64) and header of an image, as its file has them, and the number of its HDU.

    Attributes
    ----------
    bits
        BITPIX of the image; None: unknown.
    others
        The number, the name and the shape of each image that follows in the file, if they were asked for; without
        planes of products.
    damaged
        Whether the card DATASUM contradicts the data.
    """

    number: int
    bits: int | None
    pixels: NDArray[np.float64]
    header: fits.Header
    others: Sequence[tuple[int, str, tuple[int, ...]]] = ()
    damaged: bool = False


def prepare_library() -> None:
    """Let astropy write its first file, for which it makes another one to find out whether files can be mapped into
    memory.
    """
    with TemporaryFile() as target:
        fits.HDUList([fits.PrimaryHDU()]).writeto(target)


def read_pixels(
    path: str | Path, limits: FitsLimits, *, hdu: int | None = None, others: bool = False
) -> StoredImage:
    """Read the first 2-D image of a file, or the image in HDU `hdu`.

    A plain image is read as it stands, in one pass through the file. A tile-compressed image is decoded by astropy in a
    process of its own, and its header is that of the image. Raises HeaderError, DataError "unreadable-pixels", and
    OSError if the disk fails.

    Parameters
    ----------
    others
        Whether to look for further images.
    """
    further: list[tuple[int, str, tuple[int, ...]]] = []
    with open_source(Path(path), limits) as source:
        hdus = walk(source, limits)
        image = first_image(hdus, limits, hdu)
        header, summary = image.header, summary_of(image, gzipped=source.gzipped)
        sums = Sum32()
        plain = None if summary.codec is not None else _plain_pixels(source, image, summary, sums)
        skip_data(source, image)
        # What follows an image is not needed to use it, so damage there is no error.
        with suppress(HeaderError):
            further.extend(
                (one.number, one.name, shape_of(one.header))
                for one in (hdus if others else ())
                if one.kind == "image" and not is_plane(one)
            )
    if plain is not None:
        return StoredImage(image.number, summary.bitpix, plain, header, further, sums.contradicts(header))
    decoded, damaged = _decoded_pixels(path, summary, twice=may_hold_unwritten_memory(header))
    return StoredImage(
        image.number,
        summary.bitpix,
        decoded,
        # The header of the image is that of the table without the cards of its tiles.
        fits.Header([card for card in header.cards if not TABLE_CARD.fullmatch(card.keyword)]),
        further,
        damaged,
    )


class Sum32:
    """The checksum of data units: the sum of their words of 32 bits in ones' complement. FITS standard 4.0, Appendix
    J.
    """

    def __init__(self) -> None:
        self._total, self._rest = 0, b""

    def add(self, data: bytes) -> None:
        """Add the next bytes."""
        data = self._rest + data
        whole = len(data) // 4
        self._total += int(np.frombuffer(data, ">u4", whole).sum(dtype=np.uint64))
        self._rest = data[4 * whole :]

    def contradicts(self, header: fits.Header) -> bool:
        """Whether the card DATASUM of this header is another checksum."""
        stated = optional_number(header, "DATASUM")
        total = self._total + int.from_bytes(self._rest.ljust(4, b"\0"), "big")  # the padding of images is 0
        while total >> 32:
            total = (total & 0xFFFFFFFF) + (total >> 32)
        return stated not in (None, 0, float(total))


def _plain_pixels(source: Source, image: Hdu, summary: HeaderSummary, sums: Sum32) -> NDArray[np.float64]:
    """The pixels of a plain image, from a source that stands at its data. FITS standard 4.0, Eqs. (3) and (4). sums:
    gets the bytes.
    """
    ny, nx = summary.shape
    _ = image.end  # raises the errors of its declared size
    stored = np.dtype(_TYPES[summary.bitpix])
    pixels = np.empty(summary.shape)
    some = max(1, _PIECE_BYTES // (nx * stored.itemsize))
    for first in range(0, ny, some):
        rows = pixels[first : first + some]
        raw = source.read(rows.size * stored.itemsize)
        if len(raw) < rows.size * stored.itemsize:
            raise HeaderError(
                "truncated-data",
                f"expected {nx} x {ny} pixels in HDU {summary.hdu}; the file ends too early: copy the file again",
            )
        sums.add(raw)
        rows[...] = np.frombuffer(raw, stored).reshape(rows.shape)
    scale, zero = (optional_number(image.header, key) for key in ("BSCALE", "BZERO"))
    blank = optional_number(image.header, "BLANK") if summary.bitpix > 0 else None
    is_blank = None if blank is None else pixels == blank
    if scale is not None and scale != 1:
        pixels *= scale
    if zero:
        pixels += zero
    if is_blank is not None:
        pixels[is_blank] = np.nan
    return pixels


def _decoded_pixels(
    path: str | Path, summary: HeaderSummary, *, twice: bool
) -> tuple[NDArray[np.float64], bool]:
    """The pixels of a tile-compressed image, and whether DATASUM contradicts its tiles."""
    with scratch_file() as target:
        about = run_limited(
            decode_tiles,
            path,
            target,
            pixels=math.prod(summary.shape),
            number=summary.hdu,
            shape=list(summary.shape),
            twice=twice,
        )
        target.seek(0)
        stored = np.fromfile(target, _NUMBERS[about["type"]])
    return stored.reshape(summary.shape).astype(np.float64), bool(about["damaged"])


def decode_tiles(
    target: BinaryIO, *, path: str, number: int, shape: list[int], twice: bool
) -> dict[str, object]:
    """Write the pixels of a tile-compressed image to ``target``; returns the type of its numbers, and whether DATASUM
    contradicts its tiles.

    Call this in a limited process (`psfcore.limited`). Raises DataError "unreadable-pixels".

    Parameters
    ----------
    twice
        Whether to decode twice with different contents of new memory, to find pixels that astropy did not write.
    """
    with readable_pixels(path, f"HDU {number}"):
        data = _tiles(path, number)
        if data.shape != tuple(shape):
            raise DataError(
                "unreadable-pixels",
                f"expected {shape} pixels, as the header declares; got {data.shape}: copy or make the file again",
            )
        if twice:
            fill_new_memory(_OTHER_FILLING)
            if not np.array_equal(data, _tiles(path, number), equal_nan=True):
                raise DataError(
                    "unreadable-pixels",
                    f"expected all {shape} pixels in HDU {number}; its tiles do not hold them all: copy or make the "
                    "file again",
                )
        with fits.open(path, memmap=False, disable_image_compression=True) as hdus:
            damaged = hdus[number].verify_datasum() == 0
    target.write(np.ascontiguousarray(data, data.dtype.newbyteorder("=")).data)
    return {"type": data.dtype.name, "damaged": damaged}


def _tiles(path: str, number: int) -> NDArray[np.generic]:
    # uint=False: otherwise astropy converts unsigned integers (BZERO 32768) before it applies BLANK.
    with fits.open(path, mode="readonly", memmap=False, lazy_load_hdus=True, uint=False) as hdus:
        return np.asarray(hdus[number].data)


@contextmanager
def readable_pixels(path: str | Path, part: str) -> Iterator[None]:
    """Raise DataError "unreadable-pixels" for the errors of astropy in the block.

    Parameters
    ----------
    part
        The name of the part, for the message.
    """
    try:
        yield
    except DataError:
        raise
    except PIXEL_TROUBLE as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise  # the disk caused the error; the content of a file causes others, such as a negative size
        raise DataError(
            "unreadable-pixels",
            f"expected readable pixels in {part} of {Path(path).name}; got: {error!s:.120}: copy or make the file "
            "again",
        ) from None


def ascii_text(text: str) -> str:
    """Convert a text to printable ASCII, as FITS requires. White space becomes a space; other characters become '?'."""
    return "".join(c if " " <= c <= "~" else " " if c.isspace() else "?" for c in text)


def as_written(hdu: fits.PrimaryHDU | fits.ImageHDU) -> bool:
    """Whether an HDU is unchanged since `write_hdus` wrote it: its checksums are correct, and `write_hdus` computed
    them.
    """
    ours = (
        key in hdu.header and hdu.header.comments[key] == _CHECKSUM_COMMENT for key in ("CHECKSUM", "DATASUM")
    )
    return all(ours) and hdu.verify_datasum() == hdu.verify_checksum() == _RIGHT


def write_hdus(path: str | Path, hdus: list[fits.PrimaryHDU | fits.ImageHDU]) -> None:
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
