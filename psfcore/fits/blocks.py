"""Read the headers of a FITS file, HDU by HDU, without reading a pixel.

Source: FITS standard 4.0 (Pence et al. 2010; IAU FITS working group 2018), sections 3.3, 4.4 and 10.1.
`walk` reads headers in blocks of 2880 bytes and skips the data of each HDU. The size of the data follows from the
cards NAXISn, BITPIX, PCOUNT and GCOUNT. heliopsf uses the first two-dimensional image of a file: a plain image HDU, or
a tile-compressed image in a binary table with ZIMAGE = T.

If the whole file is compressed (.fits.gz), it is decompressed first, in a process of its own (`psfcore.fits.gzipped`).
The headers are read in this process: no C library reads them, their size is limited, and a child would add some
milliseconds to each.
"""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from psfcore.errors import HeaderError
from psfcore.files import GZIP_START
from psfcore.fits.cards import (
    LARGEST_COUNT,
    bad_card,
    card_count,
    card_flag,
    card_text,
    card_trouble,
    check_card,
    check_header,
    optional_text,
)
from psfcore.fits.compression import check_compression, check_counts
from psfcore.fits.gzipped import decompressed

if TYPE_CHECKING:
    from astropy.io.fits import Header

BLOCK_BYTES = 2880
CARD_BYTES = 80
_BITPIX = (8, 16, 32, 64, -32, -64)
_MANY_AXES = 10  # if an image has this number of axes or more, the message does not write out their indices
END_CARD = b"END" + b" " * 77
# astropy also ends a header at a card such as "END x". astropy would then read the file in another way than
# this module.
_SIMPLE = re.compile(rb"SIMPLE  = *[TF] *(/[ -~]*)?")
_DAMAGED_END = re.compile(rb"END[^A-Z0-9_-]")
_SCALED = ", whose values are scaled for display: use the FITS file of the image"
_KNOWN_STARTS = (
    (b"\x00\x00\x00\x0cjP", f"a JPEG 2000 file{_SCALED}"),
    (b"\xff\x4f\xff\x51", f"a JPEG 2000 codestream{_SCALED}"),
    (b"\x89PNG", f"a PNG file{_SCALED}"),
    (b"\xff\xd8\xff", f"a JPEG file{_SCALED}"),
    (b"PK\x03\x04", "a zip archive"),
    (b"BZh", "a bzip2 file"),
    (b"\xfd7zXZ", "an xz file"),
    (b"%PDF", "a PDF file"),
    (b"\x89HDF", "an HDF5 file"),
    (b"<", "a text file (markup)"),
    (b"{", "a text file (JSON)"),
)


@dataclass(frozen=True)
class FitsLimits:
    """Upper limits for a FITS file that is read.

    Attributes
    ----------
    max_pixels
        Largest number of pixels of an image.
    max_header_bytes
        Largest size of all headers together.
    max_hdus
        Largest number of HDUs.
    """

    max_pixels: int
    max_header_bytes: int = 4 * 1024 * 1024
    max_hdus: int = 64


# Limits on files that the person who runs this process names. The memory is checked before an image is deconvolved.
LIMITS = FitsLimits(max_pixels=2**26)


@dataclass(frozen=True)
class Hdu:
    """The header of an HDU, its number, its kind (see `_kind`), and where its data start in the file, bytes."""

    header: Header
    number: int
    kind: str
    start: int

    @property
    def end(self) -> int:
        """Where the data end, by their declared size. Raises HeaderError "bad-card" or "random-groups".

        The size is |BITPIX| / 8 * GCOUNT * (PCOUNT + prod NAXISn), FITS standard Eq. (2).
        """
        bitpix = card_count(self.header, "BITPIX", smallest=-64, largest=64)
        check_card(bitpix in _BITPIX, f"BITPIX of {_BITPIX} in HDU {self.number}", bitpix)
        axes = range(1, card_count(self.header, "NAXIS", largest=999) + 1)
        if not axes:
            return self.start
        check_header(
            self.number > 0 or not card_flag(self.header, "GROUPS"),
            "random-groups",
            "expected an image in a primary array or an image extension; got random groups (GROUPS = T): write the "
            "image into a primary array without the card GROUPS",
        )
        elements = math.prod(card_count(self.header, f"NAXIS{axis}") for axis in axes)
        groups, extra = (
            card_count(self.header, "GCOUNT", default=1),
            card_count(self.header, "PCOUNT", default=0),
        )
        size = abs(bitpix) // 8 * groups * (extra + elements)
        check_header(
            size <= LARGEST_COUNT,
            "bad-card",
            f"expected a data size below 2^63 bytes in HDU {self.number}; its header declares about "
            f"2^{size.bit_length()} bytes: copy or "
            "make the file again",
        )
        return self.start + size

    @property
    def name(self) -> str:
        """EXTNAME; empty if there is none."""
        return optional_text(self.header, "EXTNAME") or ""


