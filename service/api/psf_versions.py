"""The versions of PSFs: their status and validity, ``/v1/psfs/{id}/status``; whether the PSFs of a series may be
interpolated in time, ``/v1/series``; the products that were made with deprecated PSFs, ``/v1/affected`` and
``/v1/psfs/{id}/affected``; and contexts, immutable sets of PSFs, ``/v1/contexts``.
"""

from __future__ import annotations

import logging
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from service.http.callers import Caller, Certifying, KeyFirst, Reading
from service.http.paging import Page, Paging, finite, identity, place
from service.http.problems import RESPONSES, as_problems
from service.http.state import Shared, State
from service.views import PastChange, RowView, was_certified
from workers.catalogue.affected import AffectedProduct, PageEnd
from workers.catalogue.contexts import NAME
from workers.catalogue.tables import PsfContextRow, PsfRow
from workers.contract.psf_status import Pin, Reason, StatusChange
from workers.contract.requests import ContextName, Identity
from workers.versions import MAY_BECOME, WORD, PsfStatus, iso, next_version

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/psfs", tags=["PSFs"], responses=RESPONSES, route_class=KeyFirst)
series = APIRouter(prefix="/v1/series", tags=["PSFs"], responses=RESPONSES, route_class=KeyFirst)
contexts = APIRouter(prefix="/v1/contexts", tags=["contexts"], responses=RESPONSES, route_class=KeyFirst)
affected = APIRouter(tags=["PSFs"], responses=RESPONSES)

# A time of the catalogue, seconds since 1970, as ISO 8601; null for none and for an open end.
ShownTime = Annotated[str | None, BeforeValidator(lambda at: iso(at) if isinstance(at, float) else at)]
Instrument = Annotated[str, Path(pattern=WORD, description="such as `hri_euv`")]
Channel = Annotated[
    str,
    Path(
        pattern=r"^(-|[a-z0-9][a-z0-9_.-]{0,39})$", description="such as `174`; `-`: the channel is unknown"
    ),
]
PsfKind = Annotated[str, Path(pattern=WORD, description="such as `total`")]
IdOrName = Annotated[
    str, Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", description="id or name of the context")
]


class Change(PastChange):
    """A past change of status."""

    status_before: PsfStatus
    status: PsfStatus
    version_before: str
    version: str
    valid_from: ShownTime
    valid_to: ShownTime
    successor: str | None = Field(validation_alias="successor_id")


class StatusView(RowView):
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
    valid_from: ShownTime = Field(description="null: no lower limit, or never certified")
    valid_to: ShownTime = Field(description="null: no upper limit, or never certified")
    successor: str | None
    may_become: list[PsfStatus]
    next_version: str | None = Field(description="a free version of the series; null: the PSF has no series")
    history: list[Change] = Field(description="oldest first; never deleted")


@router.get("/{psf_id}/status", summary="A PSF's status and its history")
def get_psf_status(psf_id: Identity, caller: Reading, state: Shared) -> StatusView:
    """The status of a PSF, the changes that are allowed now, and the past changes: who made each change, when and
    why.
    """
    return _view(state, caller, state.row(PsfRow, psf_id, caller.owner))


@router.post("/{psf_id}/status", summary="Certify or deprecate a PSF")
def change_psf_status(psf_id: Identity, body: StatusChange, caller: Certifying, state: Shared) -> StatusView:
    """Certify a draft, change the range of a certified PSF, deprecate a certified PSF, or name the successor of a
    deprecated PSF.

    The time ranges of the certified PSFs of a series must not overlap. If the range in the request overlaps the range
    of another certified PSF, the answer is 409; the message names this PSF.
    """
    with as_problems():
        row = state.catalogue.psfs.change(psf_id, caller.owner, body, caller.name)
    log.info("PSF %s: %s, version %s, by %s", row.id, row.status, row.version, caller.name)
    return _view(state, caller, row)


def _view(state: State, caller: Caller, row: PsfRow) -> StatusView:
    psfs = state.catalogue.psfs
    return StatusView.of_columns(
        row,
        was_certified=was_certified(row),
        successor=row.successor_id,
        may_become=sorted(MAY_BECOME[PsfStatus(row.status)]),
        next_version=None if row.series is None else next_version(psfs.released(row.series, caller.owner)),
        history=[Change.model_validate(change) for change in psfs.changes(row.id, caller.owner)],
    )


class SeriesChange(BaseModel):
    """Whether the PSFs of a series may be interpolated."""

    model_config = ConfigDict(extra="forbid")

    interpolated: bool = Field(
        description="true: the PSF for an image between the ranges of two certified PSFs is interpolated between them"
    )
    reason: Reason = ""


