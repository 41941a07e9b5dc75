"""The pages of transits: their list, their upload, one transit, and the jobs that use it; and the page of a report: the
sentence, the sections of the stored page or tables of its numbers, and the map of a gap."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse, RedirectResponse
from markupsafe import Markup

from psfcore.transit.manifest import MANIFEST_NAME, parse_manifest
from service.api.transits import get_transit, list_transits, upload_transit
from service.http.files import KEPT, json_of, not_modified, path_of
from service.http.gate import in_turn
from service.http.paging import Cursor, Listing
from service.http.problems import Problem, as_problems
from service.http.state import Shared, State
from service.pages import plots
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
KIND_TITLES = {
    "report": TITLES["report"],
    "cross-validation": TITLES["cross-validate"],
    "gap": TITLES["gap-diagnose"],
    "rerun": TITLES["rerun"],
}
MOST_KEPT = 4  # stored pages that stay in memory, with their figures
# The parts of a page that ``psfcore/drawing/page.html`` made. All texts in it are escaped, so no text contains a tag.
_SECTION = re.compile(r'<section id="s\d+">(.*?)</section>', re.DOTALL)
_PNG = re.compile(r'src="data:image/png;base64,([^"]*)"')
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


@dataclass(frozen=True)
class StoredPage:
    """A stored page. Its sections contain addresses of figures; figures: PNG files in reading order."""

    title: Markup
    lead: Markup
    footer: Markup
    sections: tuple[Markup, ...]
    figures: tuple[bytes, ...]


@in_turn(reports.get(""))
def report(report_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """The report. It has the same sections as the HTML page that can be downloaded."""
    row = state.row(ReportRow, report_id, caller.owner)
    stored = _stored(state, row)
    said = json_of(state.store, row.file_sha256, row.bytes)
    view = ReportView.of(row)
    return page(
        request,
        "report.html",
        report=view,
        title=stored.title if stored is not None else KIND_TITLES.get(row.kind, row.kind),
        sentence=stored.lead if stored is not None else row.details.get("sentence", ""),
        sections=[] if stored is None else stored.sections,
        footer="" if stored is None else stored.footer,
        gap=plots.gap_map(said) if row.kind == "gap" else None,
        tables=_tables(row.kind, said),
        about=_about(said, row),
    )


@in_turn(reports.get("/figures/{number}"))
def figure(
    report_id: Identity, number: int, request: Request, caller: PageReading, state: Shared
) -> Response:
    """A figure of the report as PNG; the first has the number 1."""
    stored = _stored(state, state.row(ReportRow, report_id, caller.owner))
    figures = () if stored is None else stored.figures
    if not 1 <= number <= len(figures):
        raise Problem(
            404, "no-such-figure", f"expected a figure from 1 to {len(figures)} of the report; got {number}"
        )
    png = figures[number - 1]
    headers = {"ETag": f'"{hashlib.sha256(png).hexdigest()}"', "Cache-Control": KEPT}
    if (same := not_modified(request, headers)) is not None:
        return same
    return Response(png, media_type="image/png", headers=headers)


def _stored(state: State, row: ReportRow) -> StoredPage | None:
    """The stored page; None if the report has none. Raises ``Problem`` 410 if it is lost."""
    digest = row.details.get("page_sha256")
    if digest is None:
        return None
    return read_stored(path_of(state.store, digest), f"/reports/{row.id}/figures")


@lru_cache(maxsize=MOST_KEPT)
def read_stored(path: Path, figures_at: str) -> StoredPage:
    """The parts of a stored page, which stands alone: without its style, and with its figures as files of their own.

    figures_at: the beginning of the addresses of the figures; "/" and the number of the figure follow. A file of the
    store never changes, so its content can be kept in memory. Raises OSError.
    """
    figures: list[bytes] = []

    def picture(source: re.Match[str]) -> str:
        figures.append(base64.b64decode(source[1]))
        return f'src="{figures_at}/{len(figures)}" loading="lazy"'

    html = _PNG.sub(picture, path.read_text("utf-8"))
    ends = (("<h1>", "</h1>"), ('<p class="lead">', "</p>"), ("<footer><p>", "</p>"))
    title, lead, footer = (Markup(html.partition(begin)[2].partition(end)[0]) for begin, end in ends)
    sections = tuple(Markup(one) for one in _SECTION.findall(html))
    return StoredPage(title, lead, footer, sections, tuple(figures))


def _tables(kind: str, said: Mapping[str, Any]) -> list[tuple[str, tuple[str, ...], list[plots.Row]]]:
    """Tables from the numbers of a report without a stored page: title, headings, rows."""
    if kind == "cross-validation":
        heads = ("Parameter", "Median", "One standard deviation", "Two standard deviations")
        return [("Parameters over all folds", heads, plots.band_parameters(said))]
    if kind == "rerun":
        return [
            ("Arrays", ("Array", "Values", "Largest difference"), plots.rerun_arrays(said)),
            ("What differed when they were made", ("Property", "First", "New"), plots.rerun_makers(said)),
        ]
    return []


def _about(said: Mapping[str, Any], row: ReportRow) -> list[tuple[str, str]]:
    """Links to the transit, product or PSF on which the report is, and to the PSFs of its job: (text, address)."""
    found = [("Transit", f"/transits/{row.transit_id}")] if row.transit_id else []
    if row.kind == "rerun" and row.about_id:
        of = said["of"]
        found.append((f"The {'PSF' if of == 'psf' else of} that was made again", f"/{of}s/{row.about_id}"))
    for name, title in (("psf_id", "PSF of the request"), ("corrected_psf_id", "Corrected PSF")):
        if row.details.get(name):
            found.append((title, f"/psfs/{row.details[name]}"))
    return found
