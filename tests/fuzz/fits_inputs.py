"""FITS files with damaged cards and bytes, made from a seed: equal seeds give equal files."""

from __future__ import annotations

import gzip
import io
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from astropy.io import fits

from psfcore.fits.psfs import write_psf
from psfcore.psf import FittedShape
from tests.psfcore.conftest import gaussian, make_psf

CARD = 80
NUMBERS = (
    *(
        -(2**63),
        -(2**31),
        -1000,
        -64,
        -32,
        -2,
        -1,
        0,
        1,
        2,
        3,
        4,
        5,
        7,
        8,
        9,
        15,
        16,
        17,
        31,
        32,
        33,
        64,
        255,
        256,
        999,
    ),
    *(1000, 4096, 10_000, 10_001, 2**15, 2**16, 2**24, 2**31 - 1, 2**31, 2**32, 2**40, 2**62, 2**63, 10**30),
)
TEXTS = (
    *(
        "T",
        "F",
        "''",
        "'x'",
        "nan",
        "inf",
        "1E400",
        "-1.5",
        "1E-300",
        "(1,2)",
        "&",
        "",
        "'RICE_1'",
        "'GZIP_1'",
        "'GZIP_2'",
    ),
    *(
        "'NOCOMPRESS'",
        "'HCOMPRESS_1'",
        "'PLIO_1'",
        "'RICE_ONE'",
        "'1PB(9)'",
        "'1PI'",
        "'1QB'",
        "'1PD'",
        "'999999999J'",
    ),
    *(
        "'PX'",
        "'1D'",
        "'SUBTRACTIVE_DITHER_1'",
        "'SUBTRACTIVE_DITHER_2'",
        "'NO_DITHER'",
        "'BYTEPIX'",
        "'BLOCKSIZE'",
    ),
    *(
        "'HPLN-SIP'",
        "'RA---TPV'",
        "'HPLT-CAR'",
        "'STOKES'",
        "'FREQ-LOG'",
        "'WAVE-TAB'",
        "'furlong'",
        "'10**400 m'",
    ),
    *(
        "'$\\frac{$'",
        "'a$b$c'",
        "'BINTABLE'",
        "'IMAGE'",
        "'TABLE'",
        "'2020-01-01T00:00:00'",
        "'not closed",
        "3 2 x",
    ),
)
ADDED = (
    *(
        "ZNAME1",
        "ZVAL1",
        "ZNAME2",
        "ZVAL2",
        "ZNAME3",
        "ZVAL3",
        "ZDITHER0",
        "ZQUANTIZ",
        "ZBLANK",
        "BLANK",
        "BSCALE",
    ),
    *(
        "BZERO",
        "THEAP",
        "TSCAL1",
        "TZERO1",
        "TDIM1",
        "TNULL1",
        "TFORM2",
        "TTYPE2",
        "ZTILE1",
        "ZTILE2",
        "ZTILE3",
        "ZNAXIS3",
    ),
    *(
        "ZMASKCMP",
        "GROUPS",
        "PCOUNT",
        "GCOUNT",
        "EXTNAME",
        "EXTVER",
        "TFIELDS",
        "NAXIS3",
        "CHECKSUM",
        "DATASUM",
        "INHERIT",
    ),
    *(
        "PSFNAME",
        "PSFVERS",
        "INSTRUME",
        "DETECTOR",
        "DATE-OBS",
        "DATE-BEG",
        "BUNIT",
        "SATURATE",
        "CDELT1",
        "CUNIT1",
    ),
    *(
        "WCSAXES",
        "CTYPE1",
        "CTYPE9",
        "CRPIX1",
        "CRVAL2",
        "CROTA2",
        "PC1_2",
        "CD1_900",
        "PV2_999",
        "LONPOLE",
        "A_ORDER",
        "CUNIT2",
    ),
    *(
        "HISTORY",
        "COMMENT",
        "CONTINUE",
        "HIERARCH",
        "END",
        "",
        "DP1",
        "LONGSTRN",
        "GAINCOMB",
        "XPOSURE",
        "PXBEG1",
    ),
)


def compressed_image(seed: int) -> bytes:
    """A tile-compressed image with one to four faults in its header, its rows or its heap."""
    rng = np.random.default_rng([1, seed])
    bases = _compressed_bases()
    return _damaged(bases[int(rng.integers(len(bases)))], rng, first_card=_second_header)


def plain_image(seed: int) -> bytes:
    """An image, or a PSF as heliopsf writes it, with one to four faults in any header; sometimes as gzip, or bytes of
    no file."""
    rng = np.random.default_rng([2, seed])
    bases, kind = _plain_bases(), rng.random()
    if kind < 0.05:
        return (b"", b"SIMPLE  =", b"\x1f\x8b\x08")[int(rng.integers(3))] + rng.bytes(int(rng.integers(6000)))
    content = _damaged(bases[int(rng.integers(len(bases)))], rng, first_card=lambda _: 0)
    return gzip.compress(content) if kind < 0.2 else content


