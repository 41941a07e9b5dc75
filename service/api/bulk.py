"""Bulk runs, many images deconvolved in the same way: ``/v1/bulk``."""

from __future__ import annotations

import logging
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from psfcore.errors import DataError
from service.http.callers import Bulk, Caller, KeyFirst, Reading
from service.http.paging import Cursor, Limit, Page, following, no_cursor, page, place, position
from service.http.problems import RESPONSES, Problem, problem
from service.http.quotas import check_room, check_rows
from service.http.state import Shared
from service.views import RowView
from workers.bulk.dry_run import BulkEstimate, dry_run
from workers.bulk.runs import begin, cancel_turns
from workers.catalogue.bulk_tables import BulkRow
from workers.contract.bulk import STOPPED, BulkPhase, BulkRequest, ItemState
from workers.contract.phases import JobError
from workers.rows import no_such

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/bulk", tags=["bulk"], responses=RESPONSES, route_class=KeyFirst)
BulkId = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
SAMPLE, MOST_SAMPLED = 200, 10_000  # images that an estimate examines
LOOK_FROM = 1.0  # a person should inspect images with this artefact score or a higher one


class Counts(BaseModel):
    """Numbers of images by state."""

    total: int = Field(description="images listed so far; more are added while `listed` is false")
    waiting: int
    at_work: int
    done: int
    reused: int = Field(
        description="done images whose product already existed, so that they were not deconvolved"
    )
    failed: int
    to_look_at: int = Field(
        description=f"done images that a person should inspect: artefact score {LOOK_FROM:g} or more"
    )


class BulkView(RowView):
    """A bulk run."""

    id: str
    name: str
    phase: BulkPhase
    created_at: float
    ended_at: float | None
    psf_id: str | None = Field(
        description="id of the PSF of all images; null: the context pins a PSF for each image"
    )
    context_id: str | None
    request: dict[str, Any] = Field(description="the request, without the ids of uploaded images")
    listed: bool = Field(
        description="whether all files are listed; false: the numbers of images and of waiting images are too small"
    )
    images: Counts
    images_an_hour: float | None = Field(description="speed in the last hour; null: unknown")
    time_left_s: float | None = Field(
        description="estimated time left; null: unknown, for example while files are listed, or the run is not running"
    )
    error: JobError | None = Field(description="the error that stopped the run; null: no error stopped it")
    results: str = Field(description="address of the manifest of the done images")
    failures: str = Field(description="address of the failed images, with reasons")
    events: str = Field(description="address at which progress is sent as server-sent events")

    @classmethod
    def of(cls, row: BulkRow, state: Shared) -> BulkView:
        """The description of a bulk run, from its row in the catalogue."""
        progress = state.catalogue.bulks.progress
        pace, here = progress.pace(row), f"/v1/bulk/{row.id}"
        left = row.total - row.done - row.failed
        rate = None if row.phase in STOPPED else pace.images_an_hour
        counts = Counts(
            total=row.total,
            waiting=max(0, left - pace.taken),
            at_work=pace.taken,
            done=row.done,
            reused=row.reused,
            failed=row.failed,
            to_look_at=progress.to_look_at(row.id, LOOK_FROM),
        )
        return cls.of_columns(
            row,
            images=counts,
            images_an_hour=rate,
            time_left_s=left * 3600.0 / rate if rate and row.phase == BulkPhase.RUNNING else None,
            results=f"{here}/results",
            failures=f"{here}/failures",
            events=f"{here}/events",
        )


class BulkLine(BaseModel):
    """A bulk run in a list."""

    model_config = ConfigDict(from_attributes=True)
    id: str
    name: str
    phase: BulkPhase
    created_at: float
    ended_at: float | None
    listed: bool = Field(description="whether all files are listed; false: `total` is too small")
    total: int
    done: int
    failed: int


class Failed(BaseModel):
    """An image that could not be deconvolved."""

    model_config = ConfigDict(from_attributes=True)
    position: int
    source: str = Field(description="id of the upload, or path of the file")
    attempts: int
    ended_at: float | None
    error: JobError


@router.post("/estimate", summary="Estimate a bulk run without starting it")
def estimate_bulk(
    body: BulkRequest,
    caller: Bulk,
    state: Shared,
    sample: Annotated[
        int, Query(ge=1, le=MOST_SAMPLED, description="largest number of images that are examined")
    ] = SAMPLE,
) -> BulkEstimate:
    """Count the images of a bulk run, examine a sample of them, and estimate the run. Nothing is started or stored.

    The request and its errors are the same as for `POST /v1/bulk`. The pixels are not read. Therefore the run may also
    refuse images whose pixels cannot be used.
    """
    try:
        return dry_run(body, state.catalogue, caller.owner, state.settings, sample=sample)
    except DataError as error:
        raise problem(error) from error


@router.post(
    "",
    status_code=202,
    summary="Start a bulk run",
    responses={
        200: {
            "model": BulkView,
            "description": "A bulk run of an identical request is open; the answer is that run.",
        }
    },
)
def submit_bulk(body: BulkRequest, response: Response, caller: Bulk, state: Shared) -> BulkView:
    """Deconvolve many images in the same way. Workers list the files, and deconvolve images as soon as they are listed.
    All other jobs run first.

    The PSF, or the context that pins a PSF for each image, is fixed when the run starts. An existing product is not made again.
    """
    check = check_room if body.keeps_products else check_rows
    check(state, caller.owner, 1 + len(body.images))
    try:
        row, new = begin(body, state.catalogue, caller.owner, state.settings)
    except DataError as error:
        raise problem(error) from error
    if new:
        log.info("bulk run %s: submitted, %d uploads", row.id, row.total, extra={"fields": {"bulk": row.id}})
        state.reconciler.wake()
    response.status_code = 202 if new else 200
    response.headers["Location"] = f"/v1/bulk/{row.id}"
    return BulkView.of(row, state)


