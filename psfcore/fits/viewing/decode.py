"""Decode one plane of a FITS file for a viewer, in a process of its own.

The values are the values of the file after BSCALE, BZERO and BLANK are applied. No pixel is divided by the exposure time or
masked.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits, open_source, walk
from psfcore.fits.cards import lenient_value, optional_text
from psfcore.fits.header import read_summary
from psfcore.fits.viewing.planes import IMAGE, Decoded
from psfcore.limited import run_limited

_LONGEST_UNIT = 68  # characters of a card's value


def decode_plane(path: str | Path, name: str, limits: FitsLimits, target: BinaryIO) -> Decoded:
    """Write the pixels of a plane to ``target`` as little-endian float32, in the order of the FITS file (row 0 first).

    NaN stays NaN. name: IMAGE for the first 2-D image of the file, or the name of a plane of a product, for example
    "quality". Returns the shape and the unit of the plane. Raises HeaderError for an unusable header; DataError
    "unreadable-pixels" or "no-such-plane".
    """
    hdu = None if name == IMAGE else _number_of_plane(path, name.upper(), limits)
    shape = read_summary(path, limits, hdu=hdu).shape
    answer = run_limited(write_pixels, path, target, pixels=math.prod(shape), hdu=hdu, limits=asdict(limits))
    return Decoded(shape, answer["unit"])


def write_pixels(target: BinaryIO, *, path: str, hdu: int | None, limits: dict[str, int]) -> dict[str, Any]:
    """Write the pixels of an image to ``target`` as little-endian float32; returns its unit. Call it in a limited process."""
    from psfcore.fits.hdus import ascii_text, read_pixels  # loads the numerical libraries

    most = FitsLimits(**limits)
    pixels, header = read_pixels(path, read_summary(path, most, hdu=hdu), most)
    target.write(pixels.astype("<f4").data)
    unit = optional_text(header, "BUNIT")
    return {"unit": None if unit is None else ascii_text(unit)[:_LONGEST_UNIT]}


def _number_of_plane(path: str | Path, name: str, limits: FitsLimits) -> int:
    """The HDU of a plane of a product. Raises DataError "no-such-plane"."""
    planes = {}
    with open_source(Path(path), limits) as source:
        for hdu in walk(source, limits):
            if hdu.number > 0 and hdu.kind == "image" and lenient_value(hdu.header, "PLANE") is True:
                planes[optional_text(hdu.header, "EXTNAME") or ""] = hdu.number
    if name not in planes:
        there = ", ".join([IMAGE, *map(str.lower, planes)])
        advice = ": submit the deconvolution with error_draws" if name == "ERROR" else ""
        raise DataError(
            "no-such-plane", f"expected a plane of this file ({there}); got {name.lower()}{advice}"
        )
    return planes[name]
