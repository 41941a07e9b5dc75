"""Contexts, immutable sets of PSFs: ``/v1/contexts``."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Response
from pydantic import BaseModel, ConfigDict, Field

from service.api.psf_status import Reason, ShownTime, Time
from service.http.callers import Certifying, KeyFirst, Reading
from service.http.paging import Page, Paging
from service.http.problems import RESPONSES, as_problems
from service.http.quotas import check_rows
from service.http.state import Shared
from service.views import PastChange, RowView
from workers.catalogue.contexts import NAME, Pin
from workers.catalogue.tables import PsfContextRow
from workers.contract.requests import ContextName, Identity
from workers.versions import Validity

router = APIRouter(prefix="/v1/contexts", tags=["contexts"], responses=RESPONSES, route_class=KeyFirst)

IdOrName = Annotated[
    str, Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", description="id or name of the context")
]


class PinAsked(BaseModel):
    """A PSF to pin. The default of its time range is the validity of the PSF."""

    model_config = ConfigDict(extra="forbid")

    psf_id: Identity
    valid_from: Time | None = None
    valid_to: Time | None = None


class ContextAsked(BaseModel):
    """A context to create: it pins the given PSFs, or all PSFs that are certified now."""

    model_config = ConfigDict(extra="forbid")

    name: str = Field(pattern=NAME, description="any name except `now` and `default`")
    reason: Reason = ""
    pins: list[PinAsked] | None = Field(
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
        description="whether the PSFs of this series may be interpolated in this context, as for the series when the context was created"
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


class DefaultAsked(BaseModel):
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


@router.post(
    "",
    status_code=201,
    summary="Create a context",
    responses={200: {"model": WholeContext, "description": "The same context already exists."}},
)
def create_context(body: ContextAsked, response: Response, caller: Certifying, state: Shared) -> WholeContext:
    """Pin PSFs under a name: the given PSFs, or all PSFs that are certified now."""
    contexts = state.catalogue.contexts
    check_rows(state, caller.owner, 1 + len(body.pins or ()))
    with as_problems():
        pins = None if body.pins is None else [_pin(pin) for pin in body.pins]
        row, new = contexts.create(body.name, caller.owner, caller.name, reason=body.reason, pins=pins)
    response.status_code = 201 if new else 200
    response.headers["Location"] = f"/v1/contexts/{row.id}"
    return _whole(state, row)


@router.get("", summary="List contexts")
def list_contexts(paging: Paging, caller: Reading, state: Shared) -> Page[ContextView]:
    """Contexts, newest first."""
    rows = state.catalogue.page(PsfContextRow, owner=caller.owner, **paging.query)
    return paging.page(rows, ContextView.of)


@router.get("/default", summary="The default context")
def get_default_context(caller: Reading, state: Shared) -> DefaultView:
    """The context from which the PSF for an image is chosen if a request names no context."""
    contexts = state.catalogue.contexts
    row = contexts.default(caller.owner)
    return DefaultView(
        context=None if row is None else ContextView.of(row),
        history=[Move.model_validate(move) for move in contexts.default_changes(caller.owner)],
    )


@router.put("/default", summary="Change the default context")
def move_default_context(body: DefaultAsked, caller: Certifying, state: Shared) -> DefaultView:
    """Set the default context. If `context` is null, there is no default. The history of changes is kept."""
    check_rows(state, caller.owner)
    with as_problems():
        state.catalogue.contexts.set_default(body.context, caller.owner, caller.name, body.reason)
    return get_default_context(caller, state)


@router.get("/{context}", summary="One context with its pins")
def get_context(context: IdOrName, caller: Reading, state: Shared) -> WholeContext:
    """A context and the PSFs that it pins."""
    with as_problems():
        return _whole(state, state.catalogue.contexts.named(context, caller.owner))


def _pin(pin: PinAsked) -> Pin:
    ranged = {"valid_from", "valid_to"} & pin.model_fields_set
    return Pin(pin.psf_id, Validity.of(pin.valid_from, pin.valid_to) if ranged else None)


def _whole(state: Shared, row: PsfContextRow) -> WholeContext:
    pins = state.catalogue.contexts.pins(row.id, row.owner)
    return WholeContext(
        **ContextView.of(row).model_dump(), pins=[PinView.model_validate(pin) for pin in pins]
    )
