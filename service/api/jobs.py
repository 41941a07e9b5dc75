"""Submit, list, show and cancel jobs, ``/v1/jobs``, and estimate them before they are submitted, ``/v1/estimates``."""

from __future__ import annotations

import logging
from typing import Annotated, cast

from fastapi import APIRouter, Path, Response
from pydantic import BaseModel, Field

from service.http.callers import Caller, KeyFirst, Reading, Submitting
from service.http.gate import in_turn
from service.http.paging import Page, Paging
from service.http.problems import RESPONSES, Problem, as_problems, problem
from service.http.quotas import check_room
from service.http.state import Shared
from service.views import Estimate, JobView
from workers.catalogue.tables import JobRow
from workers.contract.jobs import Phase, Queue
from workers.contract.kinds import KINDS, JobRequest, queue_of
from workers.contract.requests import Deconvolve, ResolvedDeconvolve
from workers.files.garbage import intact_row
from workers.intake import estimates
from workers.intake.psf_choice import ChosenPsf, reasoned_psf
from workers.intake.repair import TABLES, reopened, without_results
from workers.intake.requests import resolve
from workers.lookup import no_such

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=RESPONSES, route_class=KeyFirst)
estimating = APIRouter(prefix="/v1/estimates", tags=["jobs"], responses=RESPONSES, route_class=KeyFirst)
JobId = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]


class Identified(BaseModel):
    """The identity of the result of a request."""

    result_id: str = Field(description="id that the result has, or would have")
    parameters: dict[str, object] = Field(
        description="the parameters, with every default and the PSF filled in"
    )


class EstimateView(BaseModel):
    """The estimate for a request. The request is not submitted."""

    parameters: dict[str, object] = Field(
        description="the parameters, with every default and the PSF filled in"
    )
    result_id: str = Field(
        description="id that the result has, or would have; for a kind whose jobs always make a new result (`rerun`), "
        "this id is different each time"
    )
    existing: str | None = Field(
        description="address of the result, if it is in the catalogue already; otherwise null"
    )
    estimate: Estimate
    queue: Queue = Field(description="the queue in which the job would wait")
    waiting_before: int = Field(
        description="number of waiting jobs that are expected to start before the job; 1000: 1000 or more"
    )
    psf: ChosenPsf | None = Field(description="the PSF of a `deconvolve` job; null for other kinds")


@in_turn(
    router.post(
        "",
        status_code=202,
        summary="Submit a job: a deconvolution, a PSF build, a fit, a cross-validation, a report, a diagnosis or a "
        "rerun",
        responses={
            200: {
                "model": JobView,
                "description": "An identical request was made before; the answer is the job of that request.",
            }
        },
    )
)
def submit_job(body: JobRequest, response: Response, caller: Submitting, state: Shared) -> JobView:
    """Put a job into its queue. If an identical request was made before, the answer is the existing job. If the result
    of that job was deleted or lost, the job is queued again.
    """
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


def prepared(
    body: JobRequest, caller: Caller, state: Shared
) -> tuple[dict[str, object], str, dict[str, float]]:
    """The resolved parameters of a request, the identity of its result, and its estimate as JSON.

    Raises ``Problem`` if the request cannot be accepted.
    """
    check_room(state, caller.owner)
    parameters, identity = _resolved(body, caller, state)
    with as_problems():
        estimate = estimates.checked(body.kind, parameters, state.catalogue, caller.owner, state.settings)
    return parameters, identity, estimate


def _resolved(body: JobRequest, caller: Caller, state: Shared) -> tuple[dict[str, object], str]:
    with as_problems():
        return resolve(body, state.catalogue, caller.owner, added_effects=state.settings.added_effects)


@router.post("/identity", summary="The id that the result of a job has or would have")
def get_identity(body: JobRequest, caller: Submitting, state: Shared) -> Identified:
    """Resolve a request without starting a job. Equal requests have equal ids, so a client can skip results that it
    holds.

    For a kind whose jobs always make a new result (`rerun`), the id is different each time.
    """
    parameters, identity = _resolved(body, caller, state)
    return Identified(result_id=identity, parameters=parameters)


@in_turn(estimating.post("", summary="Estimate a job without submitting it"))
def estimate_job(body: JobRequest, caller: Submitting, state: Shared) -> EstimateView:
    """Estimate a job without starting it. The request and its errors are the same as for `POST /v1/jobs`. The answer
    contains the expected time and memory, the place in the queue and, for a deconvolution, the PSF and the reason for
    its choice.
    """
    parameters, result_id, estimate = prepared(body, caller, state)
    queue = queue_of(body.kind) if body.queue is None else Queue(body.queue)
    result = KINDS[body.kind].result
    psf = None
    if body.kind == "deconvolve":
        wanted, resolved = cast(Deconvolve, body.parameters), ResolvedDeconvolve.model_validate(parameters)
        psf = reasoned_psf(wanted, resolved, state.catalogue, caller.owner)
    existing = intact_row(state.catalogue, state.store, TABLES[result], result_id, caller.owner)
    return EstimateView(
        parameters=parameters,
        result_id=result_id,
        existing=f"{result}/{result_id}" if existing else None,
        estimate=Estimate.model_validate(estimate),
        queue=queue,
        waiting_before=state.catalogue.places.before_new(caller.owner, queue),
        psf=psf,
    )


@router.get("", summary="List jobs")
def list_jobs(paging: Paging, caller: Reading, state: Shared, phase: Phase | None = None) -> Page[JobView]:
    """Your jobs, newest first. `waiting_before` is not counted here: it is null."""
    rows = state.catalogue.page(JobRow, owner=caller.owner, phase=phase, **paging.query)
    gone = without_results(rows, state.catalogue)
    return paging.page(rows, lambda row: JobView.of(row, result_deleted=row.id in gone))


@router.get("/{job_id}", summary="Show a job: phase, progress, result or error")
def get_job(job_id: JobId, caller: Reading, state: Shared) -> JobView:
    """The present state of the job."""
    return _view(find(state, caller, job_id), state)


@router.delete("/{job_id}", status_code=202, summary="Cancel a job")
def cancel_job(job_id: JobId, caller: Submitting, state: Shared) -> JobView:
    """Cancel a job. A queued job ends at once. An executing job ends at its next step. A job that has ended does not
    change.
    """
    check_own(find(state, caller, job_id))
    state.catalogue.jobs.cancel(job_id)
    return JobView.of(find(state, caller, job_id))


def _view(row: JobRow, state: Shared) -> JobView:
    """The description of a job, with ``waiting_before`` and ``result_deleted``."""
    gone = bool(without_results([row], state.catalogue))
    return JobView.of(row, state.catalogue.places.before(row), result_deleted=gone)


def check_own(row: JobRow) -> JobRow:
    """The job itself. Raises ``Problem`` 409 if the job is a part of a bulk run: only requests to the bulk run can
    change it.
    """
    if KINDS[row.kind].parameters is None:
        bulk_id = row.parameters["bulk_id"]
        raise Problem(
            409,
            "job-of-bulk",
            f"expected a job that was submitted; job {row.id} is a part of bulk run {bulk_id}: pause or cancel the "
            f"bulk run (POST /v1/bulk/{bulk_id}/pause or /cancel)",
        )
    return row


def find(state: Shared, caller: Caller, job_id: str) -> JobRow:
    """The row of a job. Raises ``Problem`` 404 if the caller has no such job."""
    row = state.catalogue.jobs.get(job_id)
    if row is None or row.owner != caller.owner:
        raise problem(no_such("job", job_id))
    return row