class SeriesMove(PastChange):
    """A past change of a series."""

    interpolated: bool


class SeriesSummary(BaseModel):
    """A series of which a PSF was certified."""

    series: str = Field(description="instrument/channel/kind")
    interpolated: bool = Field(description="whether the PSFs of the series may be interpolated")


class SeriesView(SeriesSummary):
    """A series with the history of its changes."""

    history: list[SeriesMove] = Field(description="the last 200 changes, latest first; all are stored")


@series.get("", summary="List series")
def list_series(caller: Reading, state: Shared) -> Page[SeriesSummary]:
    """The series of which a PSF was certified, sorted by name, on one page."""
    series_of_owner = state.catalogue.series.all(caller.owner)
    items = [
        SeriesSummary(series=name, interpolated=interpolated)
        for name, interpolated in series_of_owner.items()
    ]
    return Page(items=items, next=None)


@series.get("/{instrument}/{channel}/{kind}", summary="One series")
def get_series(
    instrument: Instrument, channel: Channel, kind: PsfKind, caller: Reading, state: Shared
) -> SeriesView:
    """Whether the PSFs of a series may be interpolated, and who changed this, when and why."""
    return _series(state, caller, f"{instrument}/{channel}/{kind}")


@series.put("/{instrument}/{channel}/{kind}", summary="Allow or forbid interpolation")
def change_series(
    instrument: Instrument,
    channel: Channel,
    kind: PsfKind,
    body: SeriesChange,
    caller: Certifying,
    state: Shared,
) -> SeriesView:
    """Say whether the PSFs of a series may be interpolated in time.

    If they may, a deconvolution that names no PSF interpolates for images whose time is between the ranges of two
    certified PSFs. Both PSFs must have been fitted with the same shape and the same diffraction PSF. Existing contexts
    do not change.
    """
    name = f"{instrument}/{channel}/{kind}"
    with as_problems():
        state.catalogue.series.set_interpolated(
            name, caller.owner, body.interpolated, caller.name, body.reason
        )
    log.info("series %s: interpolated %s, by %s", name, body.interpolated, caller.name)
    return _series(state, caller, name)


def _series(state: State, caller: Caller, name: str) -> SeriesView:
    """The description of a series. Raises ``Problem`` "no-such-series"."""
    with as_problems():
        moves = state.catalogue.series.changes(name, caller.owner)
    return SeriesView(
        series=name,
        interpolated=bool(moves) and moves[0].interpolated,
        history=[SeriesMove.model_validate(move) for move in moves],
    )


class AffectedView(RowView):
    """A product, the PSF that made it, and the replacement of this PSF, if there is one."""

    product_id: str
    image_id: str
    created_at: float
    psf_id: str
    psf_version: str = Field(description="version of the PSF when the product was made")
    psf_status: str
    successor: str | None
    redo_with: str | None = Field(
        description="id of the replacement PSF, which is the certified PSF at the end of the chain of successors; "
        "null: there is no replacement"
    )

    @classmethod
    def of(cls, one: AffectedProduct) -> AffectedView:
        """The description of an affected product and its PSF, from their rows in the catalogue."""
        return cls.of_columns(
            one.product,
            product_id=one.product.id,
            psf_status=one.psf.status,
            successor=one.psf.successor_id,
            redo_with=None if one.redo_with is None else one.redo_with.id,
        )


@affected.get("/v1/affected", summary="Products made with deprecated PSFs")
def list_affected(
    paging: Paging,
    caller: Reading,
    state: Shared,
    superseded: Annotated[bool, Query(description="only products whose PSF has a successor")] = False,
) -> Page[AffectedView]:
    """Products whose PSF is deprecated, sorted by PSF; the products of each PSF are listed newest first."""
    at = place(paging.cursor, identity, finite, identity)
    after = None if at is None else PageEnd(*at)
    rows = state.catalogue.affected.page(
        caller.owner, superseded=superseded, limit=paging.limit + 1, after=after
    )
    return paging.page(rows, AffectedView.of, lambda one: (one.psf.id, *_place(one)))


@affected.get("/v1/psfs/{psf_id}/affected", summary="Products made with a PSF")
def list_affected_by_psf(
    psf_id: Identity, paging: Paging, caller: Reading, state: Shared
) -> Page[AffectedView]:
    """Products made with this PSF, which may have any status. The newest product is listed first."""
    psf = state.row(PsfRow, psf_id, caller.owner)
    return paging.page(state.catalogue.affected.of_psf(psf, **paging.query), AffectedView.of, _place)


