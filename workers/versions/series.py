"""Series of PSFs: the PSFs of one instrument, channel and kind. An image needs one PSF of its series."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from psfcore.fits.header import HeaderSummary
from psfcore.instruments.unknown import channel_of as channel_of

TOTAL = "total"  # a total PSF, with which images are deconvolved
UPLOADED = "uploaded"  # an uploaded PSF whose kind is not known
INTERPOLATED = "interpolated"  # the origin of a PSF that was interpolated between two PSFs
# As in the query of an upload: the columns are indexed, and indexes have a limit.
NAME_LENGTH, VERSION_LENGTH = 80, 40
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


def name_of_upload(summary: HeaderSummary, filename: str | None, sha256: str) -> tuple[str, str]:
    """The name and the version of an uploaded PSF: from its header, or else from its file. Longer texts are cut."""
    name = label(summary.psf_name or PurePath(filename or "").stem, NAME_LENGTH) or "uploaded"
    return name, label(summary.psf_version, VERSION_LENGTH) or f"0.0.0+{sha256[:8]}"


def label(text: str | None, most: int) -> str:
    """The printable characters of a text that a file or a client chose, at most ``most`` of them."""
    return "".join(c for c in (text or "")[: 2 * most] if c.isprintable())[:most].strip()
