"""PSF versions: ``/v1/psfs``."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from psfcore.errors import DataError
from service.api.psfs.filters import PRINTABLE, Filters, InContext
from service.http import downloads as files
from service.http import uploads
from service.http.callers import Caller, Reading, Submitting
from service.http.paging import Cursor, Limit, Page, page, position
from service.http.problems import RESPONSES, Problem, problem
from service.http.quotas import Allowed
from service.http.state import Shared
from service.views.psfs import PsfView
from workers.catalogue.contexts import NOW
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import PsfRow
from workers.contract.requests import Identity
from workers.files.collection import remove_unnamed
from workers.intake.uploads import uploaded_psf_row
from workers.versions import WORD, PsfStatus

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/psfs", tags=["PSFs"], responses=RESPONSES)


@router.post(
    "",
    status_code=201,
    summary="Upload a PSF",
    openapi_extra=uploads.OPENAPI_BODY,
    responses={200: {"model": PsfView, "description": "The same file was already uploaded."}},
)
async def upload_psf(
    request: Request,
    response: Response,
    caller: Submitting,
    state: Shared,
    name: Annotated[
        str | None,
        Query(max_length=80, pattern=PRINTABLE, description="default: PSFNAME, or the file's name"),
    ] = None,
    version: Annotated[
        str | None, Query(max_length=40, pattern=PRINTABLE, description="default: PSFVERS, or 0.0.0+hash")
    ] = None,
    instrument: Annotated[
        str | None, Query(pattern=WORD, description="default: DETECTOR or INSTRUME")
    ] = None,
    channel: Annotated[
        str | None, Query(pattern=WORD, description="default: WAVELNTH in whole angstrom")
    ] = None,
    kind: Annotated[
        str | None,
        Query(
            pattern=WORD,
            description="`total`: the whole PSF; default: `uploaded`: the PSF is used only if a request names it",
        ),
    ] = None,
) -> PsfView:
    """Upload a PSF: one 2-D image with its centre at [n//2, n//2] and a sum of at most 1.

    Header and weights are checked at upload; compressed weights are checked by the jobs that use the PSF. A refused
    file is not stored. If a job of this service made the same file, and the request gives no name, version, instrument,
    channel or kind, the answer is the existing PSF.
    """
    take = Allowed(state, caller)
    limit = state.settings.max_upload_bytes
    async with uploads.receive_psf(request, state.store, state.limits, limit, take) as upload:
        if not any((name, version, instrument, channel, kind)):
            # Otherwise a PSF that was built here, downloaded and sent again would have a second id.
            made_here = await run_in_threadpool(_made_here, state, caller, upload.sha256)
            if made_here is not None:
                response.status_code = 200
                response.headers["Location"] = f"/v1/psfs/{made_here.id}"
                return PsfView.of(made_here)
        row = uploaded_psf_row(
            caller.owner,
            upload.sha256,
            upload.bytes,
            upload.filename,
            upload.summary,
            name=name,
            version=version,
            instrument=instrument,
            channel=channel,
            kind=kind,
        )
        row, new = await run_in_threadpool(take.keep, upload.path, upload.sha256, row)
    response.status_code = 201 if new else 200
    response.headers["Location"] = f"/v1/psfs/{row.id}"
    return PsfView.of(row)


def _made_here(state: Shared, caller: Caller, digest: str) -> PsfRow | None:
    """The caller's PSF whose file has this SHA-256, if a job made this PSF; otherwise None."""
    # At most two PSFs have the same file: the PSF that a job made, and an upload of it.
    rows = state.catalogue.page(PsfRow, owner=caller.owner, limit=2, file_sha256=digest)
    return next((row for row in rows if row.id != digest), None)


@router.get("", summary="List PSFs")
def list_psfs(
    request: Request,
    caller: Reading,
    state: Shared,
    filters: Filters,
    context: InContext = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Page[PsfView]:
    """PSFs, newest first. With `valid_at`: only PSFs that are certified for this time, or that the context pins for this time."""
    try:
        wanted = _in_context(state, caller, filters, context)
    except DataError as error:
        raise problem(error) from error
    rows = state.catalogue.psfs.page(wanted, caller.owner, limit=limit + 1, after=position(cursor))
    return page(request, rows, limit, PsfView.of)


@router.get("/{psf_id}", summary="One PSF version")
def get_psf(psf_id: Identity, caller: Reading, state: Shared) -> PsfView:
    """A PSF's metadata, with links to its files."""
    return PsfView.of(state.row(PsfRow, psf_id, caller.owner))


@router.delete("/{psf_id}", summary="Delete a draft PSF that nothing uses")
def delete_psf(psf_id: Identity, caller: Submitting, state: Shared) -> PsfView:
    """Delete a draft with its files, and return its last description.

    The answer is 409 if the PSF is certified or deprecated, or if it is used by a product, a job that has not ended,
    an open bulk run, a context or another PSF.
    """
    try:
        row = state.catalogue.delete_draft(psf_id, caller.owner)
    except DataError as error:
        raise problem(error) from error
    named = (row.file_sha256, row.preview_sha256, row.details.get("tables_sha256"))
    remove_unnamed(state.catalogue, state.store, [digest for digest in named if digest is not None])
    log.info("PSF %s: deleted by %s", psf_id, caller.name)
    return PsfView.of(row)


@router.get("/{psf_id}/file", summary="The PSF as FITS", response_class=Response)
def get_psf_file(psf_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Download the PSF; its hash is the ETag."""
    row = state.row(PsfRow, psf_id, caller.owner)
    return files.send(
        request, state.store, row.file_sha256, files.FITS_TYPE, f"psf-{psf_id[:12]}.fits", size=row.bytes
    )


@router.get("/{psf_id}/preview", summary="The PSF's picture", response_class=Response)
def get_psf_preview(psf_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """A PNG that shows the PSF, its radial profile and its cumulative curve."""
    row = state.row(PsfRow, psf_id, caller.owner)
    if row.preview_sha256 is None:
        raise Problem(
            404,
            "no-preview",
            "expected a PSF with a picture; an uploaded PSF has no picture until a job psf-tables draws it: submit that job",
        )
    return files.send(request, state.store, row.preview_sha256, "image/png", None)


@router.get("/{psf_id}/report", summary="The report of a fit, as JSON", response_class=Response)
def get_psf_report(psf_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Parameters with errors, curves with bands, the residual of every image, and the limits of the data."""
    digest = state.row(PsfRow, psf_id, caller.owner).details.get("report_sha256")
    if digest is None:
        raise Problem(
            404,
            "no-report",
            "expected a fitted PSF; this PSF was not fitted to a transit: the lineage of the PSF says how it was made",
        )
    return files.send(request, state.store, digest, "application/json", f"psf-{psf_id[:12]}.json")


def _in_context(state: Shared, caller: Caller, filters: PsfFilter, context: str | None) -> PsfFilter:
    """The filters with the context of the request. Raises ``DataError`` "no-such-context"."""
    if context is None:
        return filters
    if context == NOW:
        return replace(filters, status=PsfStatus.CERTIFIED)
    return replace(filters, context_id=state.catalogue.contexts.named(context, caller.owner).id)
