"""Read single planes of pixels, and write products of deconvolution and other images to FITS files.

In memory, pixels are float64 [y, x] in the byte order of the machine. Files that this module writes hold float32. They
have the cards CHECKSUM and DATASUM, but no date of writing. Equal content therefore gives equal bytes.

A plane of a product is a plain image HDU with one value for each pixel of the image, with the name of the plane as
EXTNAME and with the world coordinates of the image. Its header has the card PLANE = T. A plane of bits has a card QBITn
for each bit n of its values; the card names the bit, and its comment says what the bit means.

These cards describe the file and the origin of a product. Sources: FITS standard 4.0, section 4.4.2; SOLARNET metadata
recommendations (Haugan and Fredvik 2020) and the Solar Orbiter metadata standard (SOL-SGS-TN-0009) for FILENAME,
PARENT, CREATOR and LEVEL.

| card of the input | card of the product |
|---|---|
| FILENAME | name of the product |
| PARENT | FILENAME of the input; left out if the input has none |
| CREATOR | heliopsf and its version |
| LEVEL | L3, a product derived from calibrated data; left out if the input has none |
| DATE | left out: the time of writing would make files of equal content differ. The catalogue stores the time |
| ORIGIN, VERSION, JOBID | left out: they describe the institute, the version and the run that made the input |
| PSFDOI | that of the PSF that was used; left out if it has none |

The lines of HISTORY contain the values of these cards in the input. LVL_NUM is not changed: it is the level of the
calibration, which a deconvolution does not change.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.io.fits.verify import VerifyError
from numpy.typing import NDArray

from psfcore.errors import DataError, module_of_extra
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.cards import (
    card_trouble,
    long_key,
    optional_number,
    optional_text,
    optional_value,
    without_cards,
)
from psfcore.fits.hdus import TABLE_CARD, ascii_text, read_pixels, write_hdus
from psfcore.fits.header import PRODUCT, content_of
from psfcore.image import Image

CardValue = str | int | float | bool
Cards = Mapping[str, tuple[CardValue, str]]
Meanings = Mapping[IntFlag, str]

LARGEST_MASK_PX = 16384
CARD_OF_PASS = "DCNVPASS"  # noqa: S105  # a card
_LEVEL = "L3"
_OF_FILE = ("FILENAME", "DATE", "PARENT", "CREATOR", "LEVEL", "ORIGIN", "VERSION", "JOBID", "PSFDOI")
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

# Cards with statistics of the pixels of the input.
STATISTICS = r"DATA(MIN|MAX|MEAN|MEDN|RMS|STD|SKEW|KURT|CENT|P\d\d)"
# Cards that say how the input file stores its pixels, and the statistics.
_STORAGE_CARD = re.compile(
    rf"{TABLE_CARD.pattern}|SIMPLE|EXTEND|GROUPS|INHERIT|EXTNAME|EXTVER|EXTLEVEL|END|BSCALE|BZERO|BLANK|{STATISTICS}"
)


def read_plane(path: str | Path, limits: FitsLimits) -> NDArray[np.float64]:
    """Read the pixels [y, x] of the first 2-D image of a file without checking their values.

    Raises HeaderError for an unusable header; DataError "unreadable-pixels".
    """
    return read_pixels(path, limits).pixels


def read_planes(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read the planes [y, x] of a product, by name. Floats are float32."""
    planes: dict[str, NDArray[Any]] = {}
    with fits.open(path, memmap=False) as hdus:
        for hdu in hdus[1:]:
            if hdu.is_image and hdu.header.get("PLANE") is True:
                data = np.asarray(hdu.data)
                planes[hdu.name] = data.astype(data.dtype.newbyteorder("="))
    return planes


def read_mask_image(path: Path) -> NDArray[np.float64]:
    """Read a mount's mask image as pixels [y, x], row 0 at the lowest y.

    A PNG stores its lowest row last, so its rows are reversed. Colours are averaged; transparency is ignored. Raises
    DataError "bad-mount"; its message names the key of the instrument file. A FITS file can also raise HeaderError and
    DataError "unreadable-pixels".
    """
    if path.suffix.lower() == ".png":
        return _png(path)
    if not path.is_file():
        raise DataError(
            "bad-mount", f"mount.mask_image.file: expected an existing file; {path.name} does not exist"
        )
    return read_plane(path, FitsLimits(max_pixels=LARGEST_MASK_PX**2))


