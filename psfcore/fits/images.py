"""Read images from FITS files, and write products of deconvolution.

In memory, pixels are float64 [y, x] in the byte order of the machine. Files that this module writes hold float32. They
have the cards CHECKSUM and DATASUM, but no date of writing. Equal content therefore gives equal bytes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from enum import IntFlag
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.io.fits.verify import VerifyError
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.cards import card_trouble
from psfcore.fits.hdus import ascii_text, read_pixels, write_hdus
from psfcore.fits.header import FitsLimits, optional_exposure_s, optional_number, optional_text, read_summary
from psfcore.image import Image, MaskBit

CardValue = str | int | float | bool
Cards = Mapping[str, tuple[CardValue, str]]

_SATURATION_KEYS = ("SATURATE", "DATASAT")
_TABLE_FORMAT = {np.dtype(np.uint8): "B", np.dtype(np.uint16): "I", np.dtype(np.float32): "E"}
_BITS_STORED = {1: np.uint8, 2: np.uint16}
_FULL_SCALES = tuple(2**bits - 1 for bits in (8, 10, 12, 14, 15, 16))
# Cards that say how the input file stores its pixels, and cards with statistics of these pixels.
_STORAGE_CARD = re.compile(
    r"SIMPLE|XTENSION|BITPIX|NAXIS\d*|PCOUNT|GCOUNT|EXTEND|GROUPS|INHERIT|EXTNAME|EXTVER|EXTLEVEL|END|"
    r"BSCALE|BZERO|BLANK|CHECKSUM|DATASUM|ZHECKSUM|ZDATASUM|"
    r"TFIELDS|THEAP|T(TYPE|FORM|UNIT|NULL|SCAL|ZERO|DISP|DIM)\d+|"
    r"ZIMAGE|ZSIMPLE|ZEXTEND|ZTENSION|ZBITPIX|ZNAXIS\d*|ZPCOUNT|ZGCOUNT|ZTILE\d+|ZCMPTYPE|ZNAME\d+|ZVAL\d+|"
    r"ZQUANTIZ|ZDITHER0|ZBLANK|ZSCALE|ZZERO|ZMASKCMP|ZBLOCKED|"
    r"DATAMIN|DATAMAX|DATAMEAN|DATAMEDN|DATARMS|DATASTD|DATASKEW|DATAKURT|DATACENT|DATAP\d\d"
)


def read_image(path: str | Path, limits: FitsLimits, *, saturation_dn: float | None = None) -> Image:
    """Read the first 2-D image of a file and mask its unusable pixels.

    saturation_dn: a pixel at or above this level (DN) is saturated. For an image in DN/s, the level is divided by the
    exposure time. The cards SATURATE and DATASAT, in the unit of the image, also give a level. If several levels are
    known, the lowest one is used. Raises HeaderError for an unusable header; DataError "unreadable-pixels",
    "tile-too-large", "no-exposure", "all-nan", "all-saturated", "no-signal", "too-small".
    """
    summary = read_summary(path, limits)
    pixels, header = read_pixels(path, summary)
    unit, exposure_s = optional_text(header, "BUNIT"), optional_exposure_s(header)
    level = _saturation_level(header, unit, exposure_s, saturation_dn)
    mask = np.where(np.isfinite(pixels), 0, int(MaskBit.NONFINITE)).astype(np.uint8)
    if level is not None:
        mask[pixels >= level] |= int(MaskBit.SATURATED)  # False for NaN
    image = Image(pixels=pixels, mask=mask, header=header, unit=unit, exposure_s=exposure_s)
    _check_signal(image, stored_as_integer=summary.bitpix > 0)
    return image


def read_plane(path: str | Path, limits: FitsLimits) -> NDArray[np.float64]:
    """Read the pixels [y, x] of the first 2-D image of a file without checking their values.

    Raises HeaderError for an unusable header; DataError "unreadable-pixels", "tile-too-large".
    """
    return read_pixels(path, read_summary(path, limits))[0]


def _saturation_level(
    header: fits.Header, unit: str | None, exposure_s: float | None, saturation_dn: float | None
) -> float | None:
    """Lowest saturated value in the unit of the image; None if no level is known."""
    levels = [optional_number(header, key) for key in _SATURATION_KEYS]
    if saturation_dn is not None:
        if (unit or "").replace(" ", "").lower() != "dn/s":
            levels.append(saturation_dn)
        elif exposure_s is not None:
            levels.append(saturation_dn / exposure_s)
        else:
            message = "expected XPOSURE or EXPTIME in the header, to convert a saturation level from DN to DN/s; got neither of them"
            raise DataError("no-exposure", message)
    known = [level for level in levels if level is not None and level > 0]
    return min(known, default=None)


def _check_signal(image: Image, *, stored_as_integer: bool) -> None:
    valid = image.pixels[image.valid]
    if valid.size == 0:
        finite = (image.mask & MaskBit.NONFINITE) == 0
        if not finite.any():
            raise DataError("all-nan", "expected finite pixels; got only NaN, infinite or BLANK")
        level = image.pixels[finite].min()
        raise DataError(
            "all-saturated", f"expected pixels below saturation; all finite pixels are at {level:g} or above"
        )
    smallest, largest = float(valid.min()), float(valid.max())
    if largest <= 0:
        raise DataError("no-signal", f"expected pixels above zero; the largest is {largest:g}")
    if smallest == largest and stored_as_integer and largest in _FULL_SCALES:
        message = f"expected pixels below saturation; all pixels are {largest:g}, the largest value of an A/D converter"
        raise DataError("all-saturated", message)


def write_image(
    path: str | Path,
    image: Image,
    *,
    cards: Cards,
    history: Sequence[str] = (),
    mask: NDArray[np.uint8] | None = None,
    planes: Mapping[str, NDArray[Any]] | None = None,
    plane_bits: Mapping[str, type[IntFlag]] | None = None,
) -> None:
    """Write a product: float32 pixels, the input's header with its WCS, `cards`, `history`, mask and planes.

    Cards that say how the input file stores its pixels are removed. DATAMIN, DATAMAX and DATAMEAN are computed again;
    the cards with median, rms and percentiles of the input are removed.
    mask: plane [y, x] to store instead of image.mask.
    planes: further planes [y, x] by name (ERROR, PSF_ERROR, QUALITY). Planes of bits are stored as uint8 or uint16,
    planes of numbers as float32 in the unit of the image.
    plane_bits: for each plane of bits, the meaning of its bits.
    Raises DataError "bad-plane" for a wrong shape, a wrong type or a name that is used twice.
    """
    header = _kept_header(image.header)
    pixels = image.pixels.astype(np.float32)
    finite = pixels[np.isfinite(pixels)]
    if finite.size:
        header["DATAMIN"] = (float(finite.min()), "smallest finite pixel")
        header["DATAMAX"] = (float(finite.max()), "largest finite pixel")
        header["DATAMEAN"] = (float(finite.mean(dtype=np.float64)), "mean of finite pixels")
    for key, (value, comment) in cards.items():
        header[key] = (ascii_text(value) if isinstance(value, str) else value, ascii_text(comment))
    for line in history:
        header.add_history(ascii_text(line))
    plane = image.mask if mask is None else np.ascontiguousarray(mask, dtype=np.uint8)
    hdus = [fits.PrimaryHDU(pixels, header), _plane_hdu("MASK", plane, bits=MaskBit, bit_key="MBIT")]
    for name, extra in (planes or {}).items():
        _check_plane(name, extra, pixels.shape, taken=[hdu.name for hdu in hdus])
        hdus.append(_plane_hdu(name, extra, unit=image.unit, bits=(plane_bits or {}).get(name)))
    write_hdus(path, hdus)


def write_plane(path: str | Path, pixels: NDArray[Any], *, cards: Cards) -> None:
    """Write pixels [y, x] and `cards` to a file. Integers are stored as int32, floats as float32."""
    header = fits.Header()
    for key, (value, comment) in cards.items():
        header[key] = (ascii_text(value) if isinstance(value, str) else value, ascii_text(comment))
    stored = pixels.astype(np.int32 if pixels.dtype.kind in "iu" else np.float32)
    write_hdus(path, [fits.PrimaryHDU(stored, header)])


def read_planes(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read the planes [y, x] of a product, by name, except the mask. Floats are float32."""
    planes: dict[str, NDArray[Any]] = {}
    with fits.open(path, memmap=False) as hdus:
        for hdu in hdus[1:]:
            if isinstance(hdu, fits.BinTableHDU) and hdu.header.get("PLANE") is True:
                data = np.asarray(hdu.data[hdu.name][0])
                planes[hdu.name] = data.astype(data.dtype.newbyteorder("="))
    return planes


