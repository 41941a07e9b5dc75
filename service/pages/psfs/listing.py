"""The list of PSFs, with forms to upload a PSF and to build one from a shipped instrument file."""

from __future__ import annotations

from collections.abc import Callable
from typing import get_args

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse
from pydantic import ValidationError, validate_call

from psfcore.instruments.files import instrument_names
from service.api.psfs.filters import psf_filter
from service.api.psfs.versions import list_psfs, upload_psf
from service.http.paging import Cursor
from service.http.state import Shared
from service.pages.parts.forms import fields, filled, start_job, wrong_fields
from service.pages.rendering import page
from service.pages.visitors import PageReading, PageSubmitting
from workers.catalogue.access import Scope
from workers.catalogue.psfs import PsfFilter
from workers.contract.requests import Component, PsfBuild
from workers.versions import PsfStatus

PER_PAGE = 50
FILTERS = ("instrument", "channel", "kind", "name", "version", "status", "valid_at")
router = APIRouter(prefix="/psfs", include_in_schema=False)
_filter: Callable[..., PsfFilter] = validate_call(psf_filter)


@router.get("")
def psf_list(request: Request, caller: PageReading, state: Shared, cursor: Cursor = None) -> Response:
    """PSFs, newest first, with the filters of the API."""
    asked = _asked(request)
    found = list_psfs(request, caller, state, _wanted(asked), asked.get("context"), PER_PAGE, cursor)
    return page(
        request,
        "psfs.html",
        psfs=found.items,
        next=found.next,
        asked={name: asked.get(name, "") for name in (*FILTERS, "context")},
        filtered=bool(asked),
        statuses=list(PsfStatus),
        instruments=instrument_names(),
        components=get_args(Component),
        usual_size=PsfBuild.model_fields["size"].default,
        most_bytes=state.settings.max_upload_bytes,
        may_submit=Scope.SUBMIT in caller.scopes,
    )


@router.post("")
async def upload(
    request: Request, response: Response, caller: PageSubmitting, state: Shared, kind: str | None = None
) -> Response:
    """Take a PSF from the form, and go to its page. kind: as for the API."""
    view = await upload_psf(request, response, caller, state, kind=kind)
    return RedirectResponse(f"/psfs/{view.id}", 303)


@router.post("/build")
async def build(request: Request, caller: PageSubmitting, state: Shared) -> Response:
    """Start the build of a PSF from a shipped instrument file, and go to its job."""
    form = await fields(request)
    return await start_job("psf-build", filled(form, "instrument", "size", "component"), caller, state)


def _asked(request: Request) -> dict[str, str]:
    """The filters of the request that are not empty. A browser also sends the empty fields of a form."""
    names = (*FILTERS, "context")
    return {name: text for name in names if (text := request.query_params.get(name, "").strip())}


def _wanted(asked: dict[str, str]) -> PsfFilter:
    """The filter of the catalogue. Raises ``Problem`` 422 for a wrong value."""
    try:
        return _filter(**{name: asked[name] for name in FILTERS if name in asked})
    except ValidationError as error:
        raise wrong_fields(error, PsfFilter) from error