def _png(path: Path) -> NDArray[np.float64]:
    try:
        picture = np.asarray(module_of_extra("matplotlib.image").imread(path, format="png"), dtype=np.float64)
    except (OSError, ValueError, SyntaxError) as error:  # Pillow raises SyntaxError for a broken PNG
        raise DataError(
            "bad-mount",
            f"mount.mask_image.file: expected a PNG that can be read; got: {' '.join(str(error).split()):.120}",
        ) from None
    if picture.ndim == 3:
        colours = picture.shape[2] - 1 if picture.shape[2] in (2, 4) else picture.shape[2]
        picture = picture[:, :, :colours].mean(axis=2)
    return picture[::-1].copy()


def write_image(
    path: str | Path,
    image: Image,
    *,
    pixels: NDArray[np.floating] | None = None,
    cards: Cards,
    history: Sequence[str] = (),
    planes: Mapping[str, NDArray[Any]] | None = None,
    plane_bits: Mapping[str, Meanings] | None = None,
) -> None:
    """Write a product: float32 pixels, the input's header with its WCS, `cards`, `history` and planes.

    Cards that say how the input file stores its pixels are removed. DATAMIN, DATAMAX and DATAMEAN are computed again;
    the cards with median, rms and percentiles of the input are removed. The image is the first HDU, and each plane is
    an image extension after it.

    Raises DataError "bad-plane" for a wrong shape, a wrong type or a name that is used twice.

    Parameters
    ----------
    pixels
        The pixels [y, x] of the product; None: those of the image.
    planes
        Planes [y, x] by name (QUALITY, ERROR, PSF_ERROR), see above.
    plane_bits
        The meaning of the bits of each plane of bits.
    """
    header = _kept_header(image.header)
    pixels = (image.pixels if pixels is None else pixels).astype(np.float32, copy=False)
    finite = np.isfinite(pixels)
    if finite.any():
        header.update(
            {
                "DATAMIN": (float(pixels.min(where=finite, initial=np.inf)), "smallest finite pixel"),
                "DATAMAX": (float(pixels.max(where=finite, initial=-np.inf)), "largest finite pixel"),
                "DATAMEAN": (float(pixels.mean(where=finite, dtype=np.float64)), "mean of finite pixels"),
            }
        )
    header.update(_ascii(cards))
    for line in history:
        header.add_history(ascii_text(line))
    hdus: list[fits.PrimaryHDU | fits.ImageHDU] = [fits.PrimaryHDU(pixels, header)]
    for name, plane in (planes or {}).items():
        _check_plane(name, plane, pixels.shape, taken=[hdu.name for hdu in hdus])
        hdus.append(_plane_hdu(name, plane, header, image.unit, (plane_bits or {}).get(name)))
    write_hdus(path, hdus)


def write_plane(path: str | Path, pixels: NDArray[Any], *, cards: Cards) -> None:
    """Write pixels [y, x] and `cards` to a file. Integers are stored as int32, floats as float32."""
    hdu = fits.PrimaryHDU(pixels.astype(np.int32 if pixels.dtype.kind in "iu" else np.float32))
    hdu.header.update(_ascii(cards))
    write_hdus(path, [hdu])


def _ascii(cards: Cards) -> dict[str, tuple[CardValue, str]]:
    return {
        key: (ascii_text(value) if isinstance(value, str) else value, ascii_text(comment))
        for key, (value, comment) in cards.items()
    }


