"""What a FITS file's headers show, read without touching a pixel.

FITS standard 4.0 (Pence et al. 2010; IAU FITS working group 2018), sections 3.3, 4.4 and 10.1. Headers are
walked in blocks of 2880 bytes; data are skipped by the size that NAXISn, BITPIX, PCOUNT and GCOUNT declare.
Taken is the first two-dimensional image: a plain image HDU, or a tile-compressed one in a binary table with
ZIMAGE = T. Only its header counts; what follows it in the file is not looked at.

A file compressed as a whole (.fits.gz) can only be read by inflating it: the sizes declared are checked
before they are passed over, and the bytes inflated are bounded.
"""

from __future__ import annotations

import gzip
import io
import math
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from astropy.io.fits import Header
from astropy.io.fits.verify import VerifyError

from psfcore.errors import HeaderError
from psfcore.instruments.files import match_instrument

BLOCK_BYTES = 2880
CARD_BYTES = 80
ALLOWED_CODECS = ("RICE_1", "GZIP_1", "GZIP_2", "NOCOMPRESS")
_BITPIX = (8, 16, 32, 64, -32, -64)
_LARGEST_COUNT = 2**63 - 1
_SKIP_BYTES = 1 << 20
_ARCSEC_PER_UNIT = {"arcsec": 1.0, "arcmin": 60.0, "deg": 3600.0, "degree": 3600.0}
_END = b"END" + b" " * 77
# What reading a damaged card raises, depending on how it is damaged.
_CARD_TROUBLE = (VerifyError, ValueError, TypeError, IndexError, OverflowError)
_KNOWN_STARTS = (
    (b"\x00\x00\x00\x0cjP", "a JPEG 2000 file"),
    (b"\xff\x4f\xff\x51", "a JPEG 2000 codestream"),
    (b"\x89PNG", "a PNG file"),
    (b"\xff\xd8\xff", "a JPEG file"),
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
    """Bounds on what is read: pixels of an image or of a tile, bytes of all headers together, HDUs passed."""

    max_pixels: int
    max_header_bytes: int = 4 * 1024 * 1024
    max_hdus: int = 64


@dataclass(frozen=True)
class HeaderSummary:
    """The image chosen and what its header says of it; None where a card is missing or unusable."""

    hdu: int
    shape: tuple[int, int]
    bitpix: int
    codec: str | None
    gzipped: bool
    instrument: str | None
    telescop: str | None
    instrume: str | None
    detector: str | None
    wavelnth: float | None
    date_obs: str | None
    exposure_s: float | None
    unit: str | None
    cdelt1: float | None
    cdelt2: float | None
    gain_mode: str | None
    pxbeg: tuple[int, int] | None
    pxend: tuple[int, int] | None
    psf_name: str | None
    psf_version: str | None


def read_summary(path: str | os.PathLike[str], limits: FitsLimits) -> HeaderSummary:
    """The first 2-D image of the file at `path`; HeaderError says what is wrong with it otherwise."""
    with _opened(Path(path), limits) as source:
        header, hdu = _first_image(source, limits)
        return _summary(header, hdu, source.gzipped)


def first_image_header(path: str | os.PathLike[str], limits: FitsLimits) -> Header:
    """The header of the first 2-D image of the file at `path`, as it stands; HeaderError as for `read_summary`."""
    with _opened(Path(path), limits) as source:
        return _first_image(source, limits)[0]


def check_all_headers(path: str | os.PathLike[str], limits: FitsLimits) -> None:
    """HeaderError where a file does not keep the limits to its end: before all its HDUs are read, not the first image alone."""
    with _opened(Path(path), limits) as source:
        for _header, _hdu, _kind in _walk(source, limits, to_the_end=True):
            pass


# --- the walk ---------------------------------------------------------------------------------------------


class _Source(Protocol):
    """Bytes in order: read some, or pass over some."""

    gzipped: bool

    def read(self, count: int) -> bytes: ...

    def skip(self, count: int) -> int: ...


class _PlainSource:
    gzipped = False

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = os.fstat(file.fileno()).st_size

    def read(self, count: int) -> bytes:
        return self._file.read(count)

    def skip(self, count: int) -> int:
        """Bytes of the next `count` that are there; the position moves on by `count` regardless."""
        there = max(0, min(count, self._size - self._file.tell()))
        self._file.seek(there, io.SEEK_CUR)
        return there


class _GzipSource:
    gzipped = True

    def __init__(self, file: BinaryIO, budget_bytes: int) -> None:
        self._stream = gzip.GzipFile(fileobj=file, mode="rb")
        self._left = budget_bytes

    def read(self, count: int) -> bytes:
        self._left -= count
        if self._left < 0:
            raise HeaderError("too-many-bytes", "expected less data than the limit after inflating; got more")
        try:
            return self._stream.read(count)
        except EOFError:
            raise HeaderError("truncated-gzip", "expected a whole gzip stream; it stops short") from None
        except (OSError, zlib.error) as error:
            raise HeaderError("bad-gzip", f"expected a readable gzip stream; got: {error}") from None

    def skip(self, count: int) -> int:
        there = 0
        while there < count:
            chunk = self.read(min(_SKIP_BYTES, count - there))
            if not chunk:
                break
            there += len(chunk)
        return there


@contextmanager
def _opened(path: Path, limits: FitsLimits) -> Iterator[_Source]:
    with path.open("rb") as file:
        start = file.read(2)
        file.seek(0)
        if not start:
            raise HeaderError("empty-file", "expected a FITS file; got an empty file")
        if start == b"\x1f\x8b":
            yield _GzipSource(file, limits.max_pixels * 16 + limits.max_hdus * limits.max_header_bytes)
        else:
            yield _PlainSource(file)


def _first_image(source: _Source, limits: FitsLimits) -> tuple[Header, int]:
    seen: list[str] = []
    for header, hdu, kind in _walk(source, limits, to_the_end=False):
        if kind == "image":
            return header, hdu
        seen.append(kind)
    raise _no_image(seen)


def _walk(source: _Source, limits: FitsLimits, *, to_the_end: bool) -> Iterator[tuple[Header, int, str]]:
    """Each HDU's header, number and kind; to the first image, or to the end of the file."""
    header_bytes = 0
    for hdu in range(limits.max_hdus):
        raw = _read_header(source, limits.max_header_bytes - header_bytes, limits, first=hdu == 0)
        if raw is None:
            return
        header_bytes += len(raw)
        header = _parse(raw, hdu)
        kind = _kind(header, hdu)
        last = kind == "image" and not to_the_end
        if last:
            _check_image(header, limits)
        _pass_data(source, header, hdu, limits, last=last)
        yield header, hdu, kind
        if last:
            return
    if not to_the_end or source.read(1):
        message = f"expected at most {limits.max_hdus} HDUs, an image among them; got more"
        raise HeaderError("too-many-hdus", message)


def _no_image(seen: list[str]) -> HeaderError:
    wanted = "expected a two-dimensional image"
    if any(kind.startswith("cube") for kind in seen):
        axes = next(kind for kind in seen if kind.startswith("cube")).split()[1]
        code = "three-axes" if axes == "3" else "not-2d"
        return HeaderError(code, f"{wanted}; got an image of {axes} axes")
    if "line" in seen:
        return HeaderError("not-2d", f"{wanted}; got an image of one axis")
    if "table" in seen:
        return HeaderError("table-only", f"{wanted}; got only tables ({len(seen)} HDUs)")
    return HeaderError("no-image", f"{wanted}; got {len(seen)} HDUs without data of two axes")


def _read_header(source: _Source, most: int, limits: FitsLimits, *, first: bool) -> bytes | None:
    """Cards up to END within ``most`` bytes, or None where the file ends before another header starts."""
    raw = bytearray()
    while len(raw) < most:
        block = source.read(BLOCK_BYTES)
        if not raw and first:
            _check_start(block)
        elif not raw and (len(block) < 8 or not block.startswith(b"XTENSION")):
            return None  # the end of the file, or special records and padding after the last HDU
        end = _find_end(block)
        raw += block if end is None else block[:end]
        if end is not None:
            return bytes(raw)
        if len(block) < BLOCK_BYTES:
            message = f"expected an END card; the file stops after {len(raw)} bytes of this header"
            raise HeaderError("truncated-header", message)
    message = f"expected headers of at most {limits.max_header_bytes} bytes, with an END card each; got more"
    raise HeaderError("header-too-long", message)


def _find_end(block: bytes) -> int | None:
    for at in range(0, len(block) - CARD_BYTES + 1, CARD_BYTES):
        if block[at : at + CARD_BYTES] == _END:
            return at
    return None


def _check_start(block: bytes) -> None:
    if block.startswith(b"SIMPLE  ="):
        return
    if not block:
        raise HeaderError("empty-file", "expected a FITS file; got a gzip file of nothing")
    if block.startswith(b"SIMPLE"[: len(block)]) and len(block) < 9:
        raise HeaderError(
            "truncated-header", f"expected a FITS header; the file stops after {len(block)} bytes"
        )
    got = next((name for start, name in _KNOWN_STARTS if block.startswith(start)), None)
    if got is None:
        text = all(byte in b"\t\r\n" or 32 <= byte < 127 for byte in block[:256])
        got = "a text file" if text else f"bytes {block[:8]!r}"
    raise HeaderError("not-fits", f"expected a FITS file, which starts with 'SIMPLE  ='; got {got}")


def _parse(raw: bytes, hdu: int) -> Header:
    try:
        return Header.fromstring(raw)
    except _CARD_TROUBLE as error:
        raise HeaderError("bad-card", f"expected readable cards in HDU {hdu}; got: {error!s:.100}") from None


def _kind(header: Header, hdu: int) -> str:
    """One of: image, empty, line, "cube n", table, other."""
    extension = "IMAGE" if hdu == 0 else _text(header, "XTENSION")
    if extension == "BINTABLE" and _flag(header, "ZIMAGE"):
        return _axes_kind(_count(header, "ZNAXIS", largest=999))
    if extension in ("BINTABLE", "TABLE", "A3DTABLE"):
        return "table"
    if extension not in ("IMAGE", "IUEIMAGE"):
        return "other"
    return _axes_kind(_count(header, "NAXIS", largest=999))


def _axes_kind(axes: int) -> str:
    return {0: "empty", 1: "line", 2: "image"}.get(axes, f"cube {axes}")


def _check_image(header: Header, limits: FitsLimits) -> None:
    """Sizes, codec and tiles of the image that would be read."""
    z = "Z" if _flag(header, "ZIMAGE") else ""
    bitpix = _count(header, f"{z}BITPIX", smallest=-64, largest=64)
    if bitpix not in _BITPIX:
        raise HeaderError("bad-card", f"expected {z}BITPIX of {_BITPIX}; got {bitpix}")
    nx, ny = (_count(header, f"{z}NAXIS{axis}") for axis in (1, 2))
    if nx == 0 or ny == 0:
        raise HeaderError("zero-size", f"expected at least one pixel on each axis; got {nx} x {ny}")
    if nx * ny > limits.max_pixels:
        message = f"expected at most {limits.max_pixels} pixels; got {nx} x {ny} = {nx * ny}"
        raise HeaderError("too-many-pixels", message)
    if z:
        _check_tiles(header, nx, ny, limits)


def _check_tiles(header: Header, nx: int, ny: int, limits: FitsLimits) -> None:
    codec = _text(header, "ZCMPTYPE")
    if codec not in ALLOWED_CODECS:
        wanted = ", ".join(ALLOWED_CODECS)
        raise HeaderError("codec-not-allowed", f"expected compression by one of {wanted}; got {codec}")
    tile_x = _count(header, "ZTILE1", default=nx)
    tile_y = _count(header, "ZTILE2", default=1)
    if not 1 <= tile_x * tile_y <= limits.max_pixels:
        message = f"expected tiles of 1 to {limits.max_pixels} pixels; got {tile_x} x {tile_y}"
        raise HeaderError("bad-tiles", message)
    tiles = math.prod(-(-n // tile) for n, tile in ((nx, tile_x), (ny, tile_y)))
    rows = _count(header, "NAXIS2")
    if rows != tiles:
        message = f"expected one table row a tile, {tiles} for {nx} x {ny} pixels; got {rows}"
        raise HeaderError("bad-tiles", message)


def _pass_data(source: _Source, header: Header, hdu: int, limits: FitsLimits, *, last: bool) -> None:
    size = _data_bytes(header, hdu)
    if source.gzipped and size > limits.max_pixels * 16:
        message = (
            f"expected at most {limits.max_pixels * 16} bytes of data in an HDU; HDU {hdu} declares {size}"
        )
        raise HeaderError("too-many-bytes", message)
    there = source.skip(size)
    if there < size:
        message = f"expected {size} bytes of data in HDU {hdu}, as its header declares; got {there}"
        raise HeaderError("truncated-data", message)
    if not last:
        source.skip(-size % BLOCK_BYTES)


def _data_bytes(header: Header, hdu: int) -> int:
    """Declared size, FITS standard Eq. (2): |BITPIX| / 8 * GCOUNT * (PCOUNT + prod NAXISn)."""
    bitpix = _count(header, "BITPIX", smallest=-64, largest=64)
    if bitpix not in _BITPIX:
        raise HeaderError("bad-card", f"expected BITPIX of {_BITPIX} in HDU {hdu}; got {bitpix}")
    axes = _count(header, "NAXIS", largest=999)
    if axes == 0:
        return 0
    if hdu == 0 and _flag(header, "GROUPS"):
        raise HeaderError("random-groups", "expected an image; got random groups (GROUPS = T)")
    elements = math.prod(_count(header, f"NAXIS{axis}") for axis in range(1, axes + 1))
    groups, extra = _count(header, "GCOUNT", default=1), _count(header, "PCOUNT", default=0)
    size = abs(bitpix) // 8 * groups * (extra + elements)
    if size > _LARGEST_COUNT:
        raise HeaderError(
            "bad-card", f"expected a data size that a file can have in HDU {hdu}; got {size:.3g}"
        )
    return size


# --- cards ------------------------------------------------------------------------------------------------


def _value(header: Header, key: str) -> object:
    """Value of a card that the structure depends on; it may stand once only."""
    try:
        if header.count(key) > 1:
            raise HeaderError("bad-card", f"expected card {key} once; got it {header.count(key)} times")
        return header[key]
    except KeyError:
        return None
    except HeaderError:
        raise
    except _CARD_TROUBLE:
        raise HeaderError("bad-card", f"expected a readable card {key}; got one that is not") from None


def _count(
    header: Header, key: str, *, smallest: int = 0, largest: int = _LARGEST_COUNT, default: int | None = None
) -> int:
    value = _value(header, key)
    if value is None and default is not None:
        return default
    if isinstance(value, bool) or not isinstance(value, int) or not smallest <= value <= largest:
        raise HeaderError(
            "bad-card", f"expected {key} = integer from {smallest} to {largest}; got {value!r:.40}"
        )
    return value


def _flag(header: Header, key: str) -> bool:
    return _value(header, key) is True


def _text(header: Header, key: str) -> str | None:
    value = _value(header, key)
    return value.strip() if isinstance(value, str) else None


def optional_text(header: Header, *keys: str) -> str | None:
    """The first of `keys` that holds a non-empty string, stripped."""
    for key in keys:
        value = _lenient(header, key)
        if isinstance(value, str) and value.strip():
            return value.strip()
    return None


def optional_number(header: Header, *keys: str) -> float | None:
    """The first of `keys` that holds a finite number."""
    for key in keys:
        value = _lenient(header, key)
        if isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300:
            return float(value)
    return None


def optional_value(header: Header, key: str) -> str | float | bool | None:
    """What a card says, as a text without blanks around it, a finite number, or yes or no."""
    value = _lenient(header, key)
    if isinstance(value, bool):
        return value
    number = optional_number(header, key)
    return optional_text(header, key) if number is None else number


def plate_scale_arcsec(header: Header, axis: int = 1) -> float | None:
    """|CDELT| of an axis in arcsec/px; None where there is none, or CUNIT is no angle. No CUNIT: arcsec."""
    step = optional_number(header, f"CDELT{axis}")
    factor = _ARCSEC_PER_UNIT.get((optional_text(header, f"CUNIT{axis}") or "arcsec").lower())
    return None if not step or factor is None else abs(step) * factor


def optional_exposure_s(header: Header) -> float | None:
    """XPOSURE or else EXPTIME, s, where it is above zero."""
    for key in ("XPOSURE", "EXPTIME"):
        exposure = optional_number(header, key)
        if exposure is not None and exposure > 0:
            return exposure
    return None


def _lenient(header: Header, key: str) -> object:
    """Value of a card that only describes: a damaged one counts as missing."""
    try:
        return header[key]
    except KeyError:
        return None
    except _CARD_TROUBLE:
        return None


def _pair(header: Header, stem: str) -> tuple[int, int] | None:
    first, second = (_lenient(header, f"{stem}{axis}") for axis in (1, 2))
    if isinstance(first, int) and isinstance(second, int):
        return int(first), int(second)
    return None


def _summary(header: Header, hdu: int, gzipped: bool) -> HeaderSummary:
    compressed = _flag(header, "ZIMAGE")
    z = "Z" if compressed else ""
    cards = {key: optional_text(header, key) for key in ("TELESCOP", "INSTRUME", "DETECTOR")}
    return HeaderSummary(
        hdu=hdu,
        shape=(_count(header, f"{z}NAXIS2"), _count(header, f"{z}NAXIS1")),
        bitpix=_count(header, f"{z}BITPIX", smallest=-64, largest=64),
        codec=_text(header, "ZCMPTYPE") if compressed else None,
        gzipped=gzipped,
        instrument=match_instrument(cards),
        telescop=cards["TELESCOP"],
        instrume=cards["INSTRUME"],
        detector=cards["DETECTOR"],
        wavelnth=optional_number(header, "WAVELNTH"),
        date_obs=optional_text(header, "DATE-BEG", "DATE-OBS"),
        exposure_s=optional_exposure_s(header),
        unit=optional_text(header, "BUNIT"),
        cdelt1=optional_number(header, "CDELT1"),
        cdelt2=optional_number(header, "CDELT2"),
        gain_mode=optional_text(header, "GAINCOMB"),
        pxbeg=_pair(header, "PXBEG"),
        pxend=_pair(header, "PXEND"),
        psf_name=optional_text(header, "PSFNAME"),
        psf_version=optional_text(header, "PSFVERS"),
    )
