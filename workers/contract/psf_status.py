"""What clients send about the status of PSFs: a change of the status of one PSF, and the pins of a context.

The catalogue gets the same objects; so a request is checked once, where it enters.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from workers.contract.requests import Identity
from workers.texts import Lines
from workers.versions import TIME, WORD, PsfStatus, Validity

MOST_REASON = 400  # characters of a reason that the database stores
Time = Annotated[
    str, Field(pattern=TIME, description="such as 2024-03-01T12:00:00Z; a time without a zone is UTC")
]
Reason = Annotated[Lines, Field(max_length=MOST_REASON, description="the reason, stored for later readers")]
Word = Annotated[str, Field(pattern=WORD)]


class TimeRange(BaseModel):
    """A range of observation times, which may be left out."""

    model_config = ConfigDict(extra="forbid")

    valid_from: Time | None = Field(
        None, description="start of the range of observation times; null: no lower limit"
    )
    valid_to: Time | None = Field(None, description="end of the range, excluded; null: no upper limit")

    @property
    def validity(self) -> Validity | None:
        """The range; None if neither of its ends is given. Raises ``DataError`` "bad-time" or "empty-range"."""
        given = {"valid_from", "valid_to"} & self.model_fields_set
        return Validity.of(self.valid_from, self.valid_to) if given else None


class StatusChange(TimeRange):
    """A change of a PSF's status: certify a draft, change the range of a certified PSF, or deprecate a certified
    PSF.
    """

    status: PsfStatus
    reason: Reason = ""
    version: str | None = Field(
        None,
        max_length=40,
        description="for a draft: a version of three numbers such as 1.2.0, which the series does not have yet",
    )
    supersedes: list[Identity] = Field(
        [],
        max_length=100,
        description="ids of certified PSFs of the series that are deprecated in the same step",
    )
    successor: Identity | None = Field(
        None, description="for a deprecated PSF: id of the certified PSF to use instead"
    )
    instrument: Word | None = Field(None, description="for a draft whose file names no instrument")
    channel: Word | None = Field(
        None,
        description="for a draft whose file names no wavelength; or a variant of its channel for one filter (card "
        "FILTER) or plate scale, such as `174-open_2` or `174-0.984arcsec`",
    )
    kind: Word | None = Field(None, description="for an uploaded draft, such as `total`")


class Pin(TimeRange):
    """A PSF to pin. The default of its time range is the validity of the PSF."""

    psf_id: Identity