def _plane_hdu(
    name: str,
    plane: NDArray[Any],
    image_header: fits.Header,
    unit: str | None,
    meanings: Meanings | None,
) -> fits.ImageHDU:
    """The HDU of a plane [y, x]. Bits are stored as uint8 or uint16, numbers as float32 in the unit of the image.

    Parameters
    ----------
    image_header
        The header of the product's image; the cards of its coordinates are copied.
    meanings
        The meaning of each bit, for a plane of bits; None for other planes.
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
    hdu.header.extend(
        (card for card in image_header.cards if _PLACE_CARD.fullmatch(card.keyword)), strip=False, end=True
    )
    return hdu


def _check_plane(name: str, plane: NDArray[Any], shape: tuple[int, ...], *, taken: Sequence[str]) -> None:
    """Raise DataError "bad-plane" for a wrong shape or type, or a name that is not allowed or in `taken`."""
    if not re.fullmatch(r"[A-Z][A-Z0-9_]{0,31}", name) or name in taken:
        raise DataError(
            "bad-plane",
            f"expected a plane name in capitals, other than {', '.join(taken)}; got {name!r:.40}",
        )
    if plane.shape != shape:
        raise DataError("bad-plane", f"expected plane {name} to have {shape} pixels; got {plane.shape}")
    if plane.dtype.kind not in "ubf" or (plane.dtype.kind == "u" and plane.dtype.itemsize > 2):
        raise DataError("bad-plane", f"expected plane {name} as floats, uint8 or uint16; got {plane.dtype}")


def _kept_header(source: fits.Header) -> fits.Header:
    """The input's cards in order, without the cards of _STORAGE_CARD. An unreadable card becomes a HISTORY card."""
    kept = fits.Header()
    for card in source.cards:
        if not _STORAGE_CARD.fullmatch(card.keyword):
            try:
                kept.append(_readable(card), end=True)
            except card_trouble():
                kept.add_history(_as_text(card))
    return kept


def _as_text(card: fits.Card) -> str:
    try:
        return "card kept as text: " + ascii_text(_image_of(card).rstrip())
    except (
        card_trouble()
    ):  # astropy repairs a damaged card before it shows it, and some cards cannot be repaired
        return f"card {ascii_text(card.keyword)} left out: it cannot be read"


def _readable(card: fits.Card) -> fits.Card:
    """A copy of the card that can be written. Raises the errors of `card_trouble` if the card is unreadable.

    A value that FITS does not allow (NaN, "1 2 3") becomes a string.
    """
    value = _card_value(card)
    written = fits.Card(
        long_key(card.keyword),
        ascii_text(value) if isinstance(value, str) else value,
        ascii_text(card.comment),
    )
    written.verify("silentfix")
    fits.Card.fromstring(written.image)
    return written


def _image_of(card: fits.Card) -> str:
    """The text of a card as FITS allows it. A repair is not worth a warning of astropy: NaN is common in cards."""
    repaired = copy(card)
    repaired.verify("silentfix+ignore")
    return str(repaired.image)


def _card_value(card: fits.Card) -> object:
    try:
        value = card.value
    except VerifyError:
        value = fits.Card.fromstring(_image_of(card)).value  # the text contains the value as a quoted string
    return str(value) if isinstance(value, (float, complex)) and not np.isfinite(value) else value


@dataclass(frozen=True)
class Described:
    """The cards that describe a product.

    Attributes
    ----------
    header
        The header of the input, without the cards that are not valid for the product.
    cards
        The cards that only the product has.
    history
        Lines of HISTORY with the values of the input.
    """

    header: fits.Header
    cards: dict[str, tuple[CardValue, str]]
    history: list[str]


def described(source: fits.Header, *, filename: str, creator: str, sha256: str | None) -> Described:
    """The cards for a product of the image with the header ``source``.

    Parameters
    ----------
    filename
        Name of the product.
    sha256
        Hash of the input's file; None: not known.
    """
    # A file name may fill the whole card, so cards with a file name have no comment.
    cards: dict[str, tuple[CardValue, str]] = {
        "FILENAME": (filename, ""),
        "CREATOR": (creator, "made this file"),
    }
    if (parent := optional_text(source, "FILENAME")) is not None:
        cards["PARENT"] = (parent, "")
    if "LEVEL" in source:
        cards["LEVEL"] = (_LEVEL, "derived from calibrated data")
    passes = passes_of(source) + 1
    cards[CARD_OF_PASS] = (passes, "deconvolutions of this image, with this one")
    kept = without_cards(source, (key for key in _OF_FILE if key not in cards))
    inputs = (
        f"input {key}: {value:g}" if isinstance(value, float) else f"input {key}: {value}"
        for key in _OF_FILE
        if (value := optional_value(source, key)) is not None
    )
    history = [*([] if sha256 is None else ["SHA-256 of the input file:", sha256]), *inputs]
    if passes > 1:
        history.append(f"deconvolution number {passes} of this image: the input was a product")
    return Described(kept, cards, history)


def passes_of(source: fits.Header) -> int:
    """How often the input was deconvolved; at least once if it is a product."""
    return int(optional_number(source, CARD_OF_PASS) or 1) if content_of(source) == PRODUCT else 0
