"""Check the header of a tile-compressed image, before astropy reads its tiles in a process of its own
(`psfcore.limited`).

Source: FITS standard 4.0 (Pence et al. 2010; IAU FITS working group 2018), sections 7.3 and 10.1. The decoders of
astropy are C functions that trust some cards. With BYTEPIX = 8, the decoder of RICE_1 returns twice the number of bytes
that it has written. With a large BLOCKSIZE, it reads and writes past its buffers. With dithering and an invalid
ZDITHER0, astropy reads outside the table of random numbers. The pixels would be wrong without an error, so these cards
must have values that the standard allows. Other wrong cards make the process of the decoder fail.

This module reads no data, so the web process can import it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from psfcore.fits.cards import bad_card, card_count, card_text, card_value, check_card, check_header

if TYPE_CHECKING:
    from astropy.io.fits import Header

MOST_COLUMNS = 999  # section 7.2.1: the largest TFIELDS
ALLOWED_CODECS = ("RICE_1", "GZIP_1", "GZIP_2", "NOCOMPRESS")
MOST_TILES = 65_536  # astropy decodes tile by tile in Python, about 0.1 ms each
_RICE_BYTEPIX, _RICE_BLOCKSIZE = (1, 2, 4), (16, 32)  # section 10.4.1
_SETTINGS = ("BLOCKSIZE", "BYTEPIX", "NOISEBIT", "SCALE", "SMOOTH")
_DITHERS = ("SUBTRACTIVE_DITHER_1", "SUBTRACTIVE_DITHER_2")
_NO_DITHERS = (None, "NO_DITHER", "NONE")
_LARGEST_SEED = 10_000  # section 10.2: the largest value of ZDITHER0
_LARGEST_INT = 2**31 - 1


def check_counts(header: Header) -> None:
    """Raise HeaderError "bad-card" if TFIELDS or ZNAXIS of an HDU is larger than the standard allows."""
    for key in ("TFIELDS", "ZNAXIS"):
        card_count(header, key, largest=MOST_COLUMNS, default=0)


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
    _check_tiling(header, nx, ny)
    _check_settings(header, codec)
    _check_dither(header)


def may_hold_unwritten_memory(header: Header) -> bool:
    """Whether astropy may give pixels that it did not write: scaled pixels that are stored with 8 bytes each."""
    names = (
        card_text(header, f"TTYPE{number}")
        for number in range(1, card_count(header, "TFIELDS", default=0) + 1)
    )
    return card_text(header, "ZCMPTYPE") != "RICE_1" and "ZSCALE" in names


def _check_tiling(header: Header, nx: int, ny: int) -> None:
    tile_x, tile_y = card_count(header, "ZTILE1", default=nx), card_count(header, "ZTILE2", default=1)
    check_header(
        1 <= tile_x <= _LARGEST_INT and 1 <= tile_y <= _LARGEST_INT,
        "bad-tiles",
        f"expected tiles of 1 to {_LARGEST_INT} pixels on each axis; got {tile_x} x {tile_y}: copy or make the file "
        "again",
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
        stored <= most,  # type: ignore[operator]  # a number, by the check above
        f"BYTEPIX of at most {most}, the bytes of a pixel with ZBITPIX = {bitpix}",
        stored,
    )


def _check_dither(header: Header) -> None:
    method = card_text(header, "ZQUANTIZ")
    if card_value(header, "ZQUANTIZ") is not None and method not in (*_DITHERS, *_NO_DITHERS):
        raise bad_card(f"ZQUANTIZ of {', '.join((*_DITHERS, 'NO_DITHER'))}", f"{method!r:.40}")
    smallest, default = (1, None) if method in _DITHERS else (0, 0)
    card_count(header, "ZDITHER0", smallest=smallest, largest=_LARGEST_SEED, default=default)
    card_count(header, "ZBLANK", smallest=-_LARGEST_INT - 1, largest=_LARGEST_INT, default=0)