def read_mask(path: str | Path) -> NDArray[np.uint8] | None:
    """Read the mask plane [y, x] of a product; None if the file has no mask."""
    with fits.open(path, memmap=False) as hdus:
        if "MASK" not in hdus:
            return None
        return np.array(hdus["MASK"].data["MASK"][0], dtype=np.uint8)


def _plane_hdu(
    name: str,
    plane: NDArray[Any],
    *,
    unit: str | None = None,
    bits: type[IntFlag] | None = None,
    bit_key: str = "QBIT",
) -> fits.BinTableHDU:
    # sunpy.map.Map makes a map of every HDU whose data have two or more axes. If a plane were an image extension,
    # sunpy would open the product as a list of maps. The data of a table have one axis, and TDIM stores the shape.
    ny, nx = plane.shape
    is_bits = plane.dtype.kind in "ub"
    stored = plane.astype(_BITS_STORED.get(plane.dtype.itemsize, np.uint16) if is_bits else np.float32)
    column = fits.Column(
        name=name,
        format=f"{plane.size}{_TABLE_FORMAT[stored.dtype]}",
        dim=f"({nx},{ny})",
        unit=None if is_bits or unit is None else ascii_text(unit),
        bzero=2**15 if stored.dtype == np.uint16 else None,
        array=stored[None],
    )
    hdu = fits.BinTableHDU.from_columns([column], name=name)
    if name != "MASK":
        hdu.header["PLANE"] = (True, "one value a pixel of the image")
    for bit in bits or ():
        hdu.header[f"{bit_key}{bit.bit_length() - 1}"] = (bit.name or "", f"meaning of value {int(bit)}")
    return hdu