def _damaged(base: bytes, rng: np.random.Generator, *, first_card) -> bytes:  # type: ignore[no-untyped-def]
    content = bytearray(base)
    start = first_card(base)
    for _ in range(int(rng.integers(1, 5))):
        cards = _cards(bytes(content), start)
        if not cards:
            break
        at = int(rng.choice(cards))
        match int(rng.integers(10)):
            case 0 | 1 | 2 | 3:
                _put(content, at, bytes(content[at : at + 8]), _value(rng))
            case 4:
                _put(content, at, str(rng.choice(ADDED)).ljust(8).encode(), _value(rng))
            case 5:
                content[at : at + CARD] = content[(other := int(rng.choice(cards))) : other + CARD]
            case 6:
                content[at : at + CARD] = b" " * CARD
            case 7:
                low = at + int(rng.integers(CARD))
                junk = rng.bytes(int(rng.integers(1, 12)))
                content[low : low + len(junk)] = junk
            case 8:
                low = int(rng.integers(len(content)))
                junk = rng.bytes(int(rng.integers(1, 9)))
                content[low : low + len(junk)] = junk
            case _:
                if rng.random() < 0.2:
                    del content[int(rng.integers(len(content))) :]
    return bytes(content)


def _value(rng: np.random.Generator) -> bytes:
    if rng.random() < 0.6:
        return f"{rng.choice(np.array(NUMBERS, dtype=object)):>20}".encode()
    return str(rng.choice(TEXTS)).encode()


def _put(content: bytearray, at: int, key: bytes, value: bytes) -> None:
    content[at : at + CARD] = (key[:8].ljust(8) + b"= " + value).ljust(CARD)[:CARD]


def _cards(content: bytes, start: int) -> list[int]:
    """The places of the cards of all headers from `start`."""
    found, at, inside = [], start, True
    while at + CARD <= len(content):
        card = content[at : at + CARD]
        if not inside and at % 2880 == 0 and card.startswith((b"XTENSION", b"SIMPLE ")):
            inside = True
        if inside:
            found.append(at)
            inside = not card.startswith(b"END ")
        at += CARD
    return found


def _second_header(content: bytes) -> int:
    return content.index(b"XTENSION")


@cache
def _compressed_bases() -> tuple[bytes, ...]:
    rng = np.random.default_rng(0)
    bases = []
    for codec in ("RICE_1", "GZIP_1", "GZIP_2", "NOCOMPRESS"):
        for dtype in ("u1", "i2", "i4", "f4", "f8"):
            pixels = rng.integers(1, 120, (64, 67)).astype(dtype)
            ways: list[dict[str, float]] = [{}]
            if dtype.startswith("f"):
                pixels += rng.normal(0, 3, pixels.shape).astype(dtype)
                ways = [{"quantize_level": 16.0, "quantize_method": q, "dither_seed": 7} for q in (1, 2)]
                ways += [] if codec == "RICE_1" else [{"quantize_level": 0.0}]
            for options, tile in product(ways, ((1, 67), (20, 30))):
                hdu = fits.CompImageHDU(pixels, compression_type=codec, tile_shape=tile, **options)
                bases.append(_written([fits.PrimaryHDU(), hdu]))
    return tuple(bases)


@cache
def _plain_bases() -> tuple[bytes, ...]:
    rng = np.random.default_rng(0)
    bases = []
    header = fits.Header({"TELESCOP": "SOLO", "INSTRUME": "EUI", "DETECTOR": "HRI_EUV", "WAVELNTH": 174})
    header.update({"DATE-BEG": "2022-03-17T00:00:00", "XPOSURE": 2.0, "CDELT1": 0.492, "CUNIT1": "arcsec"})
    header.update(
        {"CTYPE1": "HPLN-TAN", "CTYPE2": "HPLT-TAN", "CDELT2": 0.492, "CUNIT2": "arcsec", "CRPIX1": 33}
    )
    header.update({"GAINCOMB": "combined", "PXBEG1": 1, "PXEND1": 66, "LONG": "x" * 100, "BUNIT": "DN/s"})
    header["HIERARCH a long key"] = 3.5
    header.add_history("made")
    for dtype in ("u1", "i2", "i4", "i8", "f4", "f8"):
        pixels = rng.integers(1, 120, (64, 66)).astype(dtype)
        bases.append(_written([fits.PrimaryHDU(pixels, header)]))
        bases.append(_written([fits.PrimaryHDU(), fits.ImageHDU(pixels, header), fits.ImageHDU(pixels)]))
    return (*bases, _psf(), _psf())


def _psf() -> bytes:
    """A PSF with components and tables, as heliopsf writes it."""
    kernel = gaussian(64, 1.5)
    fit = FittedShape("softened-power-law", ("b_px", "c"), (1.0, 2.0), ((1.0, 0.0), (0.0, 1.0)))
    psf = make_psf(kernel, name="mine", status="draft", components={"SCATTER": kernel}, fitted=fit)
    with TemporaryDirectory() as folder:
        write_psf(Path(folder) / "psf.fits", psf, instrument_file=b'name = "mine"')
        return (Path(folder) / "psf.fits").read_bytes()


def _written(hdus: list[fits.PrimaryHDU]) -> bytes:
    file = io.BytesIO()
    fits.HDUList(hdus).writeto(file)
    return file.getvalue()
