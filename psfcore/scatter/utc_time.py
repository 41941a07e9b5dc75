"""Times of observation in UTC."""

from __future__ import annotations

from datetime import UTC, datetime

from psfcore.errors import DataError


def utc_time(given: datetime | str, name: str) -> datetime:
    """A time with a zone. A time without a zone is in UTC; a date means the start of that day.

    name: name of the field, for the message. Raises DataError "bad-time".
    """
    try:
        at = given if isinstance(given, datetime) else datetime.fromisoformat(given)
    except (TypeError, ValueError) as error:
        raise bad_time(given, name) from error
    return at if at.tzinfo else at.replace(tzinfo=UTC)


def bad_time(given: object, name: str) -> DataError:
    """The error for something that is not a time."""
    return DataError(
        "bad-time", f"{name}: expected a time such as 2024-03-01T12:00:00Z, got {ascii(given)[:60]}"
    )
