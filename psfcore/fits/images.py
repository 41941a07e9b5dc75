"""Write products of deconvolution and other images to FITS files, and read single planes.

In memory, pixels are float64 [y, x] in the byte order of the machine. Files that this module writes hold float32. They
have the cards CHECKSUM and DATASUM, but no date of writing. Equal content therefore gives equal bytes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.io.fits.verify import VerifyError
from numpy.typing import NDArray

from psfcore.fits.cards import card_trouble
from psfcore.fits.hdus import TABLE_CARD, ascii_text, read_pixels, write_hdus
from psfcore.fits.header import FitsLimits, read_summary
from psfcore.fits.product.planes import Meanings, check_plane, plane_hdu
from psfcore.image import Image

CardValue = str | int | float | bool
Cards = Mapping[str, tuple[CardValue, str]]

# Cards that say how the input file stores its pixels, and cards with statistics of these pixels.
_STORAGE_CARD = re.compile(
    rf"{TABLE_CARD.pattern}|SIMPLE|EXTEND|GROUPS|INHERIT|EXTNAME|EXTVER|EXTLEVEL|END|BSCALE|BZERO|BLANK|"
    r"DATAMIN|DATAMAX|DATAMEAN|DATAMEDN|DATARMS|DATASTD|DATASKEW|DATAKURT|DATACENT|DATAP\d\d"
)


def read_plane(path: str | Path, limits: FitsLimits) -> NDArray[np.float64]:
    """Read the pixels [y, x] of the first 2-D image of a file without checking their values.

    Raises HeaderError for an unusable header; DataError "unreadable-pixels".
    """
    return read_pixels(path, read_summary(path, limits), limits)[0]


def write_image(
    path: str | Path,
    image: Image,
    *,
    cards: Cards,
    history: Sequence[str] = (),
    planes: Mapping[str, NDArray[Any]] | None = None,
    plane_bits: Mapping[str, Meanings] | None = None,
) -> None:
    """Write a product: float32 pixels, the input's header with its WCS, `cards`, `history` and planes.

    Cards that say how the input file stores its pixels are removed. DATAMIN, DATAMAX and DATAMEAN are computed again;
    the cards with median, rms and percentiles of the input are removed.
    planes: planes [y, x] by name (QUALITY, ERROR, PSF_ERROR), see `psfcore.fits.product.planes`. The image is the first HDU, and
    each plane is an image extension after it. plane_bits: for each plane of bits, the meaning of its bits.
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
    hdus: list[Any] = [fits.PrimaryHDU(pixels, header)]
    for name, plane in (planes or {}).items():
        check_plane(name, plane, pixels.shape, taken=[hdu.name for hdu in hdus])
        meanings = (plane_bits or {}).get(name)
        hdus.append(plane_hdu(name, plane, header, unit=image.unit, meanings=meanings))
    write_hdus(path, hdus)


def write_plane(path: str | Path, pixels: NDArray[Any], *, cards: Cards) -> None:
    """Write pixels [y, x] and `cards` to a file. Integers are stored as int32, floats as float32."""
    header = fits.Header()
    for key, (value, comment) in cards.items():
        header[key] = (ascii_text(value) if isinstance(value, str) else value, ascii_text(comment))
    stored = pixels.astype(np.int32 if pixels.dtype.kind in "iu" else np.float32)
    write_hdus(path, [fits.PrimaryHDU(stored, header)])


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
