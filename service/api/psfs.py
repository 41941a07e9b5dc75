"""PSF versions, ``/v1/psfs``: list, upload, show and delete them, and find the one PSF that meets filters or fits an
image.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel, Field

from psfcore.errors import DataError
from service.http import files
from service.http.callers import Caller, Reading, Submitting
from service.http.gate import in_turn
from service.http.paging import Page, Paging
from service.http.problems import RESPONSES, Problem, as_problems, problem
from service.http.state import Shared
from service.views import PsfView
from workers.catalogue.contexts import NOW
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import ImageRow, PsfRow
from workers.contract.requests import Identity
from workers.files.garbage import files_of, remove_unnamed
from workers.intake.psf_choice import MOST_NAMED, SearchResult, look, look_for_image
from workers.texts import Name
from workers.versions import TIME, TOTAL, WORD, PsfStatus, iso, seconds

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/psfs", tags=["PSFs"], responses=RESPONSES)
choosing = APIRouter(tags=["PSFs"], responses=RESPONSES)

Text = Annotated[Name | None, Query(max_length=80)]
Time = Annotated[
    str | None,
    Query(
        pattern=TIME,
        description="time of observation, such as 2024-03-01T12:00:00Z; a time without a zone is UTC",
    ),
]
InContext = Annotated[
    Name | None,
    Query(
        max_length=64,
        description=f"id or name of a context; `{NOW}`: the PSFs that are certified now",
    ),
]
KindOfUpload = Annotated[
    str | None,
    Query(
        pattern=WORD,
        description="`total`: the whole PSF; default: `uploaded`: the PSF is used only if a request names it",
    ),
]


def psf_filter(
    instrument: Text = None,
    channel: Annotated[
        Name | None,
        Query(max_length=40, description="wavelength in whole angstrom, such as 174"),
    ] = None,
    kind: Annotated[
        Name | None,
        Query(
            max_length=40,
            description="`total`, `uploaded`, or a component's name such as `diffraction`",
        ),
    ] = None,
    name: Text = None,
    version: Text = None,
    status: PsfStatus | None = None,
    valid_at: Time = None,
) -> PsfFilter:
    """The filter with these values. Raises ``Problem`` 422 if they exclude each other or if the time is wrong."""
    if valid_at is not None and status not in (None, PsfStatus.CERTIFIED):
        raise Problem(
            422,
            "not-valid-at-any-time",
            f"valid_at: expected it only with certified PSFs; got valid_at with status {status}: remove valid_at or "
            "status",
        )
    with as_problems():
        at = None if valid_at is None else seconds(valid_at, "valid_at")
    return PsfFilter(instrument, channel, kind, name, version, None, status, at)


Filters = Annotated[PsfFilter, Depends(psf_filter)]


class Choice(BaseModel):
    """The one PSF that fits, and the filters of the search."""

    psf: PsfView
    context: str | None = Field(
        description="id of the context that was searched; null: all PSFs were searched"
    )
    instrument: str | None
    channel: str | None
    kind: str | None
    valid_at: str | None = Field(
        description="time of observation for which the PSF must be valid; null: not given"
    )


@choosing.get("/v1/psfs/best", summary="The one PSF that meets filters")
def get_best_psf(caller: Reading, state: Shared, filters: Filters, context: InContext = None) -> Choice:
    """The PSF with these properties. Without a status and a context, only certified PSFs are searched.

    404: no PSF meets all filters; the message names the filter that excluded the last PSFs. 409: several PSFs meet the
    filters; the message lists them.
    """
    return _choice(lambda: look(state.catalogue, filters, caller.owner, context))


@choosing.get("/v1/images/{image_id}/psf", summary="The PSF for an image")
def get_psf_for_image(
    image_id: Identity,
    caller: Reading,
    state: Shared,
    context: InContext = None,
    kind: Annotated[str, Query(pattern=WORD)] = TOTAL,
) -> Choice:
    """The certified PSF for the instrument, channel and time of observation in the image's header, or the PSF that a
    context pins.

    `POST /v1/estimates` says which PSF a deconvolution would use, even if none is certified.
    """
    row = state.row(ImageRow, image_id, caller.owner)
    return _choice(lambda: look_for_image(state.catalogue, row.summary, caller.owner, context, kind))


def _choice(search: Callable[[], SearchResult]) -> Choice:
    candidates: list[dict[str, str | None]] = []
    try:
        found = search()
        candidates = [
            {
                "id": psf.id,
                "name": psf.name,
                "version": psf.version,
                "status": psf.status,
                "series": psf.series,
                "valid_from": None if psf.valid_from is None else iso(psf.valid_from),
                "valid_to": None if psf.valid_to is None else iso(psf.valid_to),
            }
            for psf in found.psfs[:MOST_NAMED]
        ]
        psf = found.one()
    except DataError as error:
        more = {"candidates": candidates} if error.code == "several-psfs-fit" else {}
        raise problem(error, **more) from error
    wanted = found.wanted
    return Choice(
        psf=PsfView.of(psf),
        context=None if found.context is None else found.context.id,
        instrument=wanted.instrument,
        channel=wanted.channel,
        kind=wanted.kind,
        valid_at=None if wanted.valid_at is None else iso(wanted.valid_at),
    )


@router.post(
    "",
    status_code=201,
    summary="Upload a PSF",
    openapi_extra=files.OPENAPI_BODY,
    responses={200: {"model": PsfView, "description": "The same file was already uploaded."}},
)
async def upload_psf(
    request: Request,
    response: Response,
    caller: Submitting,
    state: Shared,
    name: Annotated[
        Name | None,
        Query(max_length=80, description="default: PSFNAME, or the file's name"),
    ] = None,
    version: Annotated[
        Name | None, Query(max_length=40, description="default: PSFVERS, or 0.0.0+hash")
    ] = None,
    instrument: Annotated[
        str | None, Query(pattern=WORD, description="default: DETECTOR or INSTRUME")
    ] = None,
    channel: Annotated[
        str | None, Query(pattern=WORD, description="default: WAVELNTH in whole angstrom")
    ] = None,
    kind: KindOfUpload = None,
) -> PsfView:
    """Upload a PSF: one 2-D image with its centre at [n//2, n//2] and a sum of at most 1.

    Header and weights are checked at upload; compressed weights are checked by the jobs that use the PSF. A refused
    file is not stored. If a job of this service made the same file, and the request gives no name, version, instrument,
    channel or kind, the answer is the existing PSF.
    """
    columns = {"name": name, "version": version, "instrument": instrument, "channel": channel, "kind": kind}
    # Otherwise a PSF that was built here, downloaded and sent again would have a second id.
    equal = None if any(columns.values()) else partial(_made_here, state, caller)
    return PsfView.of(
        await files.add_upload(request, response, caller, state, files.PSF, equal=equal, columns=columns)
    )


def _made_here(state: Shared, caller: Caller, digest: str) -> PsfRow | None:
    """The caller's PSF whose file has this SHA-256, if a job made this PSF; otherwise None."""
    # At most two PSFs have the same file: the PSF that a job made, and an upload of it.
    rows = state.catalogue.page(PsfRow, owner=caller.owner, limit=2, file_sha256=digest)
    return next((row for row in rows if row.id != digest), None)


@router.get("", summary="List PSFs")
def list_psfs(
    paging: Paging, caller: Reading, state: Shared, filters: Filters, context: InContext = None
) -> Page[PsfView]:
    """PSFs, newest first. With `valid_at`: only PSFs that are certified for this time, or that the context pins for
    this time.
    """
    if context == NOW:
        filters = replace(filters, status=PsfStatus.CERTIFIED)
    elif context is not None:
        with as_problems():
            filters = replace(filters, context_id=state.catalogue.contexts.named(context, caller.owner).id)
    return paging.page(state.catalogue.psfs.page(filters, caller.owner, **paging.query), PsfView.of)


@router.get("/{psf_id}", summary="One PSF version")
def get_psf(psf_id: Identity, caller: Reading, state: Shared) -> PsfView:
    """A PSF's metadata, with links to its files."""
    return PsfView.of(state.row(PsfRow, psf_id, caller.owner))


@in_turn(router.delete("/{psf_id}", summary="Delete a draft PSF that nothing uses"))
def delete_psf(psf_id: Identity, caller: Submitting, state: Shared) -> PsfView:
    """Delete a draft with its files, and return its last description.

    The answer is 409 if the PSF is certified or deprecated, or if it is used by a product, a job that has not ended,
    an open bulk run, a context or another PSF.
    """
    with as_problems():
        row = state.catalogue.delete_draft(psf_id, caller.owner)
    remove_unnamed(state.catalogue, state.store, [digest for digest, _ in files_of(row)])
    log.info("PSF %s: deleted by %s", psf_id, caller.name)
    return PsfView.of(row)


@router.get("/{psf_id}/file", summary="The PSF as FITS", response_class=Response)
def get_psf_file(psf_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Download the PSF; its hash is the ETag."""
    row = state.row(PsfRow, psf_id, caller.owner)
    name = f"psf-{psf_id[:12]}.fits"
    return files.send(request, state.store, row.file_sha256, files.FITS_TYPE, name, size=row.bytes)


@router.get("/{psf_id}/preview", summary="The PSF's picture", response_class=Response)
def get_psf_preview(psf_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """A PNG that shows the PSF, its radial profile and its cumulative curve."""
    digest = state.row(PsfRow, psf_id, caller.owner).preview_sha256
    missing = (
        "no-preview",
        "expected a PSF with a picture; an uploaded PSF has no picture until a job psf-tables draws it: submit that "
        "job",
    )
    return files.send(request, state.store, digest, "image/png", None, missing=missing)


@router.get("/{psf_id}/report", summary="The report of a fit, as JSON", response_class=Response)
def get_psf_report(psf_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Parameters with errors, curves with bands, the residual of every image, and the limits of the data."""
    digest = state.row(PsfRow, psf_id, caller.owner).details.get("report_sha256")
    missing = (
        "no-report",
        "expected a fitted PSF; this PSF was not fitted to a transit: the lineage of the PSF says how it was made",
    )
    name = f"psf-{psf_id[:12]}.json"
    return files.send(request, state.store, digest, files.JSON_TYPE, name, missing=missing)