@router.get("", summary="List bulk runs")
def list_bulks(
    request: Request,
    caller: Reading,
    state: Shared,
    phase: BulkPhase | None = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Page[BulkLine]:
    """Bulk runs, newest first."""
    rows = state.catalogue.page(
        BulkRow, owner=caller.owner, limit=limit + 1, after=position(cursor), phase=phase
    )
    return page(request, rows, limit, BulkLine.model_validate)


@router.get("/{bulk_id}", summary="One bulk run: progress, speed and time left")
def get_bulk(bulk_id: BulkId, caller: Reading, state: Shared) -> BulkView:
    """The bulk run as it is now."""
    return BulkView.of(find(state, caller, bulk_id), state)


@router.get("/{bulk_id}/failures", summary="Failed images, with reasons")
def list_failures(
    bulk_id: BulkId,
    request: Request,
    caller: Reading,
    state: Shared,
    limit: Annotated[int, Query(ge=1, le=200, description="rows per page")] = 50,
    cursor: Cursor = None,
) -> Page[Failed]:
    """The failed images, in the order of the run."""
    row = find(state, caller, bulk_id)
    after = _after(cursor)
    items = state.catalogue.bulks.progress.items(row.id, ItemState.FAILED, after=after, limit=limit + 1)
    next_page = following(request, str(items[limit - 1].position)) if len(items) > limit else None
    return Page(items=[Failed.model_validate(item) for item in items[:limit]], next=next_page)


@router.post("/{bulk_id}/pause", summary="Pause a bulk run")
def pause_bulk(bulk_id: BulkId, caller: Bulk, state: Shared) -> BulkView:
    """Start no more images. Workers finish the images that they have started."""
    row = find(state, caller, bulk_id)
    _done(state.catalogue.bulks.pause(row.id), row, "LISTING or RUNNING")
    return get_bulk(bulk_id, caller, state)


@router.post("/{bulk_id}/resume", summary="Resume a bulk run")
def resume_bulk(bulk_id: BulkId, caller: Bulk, state: Shared) -> BulkView:
    """Resume a paused or failed bulk run."""
    row = find(state, caller, bulk_id)
    _done(state.catalogue.bulks.resume(row.id), row, "PAUSED or ERROR")
    state.reconciler.wake()
    return get_bulk(bulk_id, caller, state)


@router.post("/{bulk_id}/cancel", summary="Cancel a bulk run")
def cancel_bulk(bulk_id: BulkId, caller: Bulk, state: Shared) -> BulkView:
    """End the run. Workers stop at the next step of their images. Finished products are kept."""
    row = find(state, caller, bulk_id)
    _done(state.catalogue.bulks.cancel(row.id), row, "LISTING, RUNNING, PAUSED or ERROR")
    cancel_turns(state.catalogue, row.id)
    return get_bulk(bulk_id, caller, state)


@router.post("/{bulk_id}/retry", summary="Retry failed images")
def retry_bulk(bulk_id: BulkId, caller: Bulk, state: Shared) -> BulkView:
    """Queue the failed images again. Images that are already done are not processed again.

    The answer is 409 if this run has ended and another bulk run of an identical request is open. The message names that run.
    """
    row = find(state, caller, bulk_id)
    try:
        changed = state.catalogue.bulks.retry(row.id)
    except DataError as error:
        raise Problem(409, error.code, error.message) from error
    _done(changed is not None, row, "other than CANCELLED")
    state.reconciler.wake()
    return get_bulk(bulk_id, caller, state)


@router.delete("/{bulk_id}", status_code=204, summary="Delete a bulk run", response_class=Response)
def delete_bulk(bulk_id: BulkId, caller: Bulk, state: Shared) -> Response:
    """Remove the run from the catalogue and from your quota. Its products and the files in its output folder stay.

    The manifest and the reasons of failures are deleted with the run. The answer is 409 if the run is LISTING or
    RUNNING: cancel the run first. If the service stops during the deletion, a cancelled run with fewer images may
    remain: delete this run again. If a product is only in the output folder, a later run makes the product again,
    because only the deleted run knew its file.
    """
    row = find(state, caller, bulk_id)
    if not state.catalogue.bulks.delete(row.id):
        there = find(state, caller, bulk_id)  # if another request deleted it meanwhile, the answer is 404
        _done(False, there, "PAUSED, ERROR, COMPLETED or CANCELLED", ": cancel it first")
    cancel_turns(state.catalogue, row.id)
    return Response(status_code=204)


def find(state: Shared, caller: Caller, bulk_id: str) -> BulkRow:
    """The row of a bulk run of the caller. Raises ``Problem`` 404."""
    row = state.catalogue.bulks.get(bulk_id)
    if row is None or row.owner != caller.owner:
        raise problem(no_such("bulk", bulk_id))
    return row


def _done(changed: bool, row: BulkRow, expected: str, advice: str = "") -> None:
    if not changed:
        raise Problem(
            409,
            "wrong-phase",
            f"expected a bulk run in phase {expected}; this bulk run is in phase {row.phase}{advice}",
        )


def _after(cursor: str | None) -> int:
    """The position in a cursor. Raises ``Problem`` 422 if this service did not issue it."""
    parts = place(cursor, 1)
    if parts is None:
        return -1
    if not parts[0].isdecimal() or len(parts[0]) > 9:
        raise no_cursor()
    return int(parts[0])
