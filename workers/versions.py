"""Versions of PSFs: their series and variants, their status and version numbers, and the times for which they are
valid.

This module does not use the database. The status of a PSF changes in this way:

    draft ----------> certified ----------> deprecated
                      |      ^              |        ^
                      +------+              +--------+
                  another range         a successor named

If a request names no PSF, the certified PSF of the image's series is used; if the series has none, the PSF that is
built from the shipped instrument file. Every other draft is used only by requests that name it. A certified PSF has a
version that no other PSF of its series has. Its range of observation times does not overlap with the range of any other
certified PSF of its series. The service never chooses a deprecated PSF by itself; a request can still name one, and a
context can still pin one. Once the successor of a deprecated PSF is named, it cannot change.

The channel of a PSF may name a variant after a hyphen: `174-open_2` is for images of 174 angstrom whose card FILTER,
EC_FW1_ or EC_FW2_ is "Open 2", `174-0.984arcsec` for images of that plate scale, and `174-open_2-0.984arcsec` for
images with both. So each variant is a series of its own.

In the database, times are seconds since 1970 (UTC), and an open end is an infinity; so ranges can be compared as
numbers. In requests and responses, times are ISO 8601, and an open end is null.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import PurePath

from psfcore.errors import DataError
from psfcore.fits.cards import Cards, optional_text
from psfcore.fits.frame import plate_scale_arcsec
from psfcore.fits.header import FILTER_CARDS, HeaderSummary, bad_time, utc_time
from psfcore.instruments.files import PLATE_SCALE_TOLERANCE
from psfcore.instruments.observation import Observation
from psfcore.instruments.unknown import channel_of as channel_of
from workers.texts import printable

# Series ---------------------------------------------------------------------------------------------

TOTAL = "total"  # a total PSF, with which images are deconvolved
UPLOADED = "uploaded"  # an uploaded PSF whose kind is not known
INTERPOLATED = "interpolated"  # the origin of a PSF that was interpolated between two PSFs
WORD = r"^[a-z0-9][a-z0-9_.-]{0,39}$"
SEPARATOR = (
    "-"  # between a channel and the properties of a variant; a word of a header card never contains it
)
_NOT_OF_A_WORD = re.compile(r"[^a-z0-9_.]+")
_SCALE = re.compile(r"(\d+(?:\.\d+)?)arcsec")


def series_of(instrument: str | None, channel: str | None, kind: str) -> str | None:
    """The name of a series, instrument/channel/kind; None if the instrument is unknown."""
    return f"{instrument}/{channel or '-'}/{kind}" if instrument else None


def instrument_of(header: Observation) -> str | None:
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


def without_variant(channel: str) -> str:
    """The channel alone: `174` of `174-open_2`."""
    return channel.partition(SEPARATOR)[0]


def is_variant_of(channel: str, plain: str) -> bool:
    """Whether a channel is a variant of the channel ``plain``."""
    return channel.startswith(f"{plain}{SEPARATOR}") and len(channel) > len(plain) + 1


def variant_for(cards: Cards, channels: Iterable[str]) -> str | None:
    """The channel, of these variants, to which an image belongs; None if no variant agrees with the image.

    All properties of the variant agree with the header of the image; if several variants agree, the image belongs to
    the one with the most properties.

    Parameters
    ----------
    cards
        The header cards of the image.

    Raises
    ------
    DataError
        "several-variants-fit" if two variants agree equally well.
    """
    properties = {channel: channel.split(SEPARATOR)[1:] for channel in channels}
    agreeing = [one for one, needed in properties.items() if all(_has(cards, name) for name in needed)]
    most = max((len(properties[channel]) for channel in agreeing), default=0)
    best = sorted(channel for channel in agreeing if len(properties[channel]) == most)
    if len(best) > 1:
        raise DataError(
            "several-variants-fit",
            "expected one variant of the channel that agrees with the filter and plate scale of the image; got "
            f"{', '.join(best)}: name the PSF in the request, or certify a PSF for a variant with both properties",
        )
    return best[0] if best else None


def _has(cards: Cards, name: str) -> bool:
    """Whether an image has a property of a variant: a plate scale, or a filter."""
    scale = _SCALE.fullmatch(name)
    if scale is None:
        return name in {word(optional_text(cards, card)) for card in FILTER_CARDS}
    scales = [one for axis in (1, 2) if (one := plate_scale_arcsec(cards, axis)) is not None]
    return bool(scales) and all(abs(one / float(scale[1]) - 1) <= PLATE_SCALE_TOLERANCE for one in scales)


# Status and version numbers -------------------------------------------------------------------------

FIRST_VERSION = "1.0.0"
VERSION = r"^(0|[1-9]\d{0,5})\.(0|[1-9]\d{0,5})\.(0|[1-9]\d{0,5})$"
_VERSION = re.compile(VERSION, re.ASCII)


class PsfStatus(StrEnum):
    """The trust in a PSF."""

    DRAFT = "draft"
    CERTIFIED = "certified"
    DEPRECATED = "deprecated"


MAY_BECOME = {
    PsfStatus.DRAFT: frozenset({PsfStatus.CERTIFIED}),
    PsfStatus.CERTIFIED: frozenset({PsfStatus.CERTIFIED, PsfStatus.DEPRECATED}),
    PsfStatus.DEPRECATED: frozenset({PsfStatus.DEPRECATED}),
}


def check_transition(before: PsfStatus, after: PsfStatus) -> None:
    """Raise ``DataError`` "wrong-transition" if the status may not change in this way."""
    if after not in MAY_BECOME[before]:
        allowed = " or ".join(sorted(MAY_BECOME[before]))
        advice = ": certify another PSF in its place" if before == PsfStatus.DEPRECATED else ""
        raise DataError(
            "wrong-transition", f"expected the new status {allowed} for a {before} PSF; got {after}{advice}"
        )


def next_version(released: Iterable[str]) -> str:
    """The next free version: the highest of the ``released`` versions, with its second number increased by 1.

    FIRST_VERSION if no version was released.
    """
    # An interpolated PSF is deprecated together with its ends; its version is not one of three numbers.
    numbers = (tuple(map(int, one.split("."))) for one in released if _VERSION.fullmatch(one))
    highest = max(numbers, default=None)
    return FIRST_VERSION if highest is None else f"{highest[0]}.{highest[1] + 1}.0"


def check_version(version: str | None, released: Iterable[str]) -> str:
    """Return the version if it is valid and not among the ``released`` versions of the series.

    Raises ``DataError`` "version-missing", "bad-version" or "version-taken"; the messages name a free version.
    """
    others = list(released)
    free = f"the next free version is {next_version(others)}"
    if version is None:
        raise DataError("version-missing", f"expected a version such as 1.2.0, got none; {free}")
    if not _VERSION.fullmatch(version):
        raise DataError(
            "bad-version",
            f"expected a version of three numbers such as 1.2.0, got {ascii(version)[:60]}; {free}",
        )
    if version in others:
        raise DataError(
            "version-taken", f"expected a version that is new in the series, got {version}; {free}"
        )
    return version


# Times ----------------------------------------------------------------------------------------------

TIME = r"^\d{4}-\d\d-\d\d(T\d\d:\d\d(:\d\d(\.\d{1,9})?)?(Z|[+-]\d\d:\d\d)?)?$"
_TIME = re.compile(TIME, re.ASCII)
LONGEST_STEP_S = 86_400.0
FEWEST_STEPS = 64


def seconds(text: str, name: str = "time") -> float:
    """Convert a time such as 2024-03-01T12:00:00Z to seconds since 1970. A date means the start of that day.

    A time without a zone is in UTC. The message of the error, ``DataError`` "bad-time", contains the ``name`` of the
    field.
    """
    if not _TIME.fullmatch(text):
        raise bad_time(text, name)
    when = utc_time(text, name)
    try:
        at = when.timestamp()
        iso(at)  # raises an error for times near the year 9999 that cannot be converted back
        return at
    except (ValueError, OverflowError) as error:
        raise bad_time(text, name) from error


def iso(at: float) -> str | None:
    """The time in ISO 8601, UTC, to the microsecond; None for an infinity."""
    if math.isinf(at):
        return None
    return f"{datetime.fromtimestamp(at, UTC).replace(tzinfo=None).isoformat()}Z"


@dataclass(frozen=True)
class Validity:
    """The times from ``start`` (included) to ``end`` (excluded)."""

    start: float = -math.inf
    end: float = math.inf

    @classmethod
    def of(cls, start: str | None, end: str | None) -> Validity:
        """The range between two times in ISO 8601. None means an open end.

        Raises ``DataError`` "bad-time" or "empty-range".
        """
        validity = cls(
            -math.inf if start is None else seconds(start, "valid_from"),
            math.inf if end is None else seconds(end, "valid_to"),
        )
        if not validity.start < validity.end:
            raise DataError("empty-range", f"expected valid_from before valid_to, got {validity}")
        return validity

    def overlaps(self, other: Validity) -> bool:
        """Whether the two ranges have a time in common."""
        return self.start < other.end and other.start < self.end

    def __str__(self) -> str:
        return f"[{iso(self.start) or 'any time'}, {iso(self.end) or 'open'})"


def interpolated_name(instrument: str | None, identity: str) -> tuple[str, str]:
    """The name and the version of an interpolated PSF with this id."""
    return f"{instrument or 'psf'}-{INTERPOLATED}", f"0.1.0+{identity[:8]}"


def interpolated_time(start: float, end: float, at: float) -> float:
    """The time, near ``at``, for which a PSF is interpolated between two PSFs: images of a day share one PSF.

    The time between the two PSFs is divided into equal steps of at most a day, at least FEWEST_STEPS of them; ``at`` is
    rounded to the nearest step. Rounding changes the weights of the two PSFs by at most 1 / (2 FEWEST_STEPS), less than
    0.8 %, and makes at most one PSF for each day.

    Parameters
    ----------
    start, end
        The times between which the PSF is interpolated, in seconds since 1970; start < end.
    at
        The time of the image, in seconds since 1970; start <= at <= end.

    Returns
    -------
    float
        A whole second, or ``start`` or ``end`` themselves.
    """
    steps = max(FEWEST_STEPS, math.ceil((end - start) / LONGEST_STEP_S))
    step = round((at - start) / (end - start) * steps)
    if step in (0, steps):
        return end if step else start
    return min(max(float(round(start + step * (end - start) / steps)), start), end)


# As in the query of an upload: the columns are indexed, and indexes have a limit.
NAME_LENGTH, VERSION_LENGTH = 80, 40


def name_of_upload(summary: HeaderSummary, filename: str | None, sha256: str) -> tuple[str, str]:
    """The name and the version of an uploaded PSF: from its header, or else from its file. Longer texts are cut."""
    name = label(summary.psf_name or PurePath(filename or "").stem, NAME_LENGTH) or "uploaded"
    return name, label(summary.psf_version, VERSION_LENGTH) or f"0.0.0+{sha256[:8]}"


def label(text: str | None, most: int) -> str:
    """The printable characters of a text that a file or a client chose, at most ``most`` of them."""
    return printable((text or "")[: 2 * most])[:most].strip()
