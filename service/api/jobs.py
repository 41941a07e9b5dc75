"""Jobs: ``/v1/jobs``."""

from __future__ import annotations

import logging
import time
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from pydantic import BaseModel, Field

from psfcore.errors import DataError
from service.http.callers import Caller, Reading, Submitting
from service.http.paging import Cursor, Limit, Page, page, position
from service.http.problems import RESPONSES, Problem
from service.http.quotas import check_room
from service.http.state import Shared
from workers.catalogue.tables import JobRow
from workers.contract.contract import JobError, JobRequest, Phase
from workers.contract.queues import Queue
from workers.intake import estimates
from workers.intake.requests import resolve

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=RESPONSES)
JobId = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
STATUS_OF = {
    "no-such-image": 404,
    "no-such-psf": 404,
    "no-such-transit": 404,
    "no-such-context": 404,
    "no-such-product": 404,
    "not-made-here": 409,
    "parameters-unknown": 409,
    "parameters-outdated": 409,
    "too-much-memory": 413,
    "no-psf-for-instrument": 409,
    "no-psf-fits": 409,
    "several-psfs-fit": 409,
    "no-date": 409,
}
RESULTS = {
    "bulk": "/v1/bulk",
    "deconvolve": "/v1/products",
    "psf-build": "/v1/psfs",
    "psf-fit": "/v1/psfs",
    "psf-tables": "/v1/psfs",
    "cross-validate": "/v1/reports",
    "evaluate": "/v1/reports",
    "gap-diagnose": "/v1/reports",
    "rerun": "/v1/reports",
}
# Kinds whose steps count the whole job, so that what is left can be told from what was done.
COUNTED_WHOLE = {"psf-build", "psf-fit", "cross-validate", "evaluate"}


class Progress(BaseModel):
    """How far a job is."""

    stage: str
    step: int
    steps: int
    time_left_s: float | None = Field(description="estimated from what was done; null where nothing is known")


class Estimate(BaseModel):
    """What a job was expected to need when it was taken."""

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
    progress: Progress
    estimate: Estimate | None = Field(
        description="what it is expected to need; null before it is told to run"
    )
    parameters: dict[str, Any] = Field(
        description="with every default and the PSF filled in; of a PENDING job as given"
    )
    result: str | None = Field(description="address of what the job made")
    error: JobError | None

    @classmethod
    def of(cls, row: JobRow) -> JobView:
        """The view of a row."""
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
            progress=Progress(stage=row.stage, step=row.step, steps=row.steps, time_left_s=time_left_s(row)),
            estimate=Estimate.model_validate(row.estimate) if row.estimate else None,
            parameters=row.parameters,
            result=f"{RESULTS[row.kind]}/{row.result_id}" if row.result_id else None,
            error=JobError.model_validate(row.error) if row.error else None,
        )


@router.post(
    "",
    status_code=202,
    summary="Ask for a deconvolution, a PSF build, a fit of a transit, its cross-validation, a report or a diagnosis",
    responses={200: {"model": JobView, "description": "An equal request was made before; this is its job."}},
)
def submit_job(body: JobRequest, response: Response, caller: Submitting, state: Shared) -> JobView:
    """Write the job down; it is submitted from there. An equal request gets the job that it already has."""
    check_room(state, caller.owner)
    try:
        parameters, request_key = resolve(
            body, state.catalogue, caller.owner, added_effects=state.settings.added_effects
        )
        estimate = estimates.checked(body.kind, parameters, state.catalogue, caller.owner, state.settings)
    except DataError as error:
        raise Problem(STATUS_OF.get(error.code, 422), error.code, error.message) from error
    queue = None if body.queue is None else Queue(body.queue)
    row, new = state.catalogue.jobs.submit(
        body.kind, parameters, request_key, caller.owner, queue=queue, estimate=estimate
    )
    if new:
        log.info("job %s: %s, asked for", row.id, body.kind, extra={"fields": {"job": row.id}})
    if row.submitted_at is None:  # new, or moved up to a more urgent queue
        state.reconciler.wake()
    response.status_code = 202 if new else 200
    response.headers["Location"] = f"/v1/jobs/{row.id}"
    return JobView.of(row)


@router.get("", summary="List jobs")
def list_jobs(
    request: Request,
    caller: Reading,
    state: Shared,
    phase: Phase | None = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Page[JobView]:
    """Jobs, newest first."""
    rows = state.catalogue.page(
        JobRow, owner=caller.owner, limit=limit + 1, after=position(cursor), phase=phase
    )
    return page(request, rows, limit, JobView.of)


@router.get("/{job_id}", summary="One job: phase, progress, result or error")
def get_job(job_id: JobId, caller: Reading, state: Shared) -> JobView:
    """The job as it is now."""
    return JobView.of(find(state, caller, job_id))


@router.delete("/{job_id}", status_code=202, summary="Cancel a job")
def cancel_job(job_id: JobId, caller: Submitting, state: Shared) -> JobView:
    """Cancel: a queued job ends at once, an executing one within a step, an ended one stays as it is."""
    find(state, caller, job_id)
    state.catalogue.jobs.cancel(job_id)
    return JobView.of(find(state, caller, job_id))


def time_left_s(row: JobRow) -> float | None:
    """What a running job will take, if it goes on as it went."""
    if row.kind not in COUNTED_WHOLE or row.phase != Phase.EXECUTING or not row.step or not row.started_at:
        return None
    return max(0.0, (time.time() - row.started_at) * (row.steps - row.step) / row.step)


def find(state: Shared, caller: Caller, job_id: str) -> JobRow:
    """The job's row; ``Problem`` 404 where there is none of the caller's."""
    row = state.catalogue.jobs.get(job_id)
    if row is None or row.owner != caller.owner:
        raise Problem(404, "no-such-job", f"there is no job with id {job_id}")
    return row
