"""Finds the one PSF that meets filters (``/v1/psfs/best``) or fits an image (``/v1/images/{id}/psf``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from psfcore.errors import DataError
from service.api.psfs.filters import Filters, InContext
from service.http.callers import Reading
from service.http.problems import RESPONSES, problem
from service.http.state import Shared
from service.views.psfs import PsfView
from workers.catalogue.tables import ImageRow
from workers.contract.requests import Identity
from workers.intake.psf_choice import MOST_NAMED, Found, look, look_for_image
from workers.versions import TOTAL, WORD, iso

router = APIRouter(tags=["PSFs"], responses=RESPONSES)


class Choice(BaseModel):
    """The one PSF that fits, and the filters of the search."""

    psf: PsfView
    context: str | None = Field(
        description="id of the context that was searched; null: all PSFs were searched"
    )
    instrument: str | None
    channel: str | None
    kind: str | None
    valid_at: str | None = Field(
        description="time of observation for which the PSF must be valid; null: not given"
    )


@router.get("/v1/psfs/best", summary="The one PSF that meets filters")
def get_best_psf(caller: Reading, state: Shared, filters: Filters, context: InContext = None) -> Choice:
    """The PSF with these properties. Without a status and a context, only certified PSFs are searched.

    404: no PSF meets all filters; the message names the filter that excluded the last PSFs. 409: several PSFs meet the filters; the
    message lists them.
    """
    return _choice(lambda: look(state.catalogue, filters, caller.owner, context))


@router.get("/v1/images/{image_id}/psf", summary="The PSF for an image")
def get_psf_for_image(
    image_id: Identity,
    caller: Reading,
    state: Shared,
    context: InContext = None,
    kind: Annotated[str, Query(pattern=WORD)] = TOTAL,
) -> Choice:
    """The certified PSF for the instrument, channel and time of observation in the image's header, or the PSF that a context pins.

    `POST /v1/estimates` says which PSF a deconvolution would use, also if none is certified.
    """
    row = state.row(ImageRow, image_id, caller.owner)
    return _choice(lambda: look_for_image(state.catalogue, row.summary, caller.owner, context, kind))


def _choice(search: Callable[[], Found]) -> Choice:
    candidates: list[dict[str, str | None]] = []
    try:
        found = search()
        candidates = [
            {
                "id": psf.id,
                "name": psf.name,
                "version": psf.version,
                "status": psf.status,
                "series": psf.series,
                "valid_from": None if psf.valid_from is None else iso(psf.valid_from),
                "valid_to": None if psf.valid_to is None else iso(psf.valid_to),
            }
            for psf in found.psfs[:MOST_NAMED]
        ]
        psf = found.one()
    except DataError as error:
        more = {"candidates": candidates} if error.code == "several-psfs-fit" else {}
        raise problem(error, **more) from error
    wanted = found.wanted
    return Choice(
        psf=PsfView.of(psf),
        context=None if found.context is None else found.context.id,
        instrument=wanted.instrument,
        channel=wanted.channel,
        kind=wanted.kind,
        valid_at=None if wanted.valid_at is None else iso(wanted.valid_at),
    )
