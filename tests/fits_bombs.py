"""Small files that would inflate to very much data (bombs), for the tests of every layer."""

from __future__ import annotations

import gzip
import io

import numpy as np
from astropy.io import fits

HEADER_BLOCK = 2880


def padded(content: bytes, fill: bytes = b"\0") -> bytes:
    """The content padded to a whole number of FITS blocks."""
    return content + fill * (-len(content) % HEADER_BLOCK)


def gzip_named(content: bytes, length: int) -> bytes:
    """A gzip member whose file name has this length."""
    packed = gzip.compress(content)
    return packed[:3] + b"\x08" + packed[4:10] + b"n" * length + b"\0" + packed[10:]


def lying_tiles(stream: bytes, *, edge: int = 64, column: str = "COMPRESSED_DATA") -> bytes:
    """An image of edge x edge int16 in which every row refers to the same gzip stream."""
    names = ["COMPRESSED_DATA"] if column == "COMPRESSED_DATA" else ["COMPRESSED_DATA", column]
    rows = np.zeros(edge, dtype=[(name, ">i4", (2,)) for name in names])
    rows[column][:, 0] = len(stream)
    header = fits.Header({"XTENSION": "BINTABLE", "BITPIX": 8, "NAXIS": 2})
    header.update(NAXIS1=rows.itemsize, NAXIS2=edge, PCOUNT=len(stream), GCOUNT=1, TFIELDS=len(names))
    for number, name in enumerate(names, 1):
        header[f"TTYPE{number}"], header[f"TFORM{number}"] = name, f"1PB({len(stream)})"
    header.update(ZIMAGE=True, ZBITPIX=16, ZNAXIS=2, ZNAXIS1=edge, ZNAXIS2=edge, ZTILE1=edge, ZTILE2=1)
    header["ZCMPTYPE"] = "GZIP_1" if column == "COMPRESSED_DATA" else "RICE_1"
    first = fits.PrimaryHDU().header.tostring().encode()
    return first + header.tostring().encode() + padded(rows.tobytes() + stream)


def psf_with_a_tail(tail: str) -> bytes:
    """A PSF with the card PSFNAME, as heliopsf writes it, followed by HDUs that must not be read without a check."""
    y, x = np.indices((64, 64)) - 32
    kernel = np.exp(-0.5 * (x**2 + y**2) / 1.5**2)
    primary = fits.PrimaryHDU((kernel / kernel.sum()).astype("f4"))
    primary.header["PSFNAME"] = "mine"
    primary.header["EXTEND"] = True
    file = io.BytesIO()
    fits.HDUList([primary]).writeto(file)
    psf = file.getvalue()
    empty = fits.ImageHDU().header.tostring().encode()
    match tail:
        case "many HDUs":
            return psf + 5000 * empty
        case "long header":
            cards = b"".join(b"HISTORY x".ljust(80) for _ in range(100 * 2**20 // 80))
            return gzip.compress(psf + padded(empty[:240] + cards, b" "), 1)
        case "inflated data":
            huge = fits.Header({"XTENSION": "IMAGE", "BITPIX": 8, "NAXIS": 3})
            huge.update(NAXIS1=4096, NAXIS2=4096, NAXIS3=100, PCOUNT=0, GCOUNT=1)
            return gzip.compress(psf + huge.tostring().encode() + bytes(20 * 2**20), 1)
        case "component of tiles":
            return psf + lying_tiles(gzip.compress(bytes(64 * 2)))[HEADER_BLOCK:]
    raise ValueError(tail)
