"""The status and validity of a PSF: ``/v1/psfs/{id}/status``."""

from __future__ import annotations

import logging
from typing import Annotated

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from psfcore.errors import DataError
from service.api.psfs.filters import TEXT
from service.http.callers import Caller, Certifying, KeyFirst, Reading
from service.http.problems import RESPONSES, problem
from service.http.quotas import check_rows
from service.http.state import Shared, State
from service.views.changes import PastChange
from service.views.psfs import was_certified
from workers.catalogue.psfs import StatusAsked
from workers.catalogue.tables import PsfChangeRow, PsfRow
from workers.contract.requests import Identity
from workers.versions import MAY_BECOME, TIME, WORD, PsfStatus, Validity, iso, next_version

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/psfs", tags=["PSFs"], responses=RESPONSES, route_class=KeyFirst)

Time = Annotated[
    str, Field(pattern=TIME, description="such as 2024-03-01T12:00:00Z; a time without a zone is UTC")
]
Word = Annotated[str, Field(pattern=WORD)]


class StatusChange(BaseModel):
    """A change of a PSF's status: certify a draft, change the range of a certified PSF, or deprecate a certified
    PSF."""

    model_config = ConfigDict(extra="forbid")

    status: PsfStatus
    reason: str = Field("", max_length=400, pattern=TEXT, description="the reason, stored for later readers")
    version: str | None = Field(
        None,
        max_length=40,
        description="for a draft: a version of three numbers such as 1.2.0, which the series does not have yet",
    )
    valid_from: Time | None = Field(
        None, description="start of the range of observation times; null: no lower limit"
    )
    valid_to: Time | None = Field(None, description="end of the range, excluded; null: no upper limit")
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
        description="for a draft whose file names no wavelength; or a variant of its channel for one filter (card FILTER) or plate "
        "scale, such as `174-open_2` or `174-0.984arcsec`",
    )
    kind: Word | None = Field(None, description="for an uploaded draft, such as `total`")


class Change(PastChange):
    """A past change of status."""

    status_before: PsfStatus
    status: PsfStatus
    version_before: str
    version: str
    valid_from: str | None
    valid_to: str | None
    successor: str | None

    @classmethod
    def of(cls, row: PsfChangeRow) -> Change:
        """The description of a change of status, from its row in the catalogue."""
        return cls(
            at=row.at,
            by=row.by,
            status_before=PsfStatus(row.status_before),
            status=PsfStatus(row.status),
            version_before=row.version_before,
            version=row.version,
            valid_from=None if row.valid_from is None else iso(row.valid_from),
            valid_to=None if row.valid_to is None else iso(row.valid_to),
            successor=row.successor_id,
            reason=row.reason,
        )


class StatusView(BaseModel):
    """A PSF's status, its allowed changes, and its history."""

    id: str
    status: PsfStatus
    version: str
    series: str | None = Field(
        description="instrument, channel and kind, as instrument/channel/kind; null: the instrument is unknown"
    )
    was_certified: bool = Field(
        description="whether the PSF is or was certified; if not, it has no range of observation times"
    )
    valid_from: str | None = Field(description="null: no lower limit, or never certified")
    valid_to: str | None = Field(description="null: no upper limit, or never certified")
    successor: str | None
    may_become: list[PsfStatus]
    next_version: str | None = Field(description="a free version of the series; null: the PSF has no series")
    history: list[Change] = Field(description="oldest first; never deleted")


@router.get("/{psf_id}/status", summary="A PSF's status and its history")
def get_psf_status(psf_id: Identity, caller: Reading, state: Shared) -> StatusView:
    """The status of a PSF, the changes that are allowed now, and the past changes: who made each change, when and why."""
    row = state.row(PsfRow, psf_id, caller.owner)
    return _view(state, caller, row)


@router.post("/{psf_id}/status", summary="Certify or deprecate a PSF")
def change_psf_status(psf_id: Identity, body: StatusChange, caller: Certifying, state: Shared) -> StatusView:
    """Certify a draft, change the range of a certified PSF, deprecate a certified PSF, or name the successor of a
    deprecated PSF.

    The time ranges of the certified PSFs of a series must not overlap. If the range in the request overlaps the range
    of another certified PSF, the answer is 409; the message names this PSF.
    """
    # A deprecation is never refused for the quota, because a wrong PSF must not stay certified.
    if body.status == PsfStatus.CERTIFIED:
        check_rows(state, caller.owner)
    try:
        row = state.catalogue.psfs.change(psf_id, caller.owner, _asked(body), caller.name)
    except DataError as error:
        raise problem(error) from error
    log.info("PSF %s: %s, version %s, by %s", row.id, row.status, row.version, caller.name)
    return _view(state, caller, row)


def _asked(body: StatusChange) -> StatusAsked:
    told = {"valid_from", "valid_to"} & body.model_fields_set
    return StatusAsked(
        status=body.status,
        reason=body.reason,
        version=body.version,
        validity=Validity.of(body.valid_from, body.valid_to) if told else None,
        successor_id=body.successor,
        supersedes=tuple(body.supersedes),
        instrument=body.instrument,
        channel=body.channel,
        kind=body.kind,
    )


def _view(state: State, caller: Caller, row: PsfRow) -> StatusView:
    psfs = state.catalogue.psfs
    return StatusView(
        id=row.id,
        status=PsfStatus(row.status),
        version=row.version,
        series=row.series,
        was_certified=was_certified(row),
        valid_from=None if row.valid_from is None else iso(row.valid_from),
        valid_to=None if row.valid_to is None else iso(row.valid_to),
        successor=row.successor_id,
        may_become=sorted(MAY_BECOME[PsfStatus(row.status)]),
        next_version=None if row.series is None else next_version(psfs.released(row.series, caller.owner)),
        history=[Change.of(change) for change in psfs.changes(row.id, caller.owner)],
    )
