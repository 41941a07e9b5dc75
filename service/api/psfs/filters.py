"""The filters of a search for PSFs, as query parameters."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Query

from psfcore.errors import DataError
from service.http.problems import Problem, problem
from workers.catalogue.contexts import NOW
from workers.catalogue.psfs import PsfFilter
from workers.versions import TIME, PsfStatus, seconds

PRINTABLE = r"^[^\x00-\x1f\x7f]+$"
TEXT = r"^[^\x00-\x08\x0b-\x1f\x7f]*$"  # for free text: PostgreSQL cannot store NUL
Text = Annotated[str | None, Query(max_length=80, pattern=PRINTABLE)]
Time = Annotated[
    str | None,
    Query(
        pattern=TIME,
        description="time of observation, such as 2024-03-01T12:00:00Z; a time without a zone is UTC",
    ),
]
InContext = Annotated[
    str | None,
    Query(
        max_length=64,
        pattern=PRINTABLE,
        description=f"id or name of a context; `{NOW}`: the PSFs that are certified now",
    ),
]


def psf_filter(
    instrument: Text = None,
    channel: Annotated[
        str | None,
        Query(max_length=40, pattern=PRINTABLE, description="wavelength in whole angstrom, such as 174"),
    ] = None,
    kind: Annotated[
        str | None,
        Query(
            max_length=40,
            pattern=PRINTABLE,
            description="`total`, `uploaded`, or a component's name such as `diffraction`",
        ),
    ] = None,
    name: Text = None,
    version: Text = None,
    status: PsfStatus | None = None,
    valid_at: Time = None,
) -> PsfFilter:
    """The filter with these values. Raises ``Problem`` 422 if they exclude each other or if the time is wrong."""
    if valid_at is not None and status not in (None, PsfStatus.CERTIFIED):
        raise Problem(
            422,
            "not-valid-at-any-time",
            f"valid_at: expected it only with certified PSFs; got valid_at with status {status}: remove valid_at or status",
        )
    try:
        at = None if valid_at is None else seconds(valid_at, "valid_at")
    except DataError as error:
        raise problem(error) from error
    return PsfFilter(instrument, channel, kind, name, version, None, status, at)


Filters = Annotated[PsfFilter, Depends(psf_filter)]
