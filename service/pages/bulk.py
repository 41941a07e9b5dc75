"""The pages of bulk runs: the list and the start of a run, its progress, its results as a contact sheet, and its failed images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import JSONResponse, RedirectResponse
from pydantic import ValidationError

from service.api.bulk import (
    LOOK_FROM,
    BulkId,
    BulkLine,
    BulkView,
    Failed,
    cancel_bulk,
    delete_bulk,
    find,
    get_bulk,
    list_bulks,
    list_failures,
    pause_bulk,
    resume_bulk,
    retry_bulk,
    submit_bulk,
)
from service.api.bulk_results import Result
from service.http.callers import Caller
from service.http.paging import Cursor, following, number, place
from service.http.problems import Problem
from service.http.state import Shared, State
from service.pages.parts import archive, methods
from service.pages.parts.forms import wrong_fields
from service.pages.parts.sentences import of_error
from service.pages.rendering import page, short
from service.pages.visitors import PageBulk, PageReading
from workers.catalogue.access import Scope
from workers.catalogue.bulk_progress import MOST_EXPLAINED
from workers.catalogue.bulk_tables import BulkItemRow
from workers.contract.bulk import AT_WORK, DELETABLE, OPEN, STOPPED, BulkPhase, BulkRequest, ItemState

PER_PAGE, PER_SHEET = 20, 24
MOST_STARTED = 1000  # images of one run that is started from the form
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
router = APIRouter(prefix="/bulk", include_in_schema=False)


@router.get("")
def bulk_list(request: Request, caller: PageReading, state: Shared, cursor: Cursor = None) -> Response:
    """The bulk runs, newest first, and the form that starts one."""
    found = list_bulks(request, caller, state, limit=PER_PAGE, cursor=cursor)
    without = state.catalogue.bulks.progress.without_product(caller.owner, MOST_STARTED + 1)
    return page(
        request,
        "bulks.html",
        runs=[(line, _pace(line, caller, state)) for line in found.items],
        next=found.next,
        first_page=cursor is None,
        images=len(without[:MOST_STARTED]),
        more=len(without) > MOST_STARTED,
        asked=archive.shown({}),
        **archive.choices(caller, state),
        **archive.folders(state.settings),
        may=Scope.BULK in caller.scopes,
    )


@router.post("/start")
def start(
    response: Response,
    caller: PageBulk,
    state: Shared,
    choice: Annotated[str, Form()] = "",
    name: Annotated[str, Form()] = "",
    method: Annotated[str, Form()] = "",
    steps: Annotated[str, Form()] = "",
) -> Response:
    """Start a run of the uploaded images that have no product, and show it. choice: ``psf:ID`` or ``context:ID``."""
    psf = archive.chosen_psf(choice)
    images = state.catalogue.bulks.progress.without_product(caller.owner, MOST_STARTED)
    if not images:
        raise Problem(
            409,
            "nothing-to-deconvolve",
            "expected uploaded images without a product; each of your images has one: upload other images first",
        )
    parameters = {"method": methods.chosen({"method": method, "steps": steps})}
    wanted = {**psf, "images": list(images), "name": name, "parameters": parameters}
    try:
        body = BulkRequest.model_validate(wanted)
    except ValidationError as error:
        wrong = {str(found["loc"][0]) for found in error.errors() if found["loc"]}
        if "parameters" in wrong:
            raise wrong_fields(error, BulkRequest, above=len(("parameters",))) from error
        advice = "a name of at most 80 letters in one line" if "name" in wrong else "a PSF of the list"
        raise Problem(422, "invalid-request", f"expected {advice}: go back and correct the form") from error
    made = submit_bulk(body, response, caller, state)
    return RedirectResponse(f"/bulk/{made.id}", 303)


@router.get("/{bulk_id}")
def bulk(
    bulk_id: BulkId,
    request: Request,
    caller: PageReading,
    state: Shared,
    order: Order = "worst",
    cursor: Annotated[str | None, Query(max_length=200)] = None,
) -> Response:
    """The progress of a run, the reasons of its failures, and a page of its results. A script keeps the progress up to date."""
    view = get_bulk(bulk_id, caller, state)
    progress = state.catalogue.bulks.progress
    after = _after(cursor)
    if order == "worst":
        rows = progress.worst(bulk_id, after=after, limit=PER_SHEET + 1)
    else:
        rows = progress.items(bulk_id, ItemState.DONE, after=after[1] if after else -1, limit=PER_SHEET + 1)
    last = rows[PER_SHEET - 1] if len(rows) > PER_SHEET else None
    reasons = _reasons(bulk_id, caller, state) if view.images.failed else []
    return page(
        request,
        "bulk.html",
        bulk=view,
        reasons=reasons,
        most_explained=MOST_EXPLAINED,
        results=_cards(rows[:PER_SHEET], caller, state),
        order=order,
        first_page=cursor is None,
        next=None if last is None else following(request, repr(last.score or 0.0), str(last.position)),
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
    found = list_failures(bulk_id, request, caller, state, PER_PAGE, cursor)
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


def _reasons(bulk_id: str, caller: Caller, state: State) -> list[dict[str, Any]]:
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


def _pace(line: BulkLine, caller: Caller, state: State) -> BulkView | None:
    """The description of a bulk run with its speed; None for a run that is not LISTING or RUNNING: it has no speed."""
    return get_bulk(line.id, caller, state) if line.phase in AT_WORK else None


def _after(cursor: str | None) -> tuple[float, int] | None:
    """The (score, position) in a cursor. Raises ``Problem`` 422 if this service did not issue it."""
    parts = place(cursor, 2)
    if parts is None:
        return None
    if not parts[1].isdecimal() or len(parts[1]) > 9:
        raise Problem(
            422,
            "bad-cursor",
            "expected the address of a page of results; got another one: go back to the first page",
        )
    return number(parts[0]), int(parts[1])


def _cards(rows: Sequence[BulkItemRow], caller: Caller, state: State) -> list[dict[str, Any]]:
    """The entries of the images on the contact sheet."""
    results, names = [Result.of(row) for row in rows], _names(rows, caller, state)
    there = state.catalogue.bulks.progress.still_there([one.product_id for one in results], caller.owner)
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
