"""The list of jobs, and the page of a job."""

from __future__ import annotations

import json
from collections.abc import Sequence

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse

from service.api.jobs import JobId, cancel_job, get_job, list_jobs
from service.http.callers import Caller
from service.http.paging import Cursor, Listing
from service.http.state import Shared, State
from service.pages.forms import address_of
from service.pages.login import PageReading, PageSubmitting
from service.pages.rendering import page
from service.pages.sentences import of_error
from service.views import JobView
from workers.catalogue.tables import ImageRow
from workers.contract.jobs import Phase

PER_PAGE = 50
TITLES = {
    "deconvolve": "Deconvolution",
    "psf-build": "PSF build",
    "psf-fit": "Fit of the scatter",
    "cross-validate": "Cross-validation",
    "report": "Report on a transit",
    "gap-diagnose": "Gap diagnosis",
    "psf-interpolate": "Interpolation in time",
    "psf-tables": "Tables of a PSF",
    "rerun": "Rerun",
    # Kinds of reports whose jobs have other names.
    "cross-validation": "Cross-validation",
    "gap": "Gap diagnosis",
}
router = APIRouter(prefix="/jobs", include_in_schema=False)


@router.get("")
def job_list(
    request: Request, caller: PageReading, state: Shared, phase: str = "", cursor: Cursor = None
) -> Response:
    """The jobs, newest first."""
    wanted = Phase(phase) if phase in set(Phase) else None
    found = list_jobs(Listing(request, PER_PAGE, cursor), caller, state, wanted)
    return page(
        request,
        "jobs.html",
        jobs=job_lines(found.items, caller, state),
        next=found.next,
        phases=list(Phase),
        phase=phase,
    )


@router.get("/{job_id}")
def job(job_id: JobId, request: Request, caller: PageReading, state: Shared) -> Response:
    """The state of a job; a script keeps it up to date, and opens the result at its end."""
    view = get_job(job_id, caller, state)
    image = state.catalogue.get(ImageRow, view.parameters.get("image_id") or "", caller.owner)
    return page(
        request,
        "job.html",
        job=view,
        title=TITLES.get(view.kind, view.kind),
        ended=view.phase.ended,
        waiting_before=view.waiting_before,
        again=_again(view),
        error=None if view.error is None else of_error(view.error.code, view.error.message),
        image=None if image is None else image.id,
        parameters=json.dumps(view.model_dump(mode="json")["parameters"], indent=2),
    )


@router.post("/{job_id}/cancel")
def cancel(job_id: JobId, caller: PageSubmitting, state: Shared) -> Response:
    """Cancel the job, and show it."""
    cancel_job(job_id, caller, state)
    return RedirectResponse(f"/jobs/{job_id}", 303)


def _again(view: JobView) -> str | None:
    """The address where the request can be changed and started again."""
    # A job that was not started yet has the parameters that the client sent, and some may be missing.
    whole = {"image_id", "psf_id", "method"} <= view.parameters.keys()
    return address_of(view.parameters) if view.kind == "deconvolve" and whole else None


def job_lines(jobs: Sequence[JobView], caller: Caller, state: State) -> list[dict[str, object]]:
    """The entries of jobs in a list, with the file name of the image and the error."""
    images = [str(job.parameters.get("image_id")) for job in jobs if job.parameters.get("image_id")]
    names = state.catalogue.bulks.progress.names_of_uploads(images, caller.owner)
    return [
        {
            "view": job,
            "title": TITLES.get(job.kind, job.kind),
            "name": names.get(str(job.parameters.get("image_id")), ""),
            "error": None if job.error is None else of_error(job.error.code, job.error.message),
        }
        for job in jobs
    ]
