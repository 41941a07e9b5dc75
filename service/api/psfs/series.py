"""Series of PSFs, and whether their PSFs may be interpolated in time: ``/v1/series``."""

from __future__ import annotations

import logging
from typing import Annotated

from fastapi import APIRouter, Path
from pydantic import BaseModel, ConfigDict, Field

from psfcore.errors import DataError
from service.api.psfs.filters import TEXT
from service.http.callers import Caller, Certifying, KeyFirst, Reading
from service.http.paging import Page
from service.http.problems import RESPONSES, problem
from service.http.quotas import check_rows
from service.http.state import Shared, State
from service.views.changes import PastChange
from workers.catalogue.tables import SeriesChangeRow
from workers.versions import WORD

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/series", tags=["PSFs"], responses=RESPONSES, route_class=KeyFirst)

Instrument = Annotated[str, Path(pattern=WORD, description="such as `hri_euv`")]
Channel = Annotated[
    str,
    Path(
        pattern=r"^(-|[a-z0-9][a-z0-9_.-]{0,39})$", description="such as `174`; `-`: the channel is unknown"
    ),
]
Kind = Annotated[str, Path(pattern=WORD, description="such as `total`")]


class SeriesChange(BaseModel):
    """Whether the PSFs of a series may be interpolated."""

    model_config = ConfigDict(extra="forbid")

    interpolated: bool = Field(
        description="true: the PSF for an image between the ranges of two certified PSFs is interpolated between them"
    )
    reason: str = Field("", max_length=400, pattern=TEXT, description="the reason, stored for later readers")


class SeriesMove(PastChange):
    """A past change of a series."""

    interpolated: bool

    @classmethod
    def of(cls, row: SeriesChangeRow) -> SeriesMove:
        """The description of a change, from its row in the catalogue."""
        return cls(interpolated=row.interpolated, at=row.at, by=row.by, reason=row.reason)


class SeriesSummary(BaseModel):
    """A series of which a PSF was certified."""

    series: str = Field(description="instrument/channel/kind")
    interpolated: bool = Field(description="whether the PSFs of the series may be interpolated")


class SeriesView(SeriesSummary):
    """A series with the history of its changes."""

    history: list[SeriesMove] = Field(description="the last 200 changes, latest first; all are stored")


@router.get("", summary="List series")
def list_series(caller: Reading, state: Shared) -> Page[SeriesSummary]:
    """The series of which a PSF was certified, sorted by name, on one page."""
    found = state.catalogue.series.all(caller.owner)
    items = [SeriesSummary(series=name, interpolated=interpolated) for name, interpolated in found.items()]
    return Page(items=items, next=None)


@router.get("/{instrument}/{channel}/{kind}", summary="One series")
def get_series(
    instrument: Instrument, channel: Channel, kind: Kind, caller: Reading, state: Shared
) -> SeriesView:
    """Whether the PSFs of a series may be interpolated, and who changed this, when and why."""
    try:
        return _view(state, caller, f"{instrument}/{channel}/{kind}")
    except DataError as error:
        raise problem(error) from error


@router.put("/{instrument}/{channel}/{kind}", summary="Allow or forbid interpolation")
def change_series(
    instrument: Instrument,
    channel: Channel,
    kind: Kind,
    body: SeriesChange,
    caller: Certifying,
    state: Shared,
) -> SeriesView:
    """Say whether the PSFs of a series may be interpolated in time.

    If they may, a deconvolution that names no PSF interpolates for images whose time is between the ranges of two certified
    PSFs. Both PSFs must have been fitted with the same shape and the same diffraction PSF. Existing contexts do not change.
    """
    series = f"{instrument}/{channel}/{kind}"
    check_rows(state, caller.owner)
    try:
        state.catalogue.series.set_interpolated(
            series, caller.owner, body.interpolated, caller.name, body.reason
        )
        log.info("series %s: interpolated %s, by %s", series, body.interpolated, caller.name)
        return _view(state, caller, series)
    except DataError as error:
        raise problem(error) from error


def _view(state: State, caller: Caller, series: str) -> SeriesView:
    """The description of a series. Raises ``DataError`` "no-such-series"."""
    moves = state.catalogue.series.changes(series, caller.owner)
    return SeriesView(
        series=series,
        interpolated=bool(moves) and moves[0].interpolated,
        history=[SeriesMove.of(move) for move in moves],
    )
