"""Lines of PSFs: those of one instrument, channel and kind, of which an image needs one."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from psfcore.instruments.files import instrument_names
from psfcore.instruments.model import load_instrument

TOTAL = "total"  # a whole PSF, which images are deconvolved with
UPLOADED = "uploaded"  # a PSF of which nobody said whether it is a whole one
WORD = r"^[a-z0-9][a-z0-9_.-]{0,39}$"
_NOT_OF_A_WORD = re.compile(r"[^a-z0-9_.]+")


def series_of(instrument: str | None, channel: str | None, kind: str) -> str | None:
    """What a PSF is one of: instrument, channel and kind; none where the instrument is not known."""
    return f"{instrument}/{channel or '-'}/{kind}" if instrument else None


def channel_of(instrument: str | None, wavelength_angstrom: float | None) -> str | None:
    """The channel, as 174: the wavelength in whole angstrom, or that of a shipped instrument where none is said."""
    if wavelength_angstrom is None and instrument in instrument_names():
        wavelength_angstrom = load_instrument(instrument).wavelength_angstrom
    if wavelength_angstrom is None or not 0.5 <= wavelength_angstrom < 1e6:  # a card may say anything
        return None
    return str(round(wavelength_angstrom))


def instrument_of(header: Mapping[str, Any]) -> str | None:
    """The instrument of an upload's header: one that is known here, else its DETECTOR or INSTRUME as a word."""
    known: str | None = header["instrument"]
    return known or word(header["detector"] or header["instrume"])


def word(text: str | None) -> str | None:
    """A header's text as a name: small letters, digits, _ and full stops; none where nothing is left."""
    if text is None:
        return None
    return _NOT_OF_A_WORD.sub("_", text.lower()).strip("_.")[:40] or None
