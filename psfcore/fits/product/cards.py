"""The cards that describe the file and the origin of a product. They replace the same cards of the input.

Sources: FITS standard 4.0, section 4.4.2; SOLARNET metadata recommendations (Haugan and Fredvik 2020) and the Solar
Orbiter metadata standard (SOL-SGS-TN-0009) for FILENAME, PARENT, CREATOR and LEVEL.

| card of the input | card of the product |
|---|---|
| FILENAME | name of the product |
| PARENT | FILENAME of the input; left out if the input has none |
| CREATOR | heliopsf and its version |
| LEVEL | L3, a product derived from calibrated data; left out if the input has none |
| DATE | left out: the time of writing would make files of equal content differ. The catalogue stores the time |
| ORIGIN, VERSION, JOBID | left out: they describe the institute, the version and the run that made the input |

The lines of HISTORY contain the values of these cards in the input. LVL_NUM is not changed: it is the level of the
calibration, which a deconvolution does not change.
"""

from __future__ import annotations

from dataclasses import dataclass

from astropy.io.fits import Header

from psfcore.fits.header import PRODUCT, content_of, optional_number, optional_text, optional_value

CARD_OF_PASS = "DCNVPASS"
_LEVEL = "L3"
_OF_FILE = ("FILENAME", "DATE", "PARENT", "CREATOR", "LEVEL", "ORIGIN", "VERSION", "JOBID")

Cards = dict[str, tuple[str | int, str]]


@dataclass(frozen=True)
class Described:
    """header: the header of the input, without the cards that are not valid for the product. cards: the product's own
    cards.

    history: lines of HISTORY with the values of the input.
    """

    header: Header
    cards: Cards
    history: list[str]


def described(source: Header, *, filename: str, creator: str, sha256: str) -> Described:
    """The cards for a product of the image with the header ``source``.

    filename: name of the product. sha256: hash of the input's file.
    """
    before = {key: optional_value(source, key) for key in _OF_FILE}
    # A file name may fill the whole card, so cards with a file name have no comment.
    cards: Cards = {"FILENAME": (filename, ""), "CREATOR": (creator, "made this file")}
    parent = optional_text(source, "FILENAME")
    if parent is not None:
        cards["PARENT"] = (parent, "")
    if "LEVEL" in source:
        cards["LEVEL"] = (_LEVEL, "derived from calibrated data")
    passes = passes_of(source) + 1
    cards[CARD_OF_PASS] = (passes, "deconvolutions of this image, with this one")
    kept = source.copy()
    for key in _OF_FILE:
        if key not in cards:
            kept.remove(key, ignore_missing=True, remove_all=True)
    history = ["SHA-256 of the input file:", sha256]
    history += [
        f"input {key}: {value:g}" if isinstance(value, float) else f"input {key}: {value}"
        for key, value in before.items()
        if value is not None
    ]
    if passes > 1:
        history.append(f"deconvolution number {passes} of this image: the input was a product")
    return Described(kept, cards, history)


def passes_of(source: Header) -> int:
    """How often the input was deconvolved; at least once if it is a product."""
    if content_of(source) != PRODUCT:
        return 0
    return int(optional_number(source, CARD_OF_PASS) or 1)
