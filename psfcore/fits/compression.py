"""Check the header of a binary table and of a tile-compressed image in it, before astropy reads the data.

Source: FITS standard 4.0 (Pence et al. 2010; IAU FITS working group 2018), sections 7.3 and 10.1. The decoders of
astropy are C functions that trust the header. With BYTEPIX = 8, the decoder of RICE_1 returns twice the number of bytes
that it has written; the second half is arbitrary memory of the process. With a large BLOCKSIZE, it reads and writes
past its buffers. With dithering and an invalid ZDITHER0, astropy reads outside the table of random numbers. Therefore
every card on which a decoder depends must have a value that the standard allows.

astropy makes an object for each column that TFIELDS declares, and reserves the memory that the cards TFORMn declare for
each row, even if the file is shorter. Therefore this module limits TFIELDS and compares the columns with the size of a
row. It reads no data, so the web process can import it.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from psfcore.fits.cards import bad_card, card_count, card_text, card_value, check_card, check_header

if TYPE_CHECKING:
    from astropy.io.fits import Header

MOST_COLUMNS = 999  # section 7.2.1: the largest TFIELDS
ITEM_BYTES = {
    **dict.fromkeys("LBA", 1), "I": 2, **dict.fromkeys("JE", 4), **dict.fromkeys("KDCP", 8), **dict.fromkeys("MQ", 16),
}  # fmt: skip
_FORM = re.compile(r"(\d{0,9})([LXBIJKAEDCMPQ])([LXBIJKAEDCM]?)(\(\d{1,18}\))?")
ALLOWED_CODECS = ("RICE_1", "GZIP_1", "GZIP_2", "NOCOMPRESS")
MOST_TILES = 65_536  # astropy decodes tile by tile in Python, about 0.1 ms each
COMPRESSED, GZIPPED, UNCOMPRESSED = "COMPRESSED_DATA", "GZIP_COMPRESSED_DATA", "UNCOMPRESSED_DATA"
_RICE_BYTEPIX, _RICE_BLOCKSIZE = (1, 2, 4), (16, 32)  # section 10.4.1
_SETTINGS = ("BLOCKSIZE", "BYTEPIX", "NOISEBIT", "SCALE", "SMOOTH")
_DITHERS = ("SUBTRACTIVE_DITHER_1", "SUBTRACTIVE_DITHER_2")
_NO_DITHERS = (None, "NO_DITHER", "NONE")
_LARGEST_SEED = 10_000  # section 10.2: the largest value of ZDITHER0
_LARGEST_INT = 2**31 - 1
_ITEMS_OF = {COMPRESSED: "BIJ", GZIPPED: "BIJ", UNCOMPRESSED: "BIJED"}
_NUMBERS_OF = {"ZSCALE": "ED", "ZZERO": "ED", "ZBLANK": "BIJ"}
_NUMBERS = "LBIJKED"  # the allowed types of a column that the decoders do not use


@dataclass(frozen=True)
class Column:
    """A column: its name in capitals, and its format (table 18 of the standard).

    repeat: items in a row. form: the letter of the type. item: for P and Q, the letter of the type in the heap.
    """

    name: str
    repeat: int
    form: str
    item: str

    @property
    def row_bytes(self) -> int:
        """Bytes of this column in one row."""
        return -(-self.repeat // 8) if self.form == "X" else self.repeat * ITEM_BYTES[self.form]

    @property
    def in_heap(self) -> bool:
        """Whether a row holds descriptors (length, offset) of data in the heap."""
        return self.form in "PQ"

    def __str__(self) -> str:
        return f"{self.name:.40} {self.repeat}{self.form}{self.item}"


def check_counts(header: Header) -> None:
    """Raise HeaderError "bad-card" if TFIELDS or ZNAXIS of an HDU is larger than the standard allows."""
    for key in ("TFIELDS", "ZNAXIS"):
        card_count(header, key, largest=MOST_COLUMNS, default=0)


def read_columns(header: Header) -> list[Column]:
    """The columns of a binary table.

    Raises HeaderError "bad-card" if a format cannot be read, if two columns have one name, or if the columns do not need
    exactly the NAXIS1 bytes of a row.
    """
    columns: list[Column] = []
    names: set[str] = set()
    for number in range(1, card_count(header, "TFIELDS", largest=MOST_COLUMNS) + 1):
        name = (card_text(header, f"TTYPE{number}") or f"column {number}").upper()
        text = card_text(header, f"TFORM{number}")
        form = None if text is None else _FORM.fullmatch(text.upper())
        if form is None or (form[2] in "PQ") != bool(form[3]):
            raise bad_card(f"TFORM{number} to be a binary format", f"{text!r:.40}")
        check_card(name not in names, "each column once", f"{name:.40} again as column {number}")
        names.add(name)
        columns.append(Column(name, int(form[1] or 1), form[2], form[3]))
    row_bytes = sum(column.row_bytes for column in columns)
    card_count(header, "NAXIS1", smallest=row_bytes, largest=row_bytes)
    return columns


def check_compression(header: Header, nx: int, ny: int) -> None:
    """Check how the image of nx x ny pixels in a table with ZIMAGE = T is stored.

    Raises HeaderError "codec-not-allowed", "bad-tiles", "bad-card".
    """
    codec = card_text(header, "ZCMPTYPE")
    check_header(
        codec in ALLOWED_CODECS,
        "codec-not-allowed",
        f"expected compression by one of {', '.join(ALLOWED_CODECS)}; got {codec}: decompress the file (funpack)",
    )
    _check_keywords(header)
    _check_tiling(header, nx, ny)
    _check_settings(header, codec)
    _check_columns(header)
    _check_dither(header)
    _check_heap(header)


def may_hold_unwritten_memory(header: Header) -> bool:
    """Whether astropy may give pixels that it did not write: scaled pixels that are stored with 8 bytes each."""
    return card_text(header, "ZCMPTYPE") != "RICE_1" and any(
        column.name == "ZSCALE" for column in read_columns(header)
    )


def _check_keywords(header: Header) -> None:
    """Raise HeaderError "bad-card" for a keyword that astropy takes as a pattern when it removes the cards of the table.

    A pattern may remove other cards, may be an invalid expression, or may take long to compare.
    """
    for keyword in header:
        if set("*?") & set(keyword) or keyword.endswith("..."):
            raise bad_card("keywords without '*', '?' and '...'", f"{keyword!r:.40}")


def _check_tiling(header: Header, nx: int, ny: int) -> None:
    tile_x, tile_y = card_count(header, "ZTILE1", default=nx), card_count(header, "ZTILE2", default=1)
    check_header(
        1 <= tile_x <= _LARGEST_INT and 1 <= tile_y <= _LARGEST_INT,
        "bad-tiles",
        f"expected tiles of 1 to {_LARGEST_INT} pixels on each axis; got {tile_x} x {tile_y}: copy or make the file again",
    )
    tiles = math.prod(-(-n // tile) for n, tile in ((nx, tile_x), (ny, tile_y)))
    rows = card_count(header, "NAXIS2")
    check_header(
        rows == tiles,
        "bad-tiles",
        f"expected one table row per tile, {tiles} rows for {nx} x {ny} pixels; got {rows}: copy or make the file "
        "again",
    )
    check_header(
        tiles <= MOST_TILES,
        "bad-tiles",
        f"expected at most {MOST_TILES} tiles; got {tiles}: use larger tiles",
    )


def _check_settings(header: Header, codec: str | None) -> None:
    """Check the parameters ZNAMEn = ZVALn of the codec. Each name may occur once."""
    settings: dict[str, object] = {}
    for number in range(1, MOST_COLUMNS + 1):
        if card_value(header, f"ZNAME{number}") is None:
            break
        name = (card_text(header, f"ZNAME{number}") or "").upper()
        value = card_value(header, f"ZVAL{number}")
        check_card(
            name in _SETTINGS and name not in settings,
            f"ZNAME{number} of {', '.join(_SETTINGS)}, each once",
            f"{name!r:.40}",
        )
        check_card(
            isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= _LARGEST_INT,
            f"a number in ZVAL{number} ({name})",
            f"{value!r:.40}",
        )
        settings[name] = value
    if codec == "RICE_1":
        _check_rice(settings, card_count(header, "ZBITPIX", smallest=-64, largest=64))


def _check_rice(settings: dict[str, object], bitpix: int) -> None:
    for name, allowed in (("BYTEPIX", _RICE_BYTEPIX), ("BLOCKSIZE", _RICE_BLOCKSIZE)):
        value = settings.get(name, allowed[0])
        check_card(
            isinstance(value, int) and value in allowed, f"{name} of {allowed} for RICE_1", f"{value!r:.40}"
        )
    most, stored = abs(bitpix) // 8, settings.get("BYTEPIX", 0)
    check_card(
        stored <= most,  # type: ignore[operator]
        f"BYTEPIX of at most {most}, the bytes of a pixel with ZBITPIX = {bitpix}",
        stored,
    )


def _check_columns(header: Header) -> None:
    columns = read_columns(header)
    for number, column in enumerate(columns, start=1):
        is_data = column.name in _ITEMS_OF
        types = _ITEMS_OF[column.name] if is_data else _NUMBERS_OF.get(column.name, _NUMBERS)
        expected = f"{'1P or 1Q' if is_data else 'one number'} of {', '.join(types)}"
        check_card(
            column.repeat == 1 and column.in_heap == is_data and (column.item or column.form) in types,
            f"column {column.name:.40} as {expected}",
            column,
        )
        for key in (f"TSCAL{number}", f"TZERO{number}", f"TDIM{number}"):
            check_card(card_value(header, key) is None, f"no card {key} in a compressed image", "one")
    names = {column.name for column in columns}
    check_card(COMPRESSED in names, f"a column {COMPRESSED} in a compressed image", "none")
    check_card(
        ("ZSCALE" in names) == ("ZZERO" in names), "both columns ZSCALE and ZZERO, or neither", "one of them"
    )


def _check_dither(header: Header) -> None:
    method = card_text(header, "ZQUANTIZ")
    if card_value(header, "ZQUANTIZ") is not None and method not in (*_DITHERS, *_NO_DITHERS):
        raise bad_card(f"ZQUANTIZ of {', '.join((*_DITHERS, 'NO_DITHER'))}", f"{method!r:.40}")
    smallest, default = (1, None) if method in _DITHERS else (0, 0)
    card_count(header, "ZDITHER0", smallest=smallest, largest=_LARGEST_SEED, default=default)
    card_count(header, "ZBLANK", smallest=-_LARGEST_INT - 1, largest=_LARGEST_INT, default=0)


def _check_heap(header: Header) -> None:
    """The heap of compressed tiles follows the rows of the table (FITS standard, section 7.3.5)."""
    for key, value in (("BITPIX", 8), ("NAXIS", 2), ("GCOUNT", 1)):
        card_count(header, key, smallest=value, largest=value)
    rows = card_count(header, "NAXIS1") * card_count(header, "NAXIS2")
    card_count(header, "THEAP", smallest=rows, largest=rows + card_count(header, "PCOUNT"), default=rows)
