"""Submit, list, show and cancel jobs: ``/v1/jobs``."""

from __future__ import annotations

import logging
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from pydantic import BaseModel, Field

from psfcore.errors import DataError
from service.http.callers import Caller, KeyFirst, Reading, Submitting
from service.http.paging import Cursor, Limit, Page, page, position
from service.http.problems import RESPONSES, Problem, problem
from service.http.quotas import check_room
from service.http.state import Shared
from service.views import JobView
from workers.catalogue.tables import JobRow
from workers.contract.kinds import KINDS, JobRequest
from workers.contract.phases import Phase
from workers.contract.queues import Queue
from workers.intake import estimates
from workers.intake.again import reopened, without_results
from workers.intake.requests import resolve
from workers.rows import no_such

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=RESPONSES, route_class=KeyFirst)
JobId = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]


class Identified(BaseModel):
    """The identity of the result of a request."""

    result_id: str = Field(description="id that the result has, or would have")
    parameters: dict[str, Any] = Field(description="the parameters, with every default and the PSF filled in")


@router.post(
    "",
    status_code=202,
    summary="Submit a job: a deconvolution, a PSF build, a fit, a cross-validation, a report, a diagnosis or a rerun",
    responses={
        200: {
            "model": JobView,
            "description": "An identical request was made before; the answer is the job of that request.",
        }
    },
)
def submit_job(body: JobRequest, response: Response, caller: Submitting, state: Shared) -> JobView:
    """Put a job into its queue. If an identical request was made before, the answer is the existing job. If the result of that
    job was deleted or lost, the job is queued again."""
    parameters, request_key, estimate = prepared(body, caller, state)
    queue = None if body.queue is None else Queue(body.queue)
    row, new = state.catalogue.jobs.submit(
        body.kind, parameters, request_key, caller.owner, queue=queue, estimate=estimate
    )
    if new:
        log.info("job %s: %s, submitted", row.id, body.kind, extra={"fields": {"job": row.id}})
    if not new and reopened(row, state.catalogue, state.store):
        log.info(
            "job %s: queued again, because its result was lost", row.id, extra={"fields": {"job": row.id}}
        )
        row, new = find(state, caller, row.id), True
    if row.submitted_at is None:  # the job is new, or was moved to a queue of higher priority
        state.reconciler.wake()
    response.status_code = 202 if new else 200
    response.headers["Location"] = f"/v1/jobs/{row.id}"
    return _view(row, state)


def prepared(body: JobRequest, caller: Caller, state: Shared) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """The resolved parameters of a request, the identity of its result, and its estimate as JSON.

    Raises ``Problem`` if the request cannot be accepted.
    """
    check_room(state, caller.owner, more_rows=1)
    try:
        parameters, identity = resolve(
            body, state.catalogue, caller.owner, added_effects=state.settings.added_effects
        )
        estimate = estimates.checked(body.kind, parameters, state.catalogue, caller.owner, state.settings)
    except DataError as error:
        raise problem(error) from error
    return parameters, identity, estimate


@router.post("/identity", summary="The id that the result of a job has or would have")
def get_identity(body: JobRequest, caller: Submitting, state: Shared) -> Identified:
    """Resolve a request without starting a job. Equal requests have equal ids, so a client can skip results that it holds.

    For a kind whose jobs always make a new result (`rerun`), the id is different each time.
    """
    try:
        parameters, identity = resolve(
            body, state.catalogue, caller.owner, added_effects=state.settings.added_effects
        )
    except DataError as error:
        raise problem(error) from error
    return Identified(result_id=identity, parameters=parameters)


@router.get("", summary="List jobs")
def list_jobs(
    request: Request,
    caller: Reading,
    state: Shared,
    phase: Phase | None = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Page[JobView]:
    """Your jobs, newest first. `waiting_before` is not counted here: it is null."""
    rows = state.catalogue.page(
        JobRow, owner=caller.owner, limit=limit + 1, after=position(cursor), phase=phase
    )
    gone = without_results(rows, state.catalogue)
    return page(request, rows, limit, lambda row: JobView.of(row, result_deleted=row.id in gone))


@router.get("/{job_id}", summary="Show a job: phase, progress, result or error")
def get_job(job_id: JobId, caller: Reading, state: Shared) -> JobView:
    """The present state of the job."""
    return _view(find(state, caller, job_id), state)


@router.delete("/{job_id}", status_code=202, summary="Cancel a job")
def cancel_job(job_id: JobId, caller: Submitting, state: Shared) -> JobView:
    """Cancel a job. A queued job ends at once. An executing job ends at its next step. A job that has ended does not change."""
    check_own(find(state, caller, job_id))
    state.catalogue.jobs.cancel(job_id)
    return JobView.of(find(state, caller, job_id))


def _view(row: JobRow, state: Shared) -> JobView:
    """The description of a job, with ``waiting_before`` and ``result_deleted``."""
    gone = bool(without_results([row], state.catalogue))
    return JobView.of(row, state.catalogue.places.before(row), result_deleted=gone)


def check_own(row: JobRow) -> JobRow:
    """The job itself. Raises ``Problem`` 409 if the job is a part of a bulk run: only requests to the bulk run can
    change it."""
    if KINDS[row.kind].parameters is None:
        bulk_id = row.parameters["bulk_id"]
        raise Problem(
            409,
            "job-of-bulk",
            f"expected a job that was submitted; job {row.id} is a part of bulk run {bulk_id}: pause or cancel the bulk run "
            f"(POST /v1/bulk/{bulk_id}/pause or /cancel)",
        )
    return row


def find(state: Shared, caller: Caller, job_id: str) -> JobRow:
    """The row of a job. Raises ``Problem`` 404 if the caller has no such job."""
    row = state.catalogue.jobs.get(job_id)
    if row is None or row.owner != caller.owner:
        raise problem(no_such("job", job_id))
    return row
