"""Uploaded transits: ``/v1/transits``."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.http import uploads
from service.http.callers import Reading, Submitting
from service.http.paging import Cursor, Limit, Page, page, position
from service.http.problems import RESPONSES
from service.http.quotas import Allowed
from service.http.state import Shared
from service.views import TransitDetails, TransitView
from workers.catalogue.tables import TransitRow
from workers.contract.requests import Identity
from workers.intake.uploads import transit_row

router = APIRouter(prefix="/v1/transits", tags=["transits"], responses=RESPONSES)


@router.post(
    "",
    status_code=201,
    summary="Upload a transit",
    openapi_extra=uploads.OPENAPI_TRANSIT_BODY,
    responses={200: {"model": TransitDetails, "description": "The same file was already uploaded."}},
)
async def upload_transit(
    request: Request, response: Response, caller: Submitting, state: Shared
) -> TransitDetails:
    """Upload one archive: the images of a transit, their transit.json and, optionally, the known part of the PSF.

    The table of contents and transit.json are checked at upload. The pixels are read by the jobs that use the transit.
    """
    settings, take = state.settings, Allowed(state, caller)
    async with uploads.receive_transit(
        request,
        state.store,
        settings.archive_limits,
        settings.max_transit_bytes,
        take,
    ) as upload:
        row = transit_row(caller.owner, upload.sha256, upload.bytes, upload.filename, upload.summary)
        row, new = await run_in_threadpool(take.keep, upload.path, upload.sha256, row)
    response.status_code = 201 if new else 200
    response.headers["Location"] = f"/v1/transits/{row.id}"
    return TransitDetails.of(row)


@router.get("", summary="List uploaded transits")
def list_transits(
    request: Request, caller: Reading, state: Shared, limit: Limit = 50, cursor: Cursor = None
) -> Page[TransitView]:
    """Uploaded transits, newest first, without the names of their files."""
    rows = state.catalogue.page(TransitRow, owner=caller.owner, limit=limit + 1, after=position(cursor))
    return page(request, rows, limit, TransitView.of)


@router.get("/{transit_id}", summary="One uploaded transit")
def get_transit(transit_id: Identity, caller: Reading, state: Shared) -> TransitDetails:
    """An uploaded transit, with its files."""
    row = state.row(TransitRow, transit_id, caller.owner)
    return TransitDetails.of(row)
