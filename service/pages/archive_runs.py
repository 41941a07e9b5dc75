"""The pages of a bulk run of files in a folder: the check of the run before it starts (a dry run), and its start."""

from __future__ import annotations

from collections.abc import Callable

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse

from service.api.bulk import estimate_bulk, submit_bulk
from service.http.callers import Caller
from service.http.problems import Problem
from service.http.state import Shared, State
from service.pages.parts import archive
from service.pages.parts.forms import Sent, fields
from service.pages.parts.sentences import of_error, of_problem
from service.pages.rendering import page
from service.pages.visitors import PageBulk
from workers.bulk.dry_run import BulkEstimate
from workers.contract.bulk import BulkRequest

MOST_REFUSED = 20  # refused images that the page shows
OF_FIELDS = (404, 409, 422)  # statuses of problems that the person can solve in the form
router = APIRouter(prefix="/bulk", include_in_schema=False)


@router.post("/check")
async def check(request: Request, caller: PageBulk, state: Shared) -> Response:
    """Show what the run of the form would do, and the form again. Nothing is started."""
    form = await fields(request)
    return await run_in_threadpool(lambda: _checked(request, form, caller, state))


@router.post("/files")
async def start(request: Request, response: Response, caller: PageBulk, state: Shared) -> Response:
    """Start the run of the form, and show it. If the form is refused, it is shown again with the reason."""
    form = await fields(request)
    return await run_in_threadpool(lambda: _started(request, response, form, caller, state))


def _started(request: Request, response: Response, form: Sent, caller: Caller, state: State) -> Response:
    def submitted(wanted: BulkRequest) -> Response:
        return RedirectResponse(f"/bulk/{submit_bulk(wanted, response, caller, state).id}", 303)

    return _answered(request, form, caller, state, submitted)


def _checked(request: Request, form: Sent, caller: Caller, state: State) -> Response:
    def estimated(wanted: BulkRequest) -> Response:
        return _page(request, form, caller, state, found=estimate_bulk(wanted, caller, state))

    return _answered(request, form, caller, state, estimated)


def _answered(
    request: Request, form: Sent, caller: Caller, state: State, answer: Callable[[BulkRequest], Response]
) -> Response:
    """The answer to the request of the form; if the form is refused, the form with the reason."""
    try:
        return answer(archive.wanted(form))
    except Problem as problem:
        if problem.status not in OF_FIELDS:
            raise
        return _page(request, form, caller, state, problem=problem)


def _page(
    request: Request,
    form: Sent,
    caller: Caller,
    state: State,
    *,
    found: BulkEstimate | None = None,
    problem: Problem | None = None,
) -> Response:
    refused = [] if found is None else found.refused[:MOST_REFUSED]
    return page(
        request,
        "archive_run.html",
        status=200 if problem is None else problem.status,
        found=found,
        refused=[(one.source, of_error(one.error.code, one.error.message)) for one in refused],
        problem=None if problem is None else of_problem(problem),
        asked=archive.shown(form),
        **archive.choices(caller, state),
        **archive.folders(state.settings),
    )
