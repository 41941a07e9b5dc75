"""The pages of transits: their list, their upload, one transit, and the jobs that use it; and the page of a report: the
sentence, the sections and figures that the job has written, and tables and curves of its numbers.
"""

from __future__ import annotations

from typing import get_args

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse, RedirectResponse
from markupsafe import Markup

from psfcore.transit.manifest import MANIFEST_NAME, parse_manifest
from service.api.transits import get_transit, list_transits, upload_transit
from service.http.files import json_of, send
from service.http.gate import in_turn
from service.http.paging import Cursor, Listing
from service.http.problems import Problem, as_problems
from service.http.state import Shared
from service.pages.forms import SentForm, parameters, start_job
from service.pages.jobs import TITLES
from service.pages.login import PageReading, PageSubmitting
from service.pages.rendering import page
from service.views import ReportView
from workers.catalogue.access import Scope
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import ReportRow
from workers.contract.kinds import KINDS
from workers.contract.requests import CrossValidate, Identity, ShapeName

PER_PAGE = 50
MOST_PSFS = 200
MOST_REPORTS = 50
# The jobs that use a transit, with the models of their parameters.
JOBS = {
    name: kind.parameters
    for name, kind in KINDS.items()
    if kind.parameters is not None and "transit_id" in kind.parameters.model_fields
}
router = APIRouter(prefix="/transits", include_in_schema=False)
reports = APIRouter(prefix="/reports/{report_id}", include_in_schema=False)


@router.get("")
def transit_list(request: Request, caller: PageReading, state: Shared, cursor: Cursor = None) -> Response:
    """The uploaded transits, newest first, and the form that uploads one."""
    found = list_transits(Listing(request, PER_PAGE, cursor), caller, state)
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


@router.post("/check")
async def check(request: Request, caller: PageReading) -> Response:
    """The names of the files in a transit.json, for the script of the page. Raises ``Problem`` 422 for its faults."""
    with as_problems():
        return JSONResponse(parse_manifest(await request.body()).files)


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


@in_turn(router.post("/{transit_id}/jobs/{kind}"))
def start(transit_id: Identity, kind: str, caller: PageSubmitting, state: Shared, form: SentForm) -> Response:
    """Start a job on the transit with the options of its form, and go to the job."""
    if kind not in JOBS:
        raise Problem(404, "no-such-kind", f"expected one of {', '.join(JOBS)}; got {kind[:40]!r}")
    values = parameters(JOBS[kind], form) | {"transit_id": transit_id}
    return start_job(kind, values, caller, state)


# --- a report -------------------------------------------------------------------------------------------


@in_turn(reports.get(""))
def report(report_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """The report. It has the same sections as the HTML page that can be downloaded, if this version or a later one made
    it.
    """
    row = state.row(ReportRow, report_id, caller.owner)
    digest = row.details.get("page_texts_sha256")
    texts = {} if digest is None else json_of(state.store, digest)
    figures_at = f'loading="lazy" src="/reports/{row.id}/figures/'
    return page(
        request,
        "report.html",
        report=ReportView.of(row),
        said=json_of(state.store, row.file_sha256, row.bytes),
        title=texts.get("title") or TITLES.get(row.kind, row.kind),
        sentence=texts.get("lead") or row.details.get("sentence", ""),
        # The job has escaped all other texts of the sections.
        sections=[Markup(one.replace('src="figure:', figures_at)) for one in texts.get("sections", [])],  # noqa: S704
        footer=texts.get("footer", ""),
    )


@reports.get("/figures/{number}")
def figure(
    report_id: Identity, number: int, request: Request, caller: PageReading, state: Shared
) -> Response:
    """A figure of the report as PNG; the first has the number 1."""
    figures = state.row(ReportRow, report_id, caller.owner).details.get("figures_sha256", [])
    if not 1 <= number <= len(figures):
        raise Problem(
            404, "no-such-figure", f"expected a figure from 1 to {len(figures)} of the report; got {number}"
        )
    return send(request, state.store, figures[number - 1], "image/png", None)
