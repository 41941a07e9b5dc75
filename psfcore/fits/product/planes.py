"""Planes of a product: image extensions with one value for each pixel of the image.

A plane is a plain image HDU with the name of the plane as EXTNAME and with the world coordinates of the image. Its
header has the card PLANE = T. A plane of bits has a card QBITn for each bit n of its values; the card names the bit,
and its comment says what the bit means.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from enum import IntFlag
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.hdus import ascii_text

Meanings = Mapping[IntFlag, str]

_BITS_STORED = {1: np.uint8, 2: np.uint16}
# Cards that say where on the sky each pixel is, who observed it, and when. Viewers and sunpy need them to show a plane.
_PLACE_CARD = re.compile(
    r"WCSAXES[A-Z]?|WCSNAME[A-Z]?|C(TYPE|UNIT|RPIX|RVAL|DELT|ROTA)\d[A-Z]?|(PC|CD|PV|PS)\d_\d+[A-Z]?|"
    r"(LONPOLE|LATPOLE|RADESYS|EQUINOX|SPECSYS)[A-Z]?|"
    r"DATE-(OBS|BEG|AVG|END)|T_OBS|TIMESYS|DATEREF|MJD-?(OBS|BEG|AVG|END|REF[IF]?)|XPOSURE|EXPTIME|"
    r"TELESCOP|OBSRVTRY|INSTRUME|DETECTOR|WAVELNTH|WAVEUNIT|"
    r"DSUN_(OBS|REF)|RSUN_(OBS|REF|ARC)|R_SUN|SOLAR_R|(HGLN|HGLT|CRLN|CRLT)_OBS|"
    r"(HEE|HEQ|HCI|HAE|GAE|GSE)[XYZ]_OBS|OBSGEO-[XYZ]"
)


def plane_hdu(
    name: str, plane: NDArray[Any], image_header: fits.Header, *, unit: str | None, meanings: Meanings | None
) -> fits.ImageHDU:
    """The HDU of a plane [y, x]. Bits are stored as uint8 or uint16, numbers as float32 in the unit of the image.

    image_header: the header of the product's image; the cards of its coordinates are copied. meanings: the meaning of
    each bit, for a plane of bits; None for other planes.
    """
    is_bits = plane.dtype.kind in "ub"
    stored = plane.astype(_BITS_STORED.get(plane.dtype.itemsize, np.uint16) if is_bits else np.float32)
    hdu = fits.ImageHDU(stored, name=name)
    hdu.header["PLANE"] = (True, "one value for each pixel of the image")
    if unit is not None and not is_bits:
        hdu.header["BUNIT"] = ascii_text(unit)
    for bit, meaning in (meanings or {}).items():
        hdu.header[f"QBIT{bit.bit_length() - 1}"] = (bit.name or "", f"value {int(bit)}: {meaning}")
    if meanings:
        hdu.header.add_comment("0 marks a good pixel; other values are sums of the values of QBITn.")
    for card in image_header.cards:
        if _PLACE_CARD.fullmatch(card.keyword):
            hdu.header.append(card, end=True)
    return hdu


def check_plane(name: str, plane: NDArray[Any], shape: tuple[int, ...], *, taken: Sequence[str]) -> None:
    """Raise DataError "bad-plane" for a wrong shape or type, or a name that is not allowed or in `taken`."""
    if not re.fullmatch(r"[A-Z][A-Z0-9_]{0,31}", name) or name in taken:
        message = f"expected a plane name in capitals, other than {', '.join(taken)}; got {name!r:.40}"
        raise DataError("bad-plane", message)
    if plane.shape != shape:
        raise DataError("bad-plane", f"expected plane {name} to have {shape} pixels; got {plane.shape}")
    if plane.dtype.kind not in "ubf" or (plane.dtype.kind == "u" and plane.dtype.itemsize > 2):
        raise DataError("bad-plane", f"expected plane {name} as floats, uint8 or uint16; got {plane.dtype}")


def read_planes(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read the planes [y, x] of a product, by name. Floats are float32."""
    planes: dict[str, NDArray[Any]] = {}
    with fits.open(path, memmap=False) as hdus:
        for hdu in hdus[1:]:
            if hdu.is_image and hdu.header.get("PLANE") is True:
                data = np.asarray(hdu.data)
                planes[hdu.name] = data.astype(data.dtype.newbyteorder("="))
    return planes