class Source:
    """A FITS file that is read or skipped, only forwards.

    Attributes
    ----------
    gzipped
        Whether the file was compressed as a whole.
    """

    def __init__(self, file: BinaryIO, *, gzipped: bool = False, damage: HeaderError | None = None) -> None:
        """Read this file; `damage` is the error that is raised if bytes lack at the end of the file."""
        self.gzipped = gzipped
        self._file, self._damage = file, damage
        self._size = os.fstat(file.fileno()).st_size

    @property
    def position(self) -> int:
        """Number of bytes that were read or skipped."""
        return self._file.tell()

    def read(self, count: int) -> bytes:
        """The next `count` bytes; fewer only at the end of the file."""
        # A damaged header may ask for many bytes that the file does not have; the memory for them is not reserved.
        return self._file.read(self._there(count))

    def skip(self, count: int) -> int:
        """Skip up to `count` bytes; returns the number of skipped bytes, which is smaller at the end of the file."""
        there = self._there(count)
        self._file.seek(there, io.SEEK_CUR)
        return there

    def _there(self, count: int) -> int:
        left = self._size - self._file.tell()
        if count > left and self._damage is not None:
            raise self._damage
        return max(0, min(count, left))


@contextmanager
def open_source(path: Path, limits: FitsLimits) -> Iterator[Source]:
    """Open a FITS file. One in gzip is decompressed first. Raises HeaderError "empty-file"."""
    with path.open("rb") as file:
        start = file.read(2)
        file.seek(0)
        check_header(
            start != b"", "empty-file", "expected a FITS file; got an empty file: copy the file again"
        )
        if start != GZIP_START:
            yield Source(file)
            return
    with decompressed(path, 16 * limits.max_pixels + limits.max_header_bytes) as (plain, damage):
        yield Source(plain, gzipped=True, damage=damage)


def walk(source: Source, limits: FitsLimits) -> Iterator[Hdu]:
    """Each HDU of a file. Its data come next in ``source``; what is left of them is skipped when the next HDU is
    requested.

    Raises HeaderError.
    """
    header_bytes = 0
    for number in range(limits.max_hdus + 1):
        raw = _read_header(source, limits.max_header_bytes - header_bytes, limits, first=number == 0)
        if raw is None:
            return
        check_header(
            number < limits.max_hdus,
            "too-many-hdus",
            f"expected at most {limits.max_hdus} HDUs, and an image in one of them; got more HDUs: write the image "
            "into a file of its own",
        )
        header_bytes += len(raw)
        # With another value astropy calls the HDU corrupted, and then reads on without an end.
        if number == 0 and not _SIMPLE.fullmatch(raw[:CARD_BYTES]):
            raise bad_card("SIMPLE = T", f"{raw[:CARD_BYTES].rstrip()!r:.100}")
        header = _parse(raw, number)
        hdu = Hdu(header, number, _kind(header, number), source.position)
        if hdu.kind != "image":  # the size of an image is checked by its pixels first
            _ = hdu.end  # raises the errors of its declared size
        yield hdu
        skip_data(source, hdu)
        source.skip(-hdu.end % BLOCK_BYTES)


def first_image(hdus: Iterator[Hdu], limits: FitsLimits, number: int | None = None) -> Hdu:
    """The first 2-D image of the HDUs, or the image in HDU ``number``. Its data come next in the source.

    Raises HeaderError if there is none, or if an image of more axes comes first.
    """
    kinds: list[str] = []
    for hdu in hdus:
        kinds.append(hdu.kind)
        chosen = number in (None, hdu.number)
        if chosen and hdu.kind == "image":
            _check_image(hdu.header, limits)
            return hdu
        if chosen and (number is not None or hdu.kind.startswith("cube")):
            break
    if number is not None and len(kinds) <= number:
        raise HeaderError("no-image", f"expected an HDU of the file, 0 to {len(kinds) - 1}; got {number}")
    raise _no_image(kinds)


def skip_data(source: Source, hdu: Hdu) -> None:
    """Skip what is left of the data of an HDU. Raises HeaderError if the file does not hold all of them."""
    size = hdu.end - source.position
    there = source.skip(size)
    check_header(
        there >= size,
        "truncated-data",
        f"expected {size} bytes of data in HDU {hdu.number}, as its header declares; got {there}: copy the file again",
    )


def _no_image(kinds: list[str]) -> HeaderError:
    expected, count = "expected a two-dimensional image", "1 HDU" if len(kinds) == 1 else f"{len(kinds)} HDUs"
    if any(kind.startswith("cube") for kind in kinds):
        hdu, kind = next((n, kind) for n, kind in enumerate(kinds) if kind.startswith("cube"))
        axes = int(kind.split()[1])
        first = ", ".join("0" * (axes - 2)) if axes < _MANY_AXES else "..."
        return HeaderError(
            "three-axes" if axes == 3 else "not-2d",
            f"{expected}; got an image of {axes} axes in HDU {hdu}: name another HDU (--hdu), or write one plane, "
            f"for example with astropy: hdus = fits.open('FILE'); hdus[{hdu}].data = hdus[{hdu}].data[{first}]; "
            "hdus.writeto('NEW')",
        )
    if "line" in kinds:
        return HeaderError("not-2d", f"{expected}; got an image of one axis: store the image with two axes")
    if "table" in kinds:
        return HeaderError("table-only", f"{expected}; got only tables ({count}): use a file with an image")
    return HeaderError(
        "no-image", f"{expected}; got {count}, and none has data with two axes: use a file with an image"
    )


