"""Submit, list, show and cancel jobs: ``/v1/jobs``."""

from __future__ import annotations

import logging
import time
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from pydantic import BaseModel, Field

from psfcore.errors import DataError
from service.http.callers import Caller, KeyFirst, Reading, Submitting
from service.http.paging import Cursor, Limit, Page, page, position
from service.http.problems import RESPONSES, Problem, problem
from service.http.quotas import check_room, rows_held
from service.http.state import Shared
from workers.catalogue.tables import JobRow
from workers.contract.kinds import KINDS, JobRequest
from workers.contract.phases import JobError, Phase
from workers.contract.queues import Queue
from workers.intake import estimates
from workers.intake.again import reopened, without_results
from workers.intake.requests import resolve

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=RESPONSES, route_class=KeyFirst)
JobId = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]


class Progress(BaseModel):
    """Progress of a job."""

    stage: str
    step: int
    steps: int
    time_left_s: float | None = Field(
        description="estimated time until the last of `steps`, s; null: unknown. The estimate uses the speed since the "
        "job began to count these steps"
    )


class Estimate(BaseModel):
    """The time and memory that a job was expected to need when it was accepted."""

    memory_mib: int
    seconds: float


class JobView(BaseModel):
    """A job."""

    id: str
    kind: str
    phase: Phase
    queue: Queue
    created_at: float
    started_at: float | None
    ended_at: float | None
    attempt: int
    cancel_requested: bool
    waiting_before: int | None = Field(
        description="number of waiting jobs that are expected to start before this job: the jobs of more urgent queues, and "
        "jobs of this queue, in which the owners take turns; 1000: 1000 or more; null: the job is not QUEUED. Only the "
        "answers to a submission and to `GET /v1/jobs/{id}` contain this number; in lists and events it is null"
    )
    progress: Progress
    estimate: Estimate | None = Field(
        description="expected time and memory of the job; null: a UWS job that has not been started"
    )
    parameters: dict[str, Any] = Field(
        description="the parameters, with every default and the PSF filled in; for a PENDING job as the client sent them"
    )
    result: str | None = Field(description="address of the result; null until the job is COMPLETED")
    result_deleted: bool = Field(
        False,
        description="whether the result was deleted; the same request makes the result again. Lists and the answers to a "
        "submission and to `GET /v1/jobs/{id}` contain the present value; in events it is always false",
    )
    error: JobError | None

    @classmethod
    def of(cls, row: JobRow, waiting_before: int | None = None, *, result_deleted: bool = False) -> JobView:
        """The description of a job, from its row in the catalogue.

        waiting_before: number of jobs that wait before this job; None if they were not counted.
        """
        return cls(
            id=row.id,
            kind=row.kind,
            phase=Phase(row.phase),
            queue=Queue(row.queue),
            created_at=row.created_at,
            started_at=row.started_at,
            ended_at=row.ended_at,
            attempt=row.attempt,
            cancel_requested=row.cancel_requested,
            waiting_before=waiting_before,
            progress=Progress(stage=row.stage, step=row.step, steps=row.steps, time_left_s=time_left_s(row)),
            estimate=Estimate.model_validate(row.estimate) if row.estimate else None,
            parameters=row.parameters,
            result=f"{KINDS[row.kind].result}/{row.result_id}" if row.result_id else None,
            result_deleted=result_deleted,
            error=JobError.model_validate(row.error) if row.error else None,
        )


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
    with rows_held():
        row, new = state.catalogue.jobs.submit(
            body.kind,
            parameters,
            request_key,
            caller.owner,
            queue=queue,
            estimate=estimate,
            quota_mib=state.settings.quota_mib,
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
    check_room(state, caller.owner)
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


def time_left_s(row: JobRow, now: float | None = None) -> float | None:
    """Estimated remaining time of a running job, s; None if unknown.

    The estimate uses the speed since the job began to count its present steps. Earlier work, such as reading the
    images, does not count. now: seconds since 1970; default: this machine's clock.
    """
    now = time.time() if now is None else now
    done = row.step - row.count_step
    if not KINDS[row.kind].counted_whole or row.phase != Phase.EXECUTING or done <= 0 or row.count_at is None:
        return None
    return max(0.0, (now - row.count_at) * (row.steps - row.step) / done)


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
        raise Problem(
            404, "no-such-job", f"expected the id of one of your jobs; got {job_id}: list your jobs"
        )
    return row
