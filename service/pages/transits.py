"""The pages of transits: their list, their upload, one transit, and the jobs that use it."""

from __future__ import annotations

from typing import Any, get_args

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse, RedirectResponse

from psfcore.transit.manifest import MANIFEST_NAME, TransitManifest
from service.api.transits import get_transit, list_transits, upload_transit
from service.http.paging import Cursor
from service.http.problems import Problem
from service.http.state import Shared
from service.pages.jobs import TITLES
from service.pages.parts.forms import Sent, filled, noise, start_job, ticked
from service.pages.rendering import page
from service.pages.visitors import PageReading, PageSubmitting
from workers.catalogue.access import Scope
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import ReportRow
from workers.contract.requests import CrossValidate, Identity, ShapeName

PER_PAGE = 50
MOST_PSFS = 200
MOST_REPORTS = 50
# The options of each job in its form: fields with a text, and boxes.
TEXTS = {
    "psf-fit": ("shape", "seed", "saturation_dn"),
    "cross-validate": ("shape", "scheme", "runs", "seed", "saturation_dn"),
    "report": ("psf_id", "seed", "saturation_dn"),
    "gap-diagnose": ("psf_id", "seed", "saturation_dn"),
}
BOXES: dict[str, tuple[str, ...]] = {
    "psf-fit": ("as_published",),
    "cross-validate": (),
    "report": ("dark_offsets", "shapes"),
    "gap-diagnose": ("correct",),
}
router = APIRouter(prefix="/transits", include_in_schema=False)


@router.get("")
def transit_list(request: Request, caller: PageReading, state: Shared, cursor: Cursor = None) -> Response:
    """The uploaded transits, newest first, and the form that uploads one."""
    found = list_transits(request, caller, state, PER_PAGE, cursor)
    settings = state.settings
    return page(
        request,
        "transits.html",
        transits=found.items,
        next=found.next,
        manifest=MANIFEST_NAME,
        most_bytes=settings.max_transit_bytes,
        most_unpacked=settings.archive_limits.max_bytes,
        may_submit=Scope.SUBMIT in caller.scopes,
    )


@router.post("")
async def upload(request: Request, response: Response, caller: PageSubmitting, state: Shared) -> Response:
    """Take an archive from the form, and go to the page of the transit."""
    view = await upload_transit(request, response, caller, state)
    return RedirectResponse(f"/transits/{view.id}", 303)


@router.get("/manifest.schema.json")
def manifest_schema(caller: PageReading) -> Response:
    """The JSON schema of transit.json, made from the model with which the service checks an upload."""
    return JSONResponse(TransitManifest.model_json_schema(by_alias=True))


@router.get("/{transit_id}")
def transit(transit_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """The transit, the forms of its jobs, and what was made from it."""
    view = get_transit(transit_id, caller, state)
    psfs = state.catalogue.psfs.page(PsfFilter(), caller.owner, limit=MOST_PSFS)
    reports = state.catalogue.page(ReportRow, owner=caller.owner, limit=MOST_REPORTS, transit_id=transit_id)
    return page(
        request,
        "transit.html",
        transit=view,
        title=view.filename or view.instrument or "Transit",
        psfs=psfs,
        fitted=[psf for psf in psfs if psf.origin == "fitted"],
        made=[psf for psf in psfs if psf.details.get("transit_id") == transit_id],
        reports=reports,
        titles=TITLES,
        shapes=get_args(ShapeName),
        usual_runs=CrossValidate.model_fields["runs"].default,
        may_submit=Scope.SUBMIT in caller.scopes,
    )


@router.post("/{transit_id}/jobs/{kind}")
async def start(
    transit_id: Identity, kind: str, request: Request, caller: PageSubmitting, state: Shared
) -> Response:
    """Start a job on the transit with the options of its form, and go to the job."""
    return await start_job(kind, _parameters(kind, transit_id, await request.form()), caller, state)


def _parameters(kind: str, transit_id: str, form: Sent) -> dict[str, Any]:
    """The parameters of a job. Raises ``Problem`` 404 for a kind that does not use a transit."""
    if kind not in TEXTS:
        raise Problem(404, "no-such-kind", f"expected one of {', '.join(TEXTS)}; got {kind[:40]!r}")
    return {
        "transit_id": transit_id,
        **filled(form, *TEXTS[kind]),
        **ticked(form, *BOXES[kind]),
        **noise(form),
    }