def _read_header(source: Source, most: int, limits: FitsLimits, *, first: bool) -> bytes | None:
    """Read the cards before END; None if no further header begins.

    Raises HeaderError if `most` bytes contain no END.
    """
    raw = bytearray()
    while len(raw) < most:
        block = source.read(BLOCK_BYTES)
        if not raw and first:
            _check_start(block)
        elif not raw and (len(block) < 8 or not block.startswith(b"XTENSION")):
            return None  # end of file, or special records or padding after the last HDU
        end = _find_end(block)
        raw += block if end is None else block[:end]
        if end is not None:
            return bytes(raw)
        check_header(
            len(block) == BLOCK_BYTES,
            "truncated-header",
            f"expected an END card; the file stops after {len(raw)} bytes of this header: copy the file again",
        )
    raise HeaderError(
        "header-too-long",
        f"expected at most {limits.max_header_bytes} bytes of headers, each with an END card; got more: write the "
        "image into a file of its own, with fewer cards",
    )


def _find_end(block: bytes) -> int | None:
    for at in range(0, len(block) - CARD_BYTES + 1, CARD_BYTES):
        if block[at : at + CARD_BYTES] == END_CARD:
            return at
        if _DAMAGED_END.match(block, at):
            raise bad_card("END followed by 77 spaces", f"{block[at : at + CARD_BYTES].rstrip()!r:.100}")
    return None


def _check_start(block: bytes) -> None:
    if block.startswith(b"SIMPLE  ="):
        return
    check_header(
        block != b"",
        "empty-file",
        "expected a FITS file; got a gzip file with no content: copy the file again",
    )
    check_header(
        len(block) >= 9 or not block.startswith(b"SIMPLE"[: len(block)]),
        "truncated-header",
        f"expected a FITS header; the file stops after {len(block)} bytes: copy the file again",
    )
    is_text = all(byte in b"\t\r\n" or 32 <= byte < 127 for byte in block[:256])
    unknown = "a text file" if is_text else f"bytes {block[:8]!r}"
    got = next((name for start, name in _KNOWN_STARTS if block.startswith(start)), unknown)
    raise HeaderError("not-fits", f"expected a FITS file, which starts with 'SIMPLE  ='; got {got}")


def _parse(raw: bytes, hdu: int) -> Header:
    # astropy.io.fits takes half a second to import; the web process loads it when the first FITS file arrives.
    from astropy.io.fits import Header

    try:
        return Header.fromstring(raw)
    except card_trouble() as error:
        raise HeaderError("bad-card", f"expected readable cards in HDU {hdu}; got: {error!s:.100}") from None


def _kind(header: Header, hdu: int) -> str:
    """Kind of an HDU: "image" (two axes), "empty", "line" (one axis), "cube n" (n axes), "table" or "other"."""
    extension = "IMAGE" if hdu == 0 else card_text(header, "XTENSION")
    if hdu > 0:
        check_counts(header)
    z = "Z" if extension == "BINTABLE" and card_flag(header, "ZIMAGE") else ""
    if not z and extension in ("BINTABLE", "TABLE", "A3DTABLE"):
        return "table"
    if not z and extension not in ("IMAGE", "IUEIMAGE"):
        return "other"
    axes = card_count(header, f"{z}NAXIS", largest=999)
    return {0: "empty", 1: "line", 2: "image"}.get(axes, f"cube {axes}")


def _check_image(header: Header, limits: FitsLimits) -> None:
    """Raise HeaderError if size, codec or tiles of an image are not allowed."""
    z = "Z" if card_flag(header, "ZIMAGE") else ""
    bitpix = card_count(header, f"{z}BITPIX", smallest=-64, largest=64)
    check_card(bitpix in _BITPIX, f"{z}BITPIX of {_BITPIX}", bitpix)
    nx, ny = (card_count(header, f"{z}NAXIS{axis}") for axis in (1, 2))
    check_header(
        nx > 0 and ny > 0,
        "zero-size",
        f"expected at least one pixel on each axis; got {nx} x {ny}: use another image",
    )
    if nx * ny > limits.max_pixels:
        raise HeaderError(
            "too-many-pixels",
            f"expected at most {limits.max_pixels} pixels; got {nx} x {ny} = {nx * ny}: use a smaller image",
        )
    if z:
        check_compression(header, nx, ny)
    else:  # the data of an image contain its pixels alone (FITS standard 4.0, section 7.1.1)
        for key, value in (("PCOUNT", 0), ("GCOUNT", 1)):
            card_count(header, key, smallest=value, largest=value, default=value)
