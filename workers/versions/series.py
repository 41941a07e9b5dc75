"""Series of PSFs: the PSFs of one instrument, channel and kind. An image needs one PSF of its series."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from psfcore.instruments.unknown import channel_of as channel_of

TOTAL = "total"  # a total PSF, with which images are deconvolved
UPLOADED = "uploaded"  # an uploaded PSF whose kind is not known
INTERPOLATED = "interpolated"  # the origin of a PSF that was interpolated between two PSFs
WORD = r"^[a-z0-9][a-z0-9_.-]{0,39}$"
_NOT_OF_A_WORD = re.compile(r"[^a-z0-9_.]+")


def series_of(instrument: str | None, channel: str | None, kind: str) -> str | None:
    """The name of a series, instrument/channel/kind; None if the instrument is unknown."""
    return f"{instrument}/{channel or '-'}/{kind}" if instrument else None


def instrument_of(header: Mapping[str, Any]) -> str | None:
    """The instrument in the summary of an upload's header.

    The result is the name of a known instrument, or else the card DETECTOR or INSTRUME, converted by ``word``.
    """
    known: str | None = header["instrument"]
    return known or word(header["detector"] or header["instrume"])


def word(text: str | None) -> str | None:
    """Convert a text of a header to a name of lower-case letters, digits, underscores and full stops.

    None if no character is left.
    """
    if text is None:
        return None
    return _NOT_OF_A_WORD.sub("_", text.lower()).strip("_.")[:40] or None
