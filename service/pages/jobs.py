"""The list of jobs, and the page of a job."""

from __future__ import annotations

import json
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse
from pydantic import BaseModel

from service.api.jobs import JobId, JobView, cancel_job, get_job, list_jobs
from service.http.paging import Cursor
from service.http.state import Shared
from service.pages.rendering import page
from service.pages.visitors import PageReading, PageSubmitting
from workers.contract.phases import Phase

PER_PAGE = 50
TITLES = {
    "deconvolve": "Deconvolution",
    "psf-build": "PSF build",
    "psf-fit": "Fit of the scatter",
    "cross-validate": "Cross-validation",
    "report": "Report on a transit",
    "gap-diagnose": "Gap diagnosis",
    "psf-tables": "Tables of a PSF",
    "rerun": "Rerun",
}
router = APIRouter(prefix="/jobs", include_in_schema=False)


@router.get("")
def job_list(
    request: Request, caller: PageReading, state: Shared, phase: str = "", cursor: Cursor = None
) -> Response:
    """The jobs, newest first."""
    wanted = Phase(phase) if phase in set(Phase) else None
    found = list_jobs(request, caller, state, wanted, PER_PAGE, cursor)
    return page(request, "jobs.html", jobs=found.items, next=found.next, phases=list(Phase), phase=phase)


@router.get("/{job_id}")
def job(job_id: JobId, request: Request, caller: PageReading, state: Shared) -> Response:
    """The state of a job; a script keeps it up to date, and opens the result at its end."""
    view = get_job(job_id, caller, state)
    return page(
        request,
        "job.html",
        job=view,
        title=TITLES.get(view.kind, view.kind),
        ended=view.phase.ended,
        waiting_before=view.waiting_before,
        again=_again(view),
        parameters=_pretty(view),
    )


@router.post("/{job_id}/cancel")
def cancel(job_id: JobId, caller: PageSubmitting, state: Shared) -> Response:
    """Cancel the job, and show it."""
    cancel_job(job_id, caller, state)
    return RedirectResponse(f"/jobs/{job_id}", 303)


def _again(view: JobView) -> str | None:
    """The address where the request can be changed and started again."""
    image_id = view.parameters.get("image_id")
    return f"/images/{image_id}" if view.kind == "deconvolve" and image_id else None


def _pretty(view: BaseModel) -> str:
    shown: dict[str, Any] = view.model_dump(mode="json")["parameters"]
    return json.dumps(shown, indent=2)
