"""The expected time and memory of a job, and its PSF, before it is submitted: ``/v1/estimates``."""

from __future__ import annotations

from typing import Any, cast

from fastapi import APIRouter
from pydantic import BaseModel, Field

from service.api.jobs import prepared
from service.http.callers import Caller, KeyFirst, Submitting
from service.http.problems import RESPONSES
from service.http.state import Shared
from service.views import Estimate
from workers.contract.kinds import KINDS, JobRequest, queue_of
from workers.contract.queues import Queue
from workers.contract.requests import Deconvolve
from workers.contract.resolved import ResolvedDeconvolve
from workers.intake.again import there
from workers.intake.psf_reason import reasoned_psf

router = APIRouter(prefix="/v1/estimates", tags=["jobs"], responses=RESPONSES, route_class=KeyFirst)


class ChosenPsf(BaseModel):
    """The PSF that a deconvolution would use."""

    id: str
    name: str
    version: str = Field(
        description="version of the PSF; if the PSF is not built yet: version of its instrument file"
    )
    status: str | None = Field(description="draft, certified or deprecated; null: the PSF is not built yet")
    why: str = Field(description="a sentence that says why this PSF was chosen")


class EstimateView(BaseModel):
    """The estimate for a request. The request is not submitted."""

    parameters: dict[str, Any] = Field(description="the parameters, with every default and the PSF filled in")
    result_id: str = Field(
        description="id that the result has, or would have; for a kind whose jobs always make a new result (`rerun`), this id is "
        "different each time"
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


@router.post("", summary="Estimate a job without submitting it")
def estimate_job(body: JobRequest, caller: Submitting, state: Shared) -> EstimateView:
    """Estimate a job without starting it. The request and its errors are the same as for `POST /v1/jobs`. The answer
    contains the expected time and memory, the place in the queue and, for a deconvolution, the PSF and the reason for
    its choice."""
    parameters, result_id, estimate = prepared(body, caller, state)
    queue = queue_of(body.kind) if body.queue is None else Queue(body.queue)
    result = KINDS[body.kind].result
    known = there(result, result_id, caller.owner, state.catalogue, state.store)
    return EstimateView(
        parameters=parameters,
        result_id=result_id,
        existing=f"{result}/{result_id}" if known else None,
        estimate=Estimate.model_validate(estimate),
        queue=queue,
        waiting_before=state.catalogue.places.before_new(caller.owner, queue),
        psf=_psf(body, parameters, caller, state),
    )


def _psf(body: JobRequest, parameters: dict[str, Any], caller: Caller, state: Shared) -> ChosenPsf | None:
    if body.kind != "deconvolve":
        return None
    wanted = cast(Deconvolve, body.parameters)
    resolved = ResolvedDeconvolve.model_validate(parameters)
    found = reasoned_psf(wanted, resolved, state.catalogue, caller.owner)
    return ChosenPsf(id=found.id, name=found.name, version=found.version, status=found.status, why=found.why)