def _check_plane(name: str, plane: NDArray[Any], shape: tuple[int, ...], *, taken: Sequence[str]) -> None:
    if not re.fullmatch(r"[A-Z][A-Z0-9_]{0,31}", name) or name in taken:
        message = f"expected a plane name in capitals, other than {', '.join(taken)}; got {name!r:.40}"
        raise DataError("bad-plane", message)
    if plane.shape != shape:
        raise DataError("bad-plane", f"expected plane {name} to have {shape} pixels; got {plane.shape}")
    if plane.dtype.kind not in "ubf" or (plane.dtype.kind == "u" and plane.dtype.itemsize > 2):
        raise DataError("bad-plane", f"expected plane {name} as floats, uint8 or uint16; got {plane.dtype}")


def _kept_header(source: fits.Header) -> fits.Header:
    """The input's cards in order, without the cards of _STORAGE_CARD. An unreadable card becomes a HISTORY card."""
    kept = fits.Header()
    for card in source.cards:
        if _STORAGE_CARD.fullmatch(card.keyword):
            continue
        readable = _readable(card)
        if readable is None:
            kept.add_history(_as_text(card))
        else:
            kept.append(readable, end=True)
    return kept


def _as_text(card: fits.Card) -> str:
    try:
        return "card kept as text: " + ascii_text(card.image.rstrip())
    except (
        card_trouble()
    ):  # astropy repairs a damaged card before it shows it, and some cards cannot be repaired
        return f"card {ascii_text(card.keyword)} left out: it cannot be read"


def _readable(card: fits.Card) -> fits.Card | None:
    """A copy of the card that can be written, or None if the card is unreadable.

    A value that FITS does not allow (NaN, "1 2 3") becomes a string.
    """
    try:
        value = _card_value(card)
        copy = fits.Card(
            card.keyword, ascii_text(value) if isinstance(value, str) else value, ascii_text(card.comment)
        )
        copy.verify("silentfix")
        fits.Card.fromstring(copy.image)
    except card_trouble():
        return None
    return copy


def _card_value(card: fits.Card) -> Any:
    try:
        value = card.value
    except VerifyError:
        value = fits.Card.fromstring(card.image).value  # card.image contains the value as a quoted string
    not_a_number = isinstance(value, (float, complex)) and not np.isfinite(value)
    return str(value) if not_a_number else value
