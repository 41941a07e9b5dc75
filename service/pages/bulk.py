"""The pages of bulk runs: list, start and check of a run, its progress, its results as a contact sheet, and its failed
images.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import JSONResponse, RedirectResponse

from psfcore.deconvolve.summary import LOOK_FROM
from service.api.bulk import (
    BulkId,
    Failed,
    Result,
    cancel_bulk,
    delete_bulk,
    estimate_bulk,
    find,
    get_bulk,
    list_bulks,
    list_failures,
    pause_bulk,
    resume_bulk,
    retry_bulk,
    submit_bulk,
)
from service.http.callers import Caller
from service.http.paging import Cursor, Listing, finite, place, position
from service.http.problems import Problem
from service.http.state import Shared, State
from service.pages.forms import Sent, SentForm, checked, chosen_method, text, usual_steps
from service.pages.login import PageBulk, PageReading
from service.pages.rendering import page, short
from service.pages.sentences import of_error, of_problem
from workers.catalogue.access import Scope
from workers.catalogue.bulk_progress import MOST_EXPLAINED
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import BulkItemRow, ProductRow, PsfContextRow, PsfRow
from workers.contract.bulk import AT_WORK, DELETABLE, FIELDS, OPEN, STOPPED, BulkPhase, BulkRequest, ItemState
from workers.files import archive

PER_PAGE, PER_SHEET = 20, 24
MOST_STARTED = 1000  # images of one run that is started from the form
MOST_CHOICES = 50  # PSFs and contexts that a form offers
MOST_REFUSED = 20  # refused images that the page shows
OF_FIELDS = (404, 409, 422)  # statuses of problems that the person can solve in the form
CHANGES = {"pause": pause_bulk, "resume": resume_bulk, "retry": retry_bulk, "cancel": cancel_bulk}
# The phases in which each change is allowed. A retry also needs failed images.
ALLOWED_IN = {
    "pause": AT_WORK,
    "resume": STOPPED,
    "retry": frozenset(BulkPhase) - {BulkPhase.CANCELLED},
    "cancel": OPEN,
    "delete": DELETABLE,
}
Order = Literal["worst", "bulk"]
# The form of a run of files in a folder.
NAMES = ("pattern", "choice", "name", "method", "steps", "folder", "only", "layout")
LAYOUT_EXAMPLE = "{telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits"
_PSF_NAMES = {"psf": "psf_id", "context": "context"}
router = APIRouter(prefix="/bulk", include_in_schema=False)


# --- start ------------------------------------------------------------------------------------------------


@router.get("")
def bulk_list(request: Request, caller: PageReading, state: Shared, cursor: Cursor = None) -> Response:
    """The bulk runs, newest first, and the forms that start one."""
    runs = list_bulks(Listing(request, PER_PAGE, cursor), caller, state)
    without = state.catalogue.bulks.progress.without_product(caller.owner, MOST_STARTED + 1)
    return page(
        request,
        "bulks.html",
        # A run that is not LISTING or RUNNING has no speed.
        runs=[
            (line, get_bulk(line.id, caller, state) if line.phase in AT_WORK else None) for line in runs.items
        ],
        next=runs.next,
        first_page=cursor is None,
        images=len(without[:MOST_STARTED]),
        more=len(without) > MOST_STARTED,
        may=Scope.BULK in caller.scopes,
        **_form({}, caller, state),
    )


@router.post("/start")
def start(response: Response, caller: PageBulk, state: Shared, form: SentForm) -> Response:
    """Start a run of the uploaded images that have no product, and show it."""
    parts = _common_parts(form)
    images = state.catalogue.bulks.progress.without_product(caller.owner, MOST_STARTED)
    if not images:
        raise Problem(
            409,
            "nothing-to-deconvolve",
            "expected uploaded images without a product; each of your images has one: upload other images first",
        )
    body = checked(BulkRequest, {**parts, "images": list(images)})
    return RedirectResponse(f"/bulk/{submit_bulk(body, response, caller, state).id}", 303)


@router.post("/check")
@router.post("/files")
def folder_run(
    request: Request, response: Response, caller: PageBulk, state: Shared, form: SentForm
) -> Response:
    """Start the run of files in a folder, and show it; or only show what it would do, and the form again. If the form
    is refused, it is shown again with the reason.
    """
    estimate, problem = None, None
    try:
        run = _folder_run(form)
        if request.url.path.endswith("/files"):
            return RedirectResponse(f"/bulk/{submit_bulk(run, response, caller, state).id}", 303)
        estimate = estimate_bulk(run, caller, state)
    except Problem as error:
        if error.status not in OF_FIELDS:
            raise
        problem = error
    refused = [] if estimate is None else estimate.refused[:MOST_REFUSED]
    return page(
        request,
        "archive_run.html",
        status=200 if problem is None else problem.status,
        estimate=estimate,
        refused=[(one.source, of_error(one.error.code, one.error.message)) for one in refused],
        problem=None if problem is None else of_problem(problem),
        **_form(form, caller, state),
    )


def _form(form: Sent, caller: Caller, state: State) -> dict[str, Any]:
    """What the forms show that start a run: their fields, PSFs, contexts, methods, folders, and fields of a layout."""
    settings = state.settings
    return {
        "asked": {name: text(form, name) for name in NAMES},
        "psfs": state.catalogue.psfs.page(PsfFilter(), caller.owner, limit=MOST_CHOICES),
        "contexts": state.catalogue.page(PsfContextRow, owner=caller.owner, limit=MOST_CHOICES),
        "methods": usual_steps(),
        "roots": [str(one) for one in archive.roots(settings.bulk_roots)],
        "output_roots": [str(one) for one in archive.roots(settings.bulk_output_roots)],
        "layout_fields": FIELDS,
        "layout_example": LAYOUT_EXAMPLE,
    }


def _common_parts(form: Sent) -> dict[str, object]:
    """The name, PSF or context (``psf:ID`` or ``context:ID``) and method of a run. Raises ``Problem`` 422."""
    kind, _, identity = text(form, "choice").partition(":")
    if kind not in _PSF_NAMES:
        raise Problem(
            422, "invalid-request", "expected a PSF or a context for the run: go back and choose one"
        )
    method = {"method": chosen_method(form)}
    return {_PSF_NAMES[kind]: identity, "name": text(form, "name"), "parameters": method}


def _folder_run(form: Sent) -> BulkRequest:
    """The request for a run of files in a folder. Raises ``Problem`` 422, which names each wrong field."""
    pattern, folder = text(form, "pattern"), text(form, "folder")
    if not pattern:
        raise Problem(
            422, "invalid-request", "expected a pattern that names files, for example /archive/2025/*.fits"
        )
    if not folder and (text(form, "layout") or text(form, "only")):
        raise Problem(
            422,
            "invalid-request",
            "expected an output folder, because names of files and products only in the folder need one: "
            "enter the folder, or leave these fields empty",
        )
    output = {"folder": folder, "only": bool(text(form, "only")), "layout": text(form, "layout") or None}
    values = {"files": [{"glob": pattern}], "output": output if folder else None, **_common_parts(form)}
    return checked(BulkRequest, values)


# --- a run ------------------------------------------------------------------------------------------------


@router.get("/{bulk_id}")
def bulk(
    bulk_id: BulkId,
    request: Request,
    caller: PageReading,
    state: Shared,
    order: Order = "worst",
    cursor: Annotated[str | None, Query(max_length=200)] = None,
) -> Response:
    """The progress of a run, the reasons of its failures, and a page of its results. A script keeps the progress up to
    date.
    """
    view = get_bulk(bulk_id, caller, state)
    progress = state.catalogue.bulks.progress
    after = place(cursor, finite, position)
    if order == "worst":
        rows = progress.worst(bulk_id, after=after, limit=PER_SHEET + 1)
    else:
        rows = progress.items(bulk_id, ItemState.DONE, after=after[1] if after else -1, limit=PER_SHEET + 1)
    listing = Listing(request, PER_SHEET, cursor)
    reasons = _reasons(bulk_id, caller, state) if view.images.failed else []
    return page(
        request,
        "bulk.html",
        bulk=view,
        psf=None if view.psf_id is None else state.catalogue.get(PsfRow, view.psf_id, caller.owner),
        reasons=reasons,
        most_explained=MOST_EXPLAINED,
        results=_cards(rows[:PER_SHEET], caller, state),
        order=order,
        first_page=cursor is None,
        next=listing.following(rows, lambda row: (repr(row.score or 0.0), str(row.position))),
        look_from=LOOK_FROM,
        allowed={name: view.phase in phases for name, phases in ALLOWED_IN.items()},
        phases={name: " ".join(sorted(phases)) for name, phases in ALLOWED_IN.items()},
        may=Scope.BULK in caller.scopes,
        at_work=view.phase in AT_WORK,
        open=view.phase in OPEN,
    )


@router.get("/{bulk_id}/failures")
def failures(
    bulk_id: BulkId, request: Request, caller: PageReading, state: Shared, cursor: Cursor = None
) -> Response:
    """The failed images, in the order of the run."""
    row = find(state, caller, bulk_id)
    found = list_failures(bulk_id, Listing(request, PER_PAGE, cursor), caller, state)
    uploads = state.catalogue.bulks.progress.names_of_uploads(
        [one.source for one in found.items], caller.owner
    )
    items: list[tuple[Failed, str, str]] = [
        (one, uploads.get(one.source, one.source), of_error(one.error.code, one.error.message))
        for one in found.items
    ]
    return page(request, "bulk_failures.html", bulk=row, items=items, next=found.next)


@router.get("/{bulk_id}/reasons")
def reasons(bulk_id: BulkId, caller: PageReading, state: Shared) -> Response:
    """The failures by reason, for the script of the page of a run."""
    find(state, caller, bulk_id)
    return JSONResponse(_reasons(bulk_id, caller, state))


@router.post("/{bulk_id}/delete")
def delete_run(bulk_id: BulkId, caller: PageBulk, state: Shared) -> Response:
    """Delete a run, and show the list of runs."""
    delete_bulk(bulk_id, caller, state)
    return RedirectResponse("/bulk", 303)


@router.post("/{bulk_id}/{change}")
def change_run(
    bulk_id: BulkId,
    change: Literal["pause", "resume", "retry", "cancel"],
    caller: PageBulk,
    state: Shared,
) -> Response:
    """Pause, resume, retry or cancel a run, and show it."""
    CHANGES[change](bulk_id, caller, state)
    return RedirectResponse(f"/bulk/{bulk_id}", 303)


def _reasons(bulk_id: str, caller: Caller, state: State) -> list[dict[str, object]]:
    """The reasons of failures: the number of images, the code, and an example with its image."""
    found = state.catalogue.bulks.progress.reasons(bulk_id)
    names = _names([reason.example for reason in found], caller, state)
    return [
        {
            "images": reason.images,
            "code": reason.code,
            "told": f"{names[reason.example.position]}: {_told(reason.example)}",
        }
        for reason in found
    ]


def _told(failed: BulkItemRow) -> str:
    error = failed.error or {}
    return of_error(error.get("code", ""), error.get("message", ""))


def _cards(rows: Sequence[BulkItemRow], caller: Caller, state: State) -> list[dict[str, object]]:
    """The entries of the images on the contact sheet."""
    results, names = [Result.of(row) for row in rows], _names(rows, caller, state)
    there = state.catalogue.ids_among(ProductRow, [one.product_id for one in results], caller.owner)
    return [
        {
            "result": one,
            "name": names[one.position],
            "there": one.file is not None and one.product_id in there,
        }
        for one in results
    ]


def _names(rows: Sequence[BulkItemRow], caller: Caller, state: State) -> dict[int, str]:
    """Names of images by their positions: the file names of uploads, and the last part of paths."""
    uploads = [row.source for row in rows if row.uploaded]
    known = state.catalogue.bulks.progress.names_of_uploads(uploads, caller.owner)
    return {
        row.position: known.get(row.source, short(row.source)) if row.uploaded else PurePath(row.source).name
        for row in rows
    }
