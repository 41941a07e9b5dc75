"""Uploaded transits, ``/v1/transits``, and reports, for example on transits and reruns, ``/v1/reports``."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from service.http import files
from service.http.callers import Reading, Submitting
from service.http.paging import Page, Paging
from service.http.problems import RESPONSES
from service.http.state import Shared
from service.views import ReportView, TransitDetails, TransitView
from workers.catalogue.tables import ReportRow, TransitRow
from workers.contract.requests import Identity

PAGE_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'"
)

router = APIRouter(prefix="/v1/transits", tags=["transits"], responses=RESPONSES)
reports = APIRouter(prefix="/v1/reports", tags=["reports"], responses=RESPONSES)


@router.post(
    "",
    status_code=201,
    summary="Upload a transit",
    openapi_extra=files.OPENAPI_TRANSIT_BODY,
    responses={200: {"model": TransitDetails, "description": "The same file was already uploaded."}},
)
async def upload_transit(
    request: Request, response: Response, caller: Submitting, state: Shared
) -> TransitDetails:
    """Upload one archive: the images of a transit, their transit.json and, optionally, the known part of the PSF.

    The table of contents and transit.json are checked at upload. The pixels are read by the jobs that use the transit.
    """
    return TransitDetails.of(await files.add_upload(request, response, caller, state, files.TRANSIT))


@router.get("", summary="List uploaded transits")
def list_transits(paging: Paging, caller: Reading, state: Shared) -> Page[TransitView]:
    """Uploaded transits, newest first, without the names of their files."""
    return paging.page(state.catalogue.page(TransitRow, owner=caller.owner, **paging.query), TransitView.of)


@router.get("/{transit_id}", summary="One uploaded transit")
def get_transit(transit_id: Identity, caller: Reading, state: Shared) -> TransitDetails:
    """An uploaded transit, with its files."""
    return TransitDetails.of(state.row(TransitRow, transit_id, caller.owner))


@reports.get("", summary="List reports")
def list_reports(
    paging: Paging,
    caller: Reading,
    state: Shared,
    transit_id: Identity | None = None,
    about_id: Identity | None = None,
) -> Page[ReportView]:
    """Reports, newest first. `transit_id` and `about_id` select the reports on one transit, PSF or product."""
    rows = state.catalogue.page(
        ReportRow, owner=caller.owner, transit_id=transit_id, about_id=about_id, **paging.query
    )
    return paging.page(rows, ReportView.of)


@reports.get("/{report_id}", summary="One report")
def get_report(report_id: Identity, caller: Reading, state: Shared) -> ReportView:
    """A report's metadata, with links to its files."""
    return ReportView.of(state.row(ReportRow, report_id, caller.owner))


@reports.get("/{report_id}/file", summary="The report as JSON", response_class=Response)
def get_report_file(report_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Download the report; its hash is the ETag."""
    row = state.row(ReportRow, report_id, caller.owner)
    name = f"report-{report_id[:12]}.json"
    return files.send(request, state.store, row.file_sha256, files.JSON_TYPE, name, size=row.bytes)


@reports.get("/{report_id}/preview", summary="The report's picture", response_class=Response)
def get_report_preview(report_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """The figures of the report as PNG."""
    digest = state.row(ReportRow, report_id, caller.owner).preview_sha256
    missing = _without("no-preview", "with a picture; this report has no picture", report_id)
    return files.send(request, state.store, digest, "image/png", None, missing=missing)


@reports.get("/{report_id}/page", summary="The report as an HTML page", response_class=Response)
def get_report_page(report_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """The report as HTML with its figures inside. The headers of the answer forbid scripts and content from other
    addresses.
    """
    digest = state.row(ReportRow, report_id, caller.owner).details.get("page_sha256")
    missing = _without("no-page", "with a page; this report has no page", report_id)
    answer = files.send(request, state.store, digest, "text/html; charset=utf-8", None, missing=missing)
    answer.headers["Content-Security-Policy"] = PAGE_POLICY
    return answer


@reports.get("/{report_id}/output", summary="The file that a rerun made, as FITS", response_class=Response)
def get_report_output(report_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """The product or PSF that the rerun made."""
    digest = state.row(ReportRow, report_id, caller.owner).details.get("output_sha256")
    missing = _without("no-output", "of a rerun; this report is not of a rerun", report_id)
    name = f"again-{report_id[:12]}.fits"
    return files.send(request, state.store, digest, files.FITS_TYPE, name, missing=missing)


def _without(code: str, what: str, report_id: str) -> tuple[str, str]:
    """The code and the message of the error for a report without a file."""
    return code, f"expected a report {what}: download the report as JSON (/v1/reports/{report_id}/file)"