def _place(one: AffectedProduct) -> tuple[str, ...]:
    """The place of a product in its cursor."""
    return repr(one.product.created_at), one.product.id


# --- contexts -------------------------------------------------------------------------------------------


class NewContext(BaseModel):
    """A context to create: it pins the given PSFs, or all PSFs that are certified now."""

    model_config = ConfigDict(extra="forbid")

    name: str = Field(pattern=NAME, description="any name except `now` and `default`")
    reason: Reason = ""
    pins: list[Pin] | None = Field(
        None, max_length=10_000, description="null: all PSFs that are certified now"
    )


class PinView(BaseModel):
    """The PSF that is used for a series in a range of observation times."""

    model_config = ConfigDict(from_attributes=True)

    series: str = Field(description="instrument/channel/kind")
    valid_from: ShownTime = Field(description="null: no lower limit")
    valid_to: ShownTime = Field(description="null: no upper limit")
    psf_id: str
    version: str = Field(description="version of the PSF when it was pinned")
    interpolated: bool = Field(
        description="whether the PSFs of this series may be interpolated in this context, as for the series when the "
        "context was created"
    )


class ContextView(RowView):
    """A context. A context never changes; for other pins, create another context."""

    id: str = Field(description="SHA-256 of the name and the pins of the context")
    name: str
    created_at: float
    created_by: str
    reason: str
    size: int = Field(description="number of pins")

    @classmethod
    def of(cls, row: PsfContextRow) -> ContextView:
        """The description of a context, from its row in the catalogue."""
        return cls.of_columns(row, size=row.pins)


class WholeContext(ContextView):
    """A context with its pins."""

    pins: list[PinView] = Field(description="PSFs of the context, sorted by series and time")


class DefaultContext(BaseModel):
    """The new default context, from which the PSF for an image is chosen."""

    model_config = ConfigDict(extra="forbid")

    context: ContextName | None = Field(
        description="id or name; null: the PSFs that are certified at the time of a request"
    )
    reason: Reason = ""


class Move(PastChange):
    """A past change of the default context."""

    context: str | None = Field(validation_alias="context_id")


class DefaultView(BaseModel):
    """The default context and its history."""

    context: ContextView | None = Field(
        description="null: the PSFs that are certified at the time of a request"
    )
    history: list[Move] = Field(description="the last 200 changes, latest first; all are stored")


@contexts.post(
    "",
    status_code=201,
    summary="Create a context",
    responses={200: {"model": WholeContext, "description": "The same context already exists."}},
)
def create_context(body: NewContext, response: Response, caller: Certifying, state: Shared) -> WholeContext:
    """Pin PSFs under a name: the given PSFs, or all PSFs that are certified now."""
    with as_problems():
        row, new = state.catalogue.contexts.create(
            body.name, caller.owner, caller.name, reason=body.reason, pins=body.pins
        )
    response.status_code = 201 if new else 200
    response.headers["Location"] = f"/v1/contexts/{row.id}"
    return _whole(state, row)


@contexts.get("", summary="List contexts")
def list_contexts(paging: Paging, caller: Reading, state: Shared) -> Page[ContextView]:
    """Contexts, newest first."""
    rows = state.catalogue.page(PsfContextRow, owner=caller.owner, **paging.query)
    return paging.page(rows, ContextView.of)


@contexts.get("/default", summary="The default context")
def get_default_context(caller: Reading, state: Shared) -> DefaultView:
    """The context from which the PSF for an image is chosen if a request names no context."""
    row = state.catalogue.contexts.default(caller.owner)
    return DefaultView(
        context=None if row is None else ContextView.of(row),
        history=[
            Move.model_validate(move) for move in state.catalogue.contexts.default_changes(caller.owner)
        ],
    )


@contexts.put("/default", summary="Change the default context")
def move_default_context(body: DefaultContext, caller: Certifying, state: Shared) -> DefaultView:
    """Set the default context. If `context` is null, there is no default. The history of changes is kept."""
    with as_problems():
        state.catalogue.contexts.set_default(body.context, caller.owner, caller.name, body.reason)
    return get_default_context(caller, state)


@contexts.get("/{context}", summary="One context with its pins")
def get_context(context: IdOrName, caller: Reading, state: Shared) -> WholeContext:
    """A context and the PSFs that it pins."""
    with as_problems():
        return _whole(state, state.catalogue.contexts.named(context, caller.owner))


def _whole(state: Shared, row: PsfContextRow) -> WholeContext:
    pins = state.catalogue.contexts.pins(row.id, row.owner)
    return WholeContext(
        **ContextView.of(row).model_dump(), pins=[PinView.model_validate(pin) for pin in pins]
    )
