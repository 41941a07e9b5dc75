"""Times of observation, and the ranges of times for which a PSF is valid.

In the database, times are seconds since 1970 (UTC), and an open end is an infinity; so ranges can be compared as numbers.
In requests and responses, times are ISO 8601, and an open end is null.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime

from psfcore.errors import DataError
from psfcore.fits.header import bad_time, utc_time

TIME = r"^\d{4}-\d\d-\d\d(T\d\d:\d\d(:\d\d(\.\d{1,9})?)?(Z|[+-]\d\d:\d\d)?)?$"
_TIME = re.compile(TIME, re.ASCII)


def seconds(text: str, name: str = "time") -> float:
    """Convert a time such as 2024-03-01T12:00:00Z to seconds since 1970. A date means the start of that day.

    A time without a zone is in UTC. name: name of the field, for the message. Raises ``DataError`` "bad-time".
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
    text = datetime.fromtimestamp(at, UTC).replace(tzinfo=None).isoformat()
    return f"{text}Z"


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
        made = cls(
            -math.inf if start is None else seconds(start, "valid_from"),
            math.inf if end is None else seconds(end, "valid_to"),
        )
        if not made.start < made.end:
            raise DataError("empty-range", f"expected valid_from before valid_to, got {made}")
        return made

    def holds(self, at: float) -> bool:
        """Whether the time ``at`` is in the range."""
        return self.start <= at < self.end

    def overlaps(self, other: Validity) -> bool:
        """Whether the two ranges have a time in common."""
        return self.start < other.end and other.start < self.end

    def __str__(self) -> str:
        return f"[{iso(self.start) or 'any time'}, {iso(self.end) or 'open'})"
