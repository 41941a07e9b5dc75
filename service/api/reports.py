"""Reports, for example on transits and reruns: ``/v1/reports``."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from service.http import downloads as files
from service.http.callers import Reading
from service.http.paging import Cursor, Limit, Page, page, position
from service.http.problems import RESPONSES, Problem
from service.http.state import Shared
from service.views import ReportView
from workers.catalogue.tables import ReportRow
from workers.contract.requests import Identity

PAGE_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'"
)

router = APIRouter(prefix="/v1/reports", tags=["reports"], responses=RESPONSES)


@router.get("", summary="List reports")
def list_reports(
    request: Request,
    caller: Reading,
    state: Shared,
    transit_id: Identity | None = None,
    about_id: Identity | None = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Page[ReportView]:
    """Reports, newest first. `transit_id` and `about_id` select the reports on one transit, PSF or product."""
    rows = state.catalogue.page(
        ReportRow,
        owner=caller.owner,
        limit=limit + 1,
        after=position(cursor),
        transit_id=transit_id,
        about_id=about_id,
    )
    return page(request, rows, limit, ReportView.of)


@router.get("/{report_id}", summary="One report")
def get_report(report_id: Identity, caller: Reading, state: Shared) -> ReportView:
    """A report's metadata, with links to its files."""
    return ReportView.of(state.row(ReportRow, report_id, caller.owner))


@router.get("/{report_id}/file", summary="The report as JSON", response_class=Response)
def get_report_file(report_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Download the report; its hash is the ETag."""
    row = state.row(ReportRow, report_id, caller.owner)
    return files.send(
        request,
        state.store,
        row.file_sha256,
        "application/json",
        f"report-{report_id[:12]}.json",
        size=row.bytes,
    )


@router.get("/{report_id}/preview", summary="The report's picture", response_class=Response)
def get_report_preview(report_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """The figures of the report as PNG."""
    row = state.row(ReportRow, report_id, caller.owner)
    if row.preview_sha256 is None:
        raise Problem(
            404,
            "no-preview",
            "expected a report with a picture; this report has no picture: download the report as JSON "
            f"(/v1/reports/{report_id}/file)",
        )
    return files.send(request, state.store, row.preview_sha256, "image/png", None)


@router.get("/{report_id}/page", summary="The report as an HTML page", response_class=Response)
def get_report_page(report_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """The report as HTML with its figures inside. The headers of the answer forbid scripts and content from other addresses."""
    digest = state.row(ReportRow, report_id, caller.owner).details.get("page_sha256")
    if digest is None:
        raise Problem(
            404,
            "no-page",
            "expected a report with a page; this report has no page: download the report as JSON "
            f"(/v1/reports/{report_id}/file)",
        )
    answer = files.send(request, state.store, digest, "text/html; charset=utf-8", None)
    answer.headers["Content-Security-Policy"] = PAGE_POLICY
    return answer


@router.get("/{report_id}/output", summary="The file that a rerun made, as FITS", response_class=Response)
def get_report_output(report_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """The product or PSF that the rerun made."""
    digest = state.row(ReportRow, report_id, caller.owner).details.get("output_sha256")
    if digest is None:
        raise Problem(
            404,
            "no-output",
            "expected the report of a rerun; this report is not of a rerun: download the report as JSON "
            f"(/v1/reports/{report_id}/file)",
        )
    return files.send(request, state.store, digest, files.FITS_TYPE, f"again-{report_id[:12]}.fits")
