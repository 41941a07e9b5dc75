"""IVOA UWS 1.1 over the same jobs: ``/uws/jobs``, for clients of the Virtual Observatory.

Citation: REC-UWS-1.1 (24 October 2016), section 2.2. A job is PENDING until it is told to run, has an end to its
execution and to its keeping, and stands for itself: equal requests share what they make, but not their jobs. Of
equal jobs one is at work at a time: the others are QUEUED until it ends, and then COMPLETED with what it made, or tried
where it made nothing. What a job made stays in the catalogue when the job is destroyed. Errors are plain text.
"""

from __future__ import annotations

import time
from typing import Any

import anyio
from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import PlainTextResponse, RedirectResponse

from service.api.jobs import time_left_s
from service.http.callers import Caller, Reading, Submitting
from service.http.problems import Problem
from service.http.state import Shared, State
from service.uws import documents
from service.uws import plain_errors as routing
from service.uws.parameters import Form, bad, check, integer, kind_of, moment, phase, query_of, resolved
from workers.catalogue.tables import JobRow, TermsRow
from workers.contract.phases import JobError, Phase

MAX_RUN_ID = 256
MOST = 2**31 - 1
MOST_LISTED = 10_000  # jobs in one document, which is built in memory
FIRST_LOOK_S, LONGEST_LOOK_S = 0.05, 1.0  # a job that is waited for is looked at less and less often


router = APIRouter(
    prefix="/uws/jobs",
    tags=["uws"],
    route_class=routing.PlainErrors,
    responses={"4XX": {"content": {"text/plain": {}}, "description": "What was expected and what came."}},
)


@router.get(
    "",
    summary="UWS: the job list",
    **routing.XML,
    openapi_extra=routing.query(
        PHASE="jobs in this phase; several are one of them",
        AFTER="jobs created after this time, ISO 8601 in UTC",
        LAST=f"so many jobs, the newest; at most {MOST_LISTED}, which are as many as come without it",
    ),
)
def list_uws_jobs(request: Request, caller: Reading, state: Shared) -> Response:
    """Jobs, newest first, as far as they are asked for, and no more than LAST may be; /v1/jobs has pages."""
    query = query_of(request, "phase")
    after, last = query.get("after"), query.get("last")
    # Times are shown to the millisecond, so "after" is the millisecond after.
    from_time = None if after is None else (int(moment("AFTER", after[0]) * 1000) + 1) / 1000
    lines = state.catalogue.uws.lines(
        phases=[phase(text) for text in query.get("phase", ())],
        from_time=from_time,
        last=MOST_LISTED if last is None else min(integer("LAST", last[0], 1), MOST_LISTED),
        owner=caller.owner,
    )
    return _xml(documents.job_list(lines, _jobs_url(request)))


@router.post(
    "",
    summary="UWS: set up a job",
    **routing.TO_JOB,
    openapi_extra=routing.form(
        KIND="of job, as deconvolve",
        PHASE="RUN starts it at once",
        RUNID="a name of yours for it",
        EXECUTIONDURATION="seconds that it may execute",
        DESTRUCTION="time at which it is destroyed",
    ),
)
def create_uws_job(caller: Submitting, form: Form, request: Request, state: Shared) -> Response:
    """A new job, PENDING or told to run. Other fields are its parameters; those that are objects are JSON."""
    run_id, start = form.pop("runid", None), form.pop("phase", None)
    duration, destruction = form.pop("executionduration", None), form.pop("destruction", None)
    kind = kind_of(form)
    if run_id is not None and (documents.NO_XML.search(run_id) or len(run_id) > MAX_RUN_ID):
        raise bad(f"expected RUNID of at most {MAX_RUN_ID} characters that XML can hold; got {run_id[:40]!a}")
    if start not in (None, "RUN"):
        raise bad(f"expected PHASE=RUN or none, got {start[:40]!a}")
    check(kind, form)
    ready = resolved(state, caller.owner, kind, form) if start else None
    row = state.catalogue.uws.draft(
        kind,
        dict(form),
        run_id=run_id,
        execution_duration_s=_duration(state, duration or "0"),
        destruction_at=_destruction(state, destruction),
        owner=caller.owner,
    )
    if ready is not None and state.catalogue.uws.start(row.id, row.parameters, *ready):
        state.reconciler.wake()
    return _see(request, row.id)


@router.get(
    "/{job_id}",
    summary="UWS: a job",
    **routing.XML,
    openapi_extra=routing.query(
        WAIT="seconds to wait for the job's phase to change; -1: as long as the service keeps a client waiting",
        PHASE="with WAIT: do not wait where the job is not in this phase",
    ),
)
async def get_uws_job(job_id: str, request: Request, caller: Reading, state: Shared) -> Response:
    """The job as it is, or as soon as its phase is another. Who waits holds no thread."""
    query = query_of(request)
    most = state.settings.uws_max_wait_s
    wait_s = integer("WAIT", query["wait"][0], -1) if "wait" in query else 0
    deadline = time.monotonic() + (most if wait_s < 0 else min(wait_s, most))
    row = await run_in_threadpool(_find, state, caller, job_id)
    seen = phase(query["phase"][0]) if "phase" in query else row.phase
    look_s = FIRST_LOOK_S
    while row.phase == seen and not Phase(row.phase).ended:
        left_s = deadline - time.monotonic()
        if left_s <= 0 or getattr(request.app.state, "stopping", False) or await request.is_disconnected():
            break
        await anyio.sleep(min(look_s, left_s))
        look_s = min(look_s * 1.4, LONGEST_LOOK_S)
        row = await run_in_threadpool(_find, state, caller, job_id)
    terms = await run_in_threadpool(state.catalogue.uws.terms, job_id)
    return _xml(documents.job(row, terms, _quote(row), _base_url(request)))


@router.delete("/{job_id}", summary="UWS: abort and destroy a job", **routing.TO_JOB)
def delete_uws_job(job_id: str, request: Request, caller: Submitting, state: Shared) -> Response:
    """The job is gone, whatever its phase; a worker that has it stops. What it made stays in the catalogue."""
    _find(state, caller, job_id)
    state.catalogue.uws.destroy(job_id)
    return RedirectResponse(_jobs_url(request), 303)


@router.post(
    "/{job_id}", summary="UWS: destroy a job", **routing.TO_JOB, openapi_extra=routing.form(ACTION="DELETE")
)
def post_uws_job(job_id: str, caller: Submitting, form: Form, request: Request, state: Shared) -> Response:
    """The same as DELETE, for browsers."""
    _find(state, caller, job_id)
    if form.get("action") != "DELETE":
        raise bad(f"expected ACTION=DELETE, got {form.get('action', '')[:40]!a}")
    return delete_uws_job(job_id, request, caller, state)


@router.get("/{job_id}/phase", summary="UWS: a job's phase", **routing.TEXT)
def get_uws_phase(job_id: str, caller: Reading, state: Shared) -> Response:
    """The phase, one word."""
    return _text(_find(state, caller, job_id).phase)


@router.post(
    "/{job_id}/phase",
    summary="UWS: start or abort a job",
    **routing.TO_JOB,
    openapi_extra=routing.form(PHASE="RUN or ABORT"),
)
def post_uws_phase(job_id: str, caller: Submitting, form: Form, request: Request, state: Shared) -> Response:
    """RUN queues a PENDING job; ABORT stops one that has not ended. Where that is so already nothing happens."""
    row = _find(state, caller, job_id)
    match form.get("phase"):
        case "RUN":
            _start(state, caller, row)
        case "ABORT":
            state.catalogue.jobs.cancel(job_id)
        case other:
            raise bad(f"expected PHASE=RUN or PHASE=ABORT, got {(other or '')[:40]!a}")
    return _see(request, job_id)


@router.get("/{job_id}/executionduration", summary="UWS: how long a job may execute", **routing.TEXT)
def get_uws_duration(job_id: str, caller: Reading, state: Shared) -> Response:
    """Seconds; 0 is as long as it takes."""
    return _text(str(_terms(state, caller, job_id)[1].execution_duration_s))


@router.post(
    "/{job_id}/executionduration",
    summary="UWS: limit how long a job may execute",
    **routing.TO_JOB,
    openapi_extra=routing.form(EXECUTIONDURATION="seconds; 0: as long as it takes"),
)
def post_uws_duration(
    job_id: str, caller: Submitting, form: Form, request: Request, state: Shared
) -> Response:
    """The limit is set, or to what is allowed where more was asked for."""
    _find(state, caller, job_id)
    asked = _duration(state, _given(form, "EXECUTIONDURATION"))
    state.catalogue.uws.set_terms(job_id, execution_duration_s=asked)
    return _see(request, job_id)


@router.get("/{job_id}/destruction", summary="UWS: when a job is destroyed", **routing.TEXT)
def get_uws_destruction(job_id: str, caller: Reading, state: Shared) -> Response:
    """A time, or nothing where the job is kept for good."""
    at = _terms(state, caller, job_id)[1].destruction_at
    return _text("" if at is None else documents.time_text(at))


@router.post(
    "/{job_id}/destruction",
    summary="UWS: say when a job is destroyed",
    **routing.TO_JOB,
    openapi_extra=routing.form(DESTRUCTION="ISO 8601 in UTC"),
)
def post_uws_destruction(
    job_id: str, caller: Submitting, form: Form, request: Request, state: Shared
) -> Response:
    """The time is set, or to the last one that is allowed where a later one was asked for."""
    _find(state, caller, job_id)
    at = _destruction(state, _given(form, "DESTRUCTION"))
    state.catalogue.uws.set_terms(job_id, destruction_at=at)
    return _see(request, job_id)


@router.get("/{job_id}/quote", summary="UWS: when a job is likely to be done", **routing.TEXT)
def get_uws_quote(job_id: str, caller: Reading, state: Shared) -> Response:
    """A time, or nothing where it is not known."""
    at = _quote(_find(state, caller, job_id))
    return _text("" if at is None else documents.time_text(at))


@router.get("/{job_id}/owner", summary="UWS: whose job it is", **routing.TEXT)
def get_uws_owner(job_id: str, caller: Reading, state: Shared) -> Response:
    """The owner's name."""
    return _text(_find(state, caller, job_id).owner)


@router.get("/{job_id}/parameters", summary="UWS: a job's parameters", **routing.XML)
def get_uws_parameters(job_id: str, caller: Reading, state: Shared) -> Response:
    """As given while the job is PENDING; with every default filled in once it was told to run."""
    return _xml(documents.parameters(_find(state, caller, job_id)))


@router.post(
    "/{job_id}/parameters",
    summary="UWS: change a pending job's parameters",
    **routing.TO_JOB,
    openapi_extra=routing.form(),
)
def post_uws_parameters(
    job_id: str, caller: Submitting, form: Form, request: Request, state: Shared
) -> Response:
    """Set parameters of a job that is PENDING; others stay as they are."""
    row = _find(state, caller, job_id)
    if kind_of({"kind": row.kind} | form) != row.kind:
        raise bad(f"expected KIND={row.kind}, which a job keeps; got {form['kind']}")
    form.pop("kind", None)

    def change(given: dict[str, Any]) -> dict[str, Any]:
        check(row.kind, given | form)
        return given | form

    if not state.catalogue.uws.amend(job_id, change):
        raise _not_now(_find(state, caller, job_id), "parameters are set while it is PENDING")
    return _see(request, job_id)


@router.get("/{job_id}/results", summary="UWS: a job's results", **routing.XML)
def get_uws_results(job_id: str, request: Request, caller: Reading, state: Shared) -> Response:
    """Addresses of what the job made: none before it is completed."""
    return _xml(documents.results(_find(state, caller, job_id), _base_url(request)))


@router.get("/{job_id}/results/{name}", summary="UWS: one of a job's results", **routing.TO_JOB)
def get_uws_result(job_id: str, name: str, request: Request, caller: Reading, state: Shared) -> Response:
    """To the file that the job made (``result``) or to what is known of it (``description``)."""
    row = _find(state, caller, job_id)
    found = documents.result_addresses(row).get(name)
    if found is None:
        raise Problem(404, "no-such-result", f"job {job_id} is {row.phase} and has no result {name[:40]!a}")
    return RedirectResponse(_base_url(request) + found[0], 303)


@router.get("/{job_id}/error", summary="UWS: why a job failed", **routing.TEXT)
def get_uws_error(job_id: str, caller: Reading, state: Shared) -> Response:
    """What went wrong, and whose fault it is."""
    row = _find(state, caller, job_id)
    if row.error is None:
        raise Problem(404, "no-error", f"job {job_id} is {row.phase} and has no error")
    error = JobError.model_validate(row.error)
    return _text(f"{error.message}\n({error.code}, fault: {error.fault})\n")


def _start(state: State, caller: Caller, row: JobRow) -> None:
    """PENDING -> QUEUED. ``Problem`` 400 where the parameters are not what the job needs, 403 where it has ended."""
    while row.phase == Phase.PENDING:
        if state.catalogue.uws.start(
            row.id, row.parameters, *resolved(state, row.owner, row.kind, row.parameters)
        ):
            state.reconciler.wake()
            return
        row = _find(state, caller, row.id)  # changed meanwhile
    if Phase(row.phase).ended:
        raise _not_now(row, "PHASE=RUN starts one that is PENDING")


def _not_now(row: JobRow, rule: str) -> Problem:
    return Problem(403, "wrong-phase", f"job {row.id} is {row.phase}; {rule}")


def _duration(state: State, text: str) -> int:
    asked, most = integer("EXECUTIONDURATION", text, 0), state.settings.uws_max_execution_s
    return min(asked, most or MOST) if asked else most


def _destruction(state: State, text: str | None) -> float:
    now = time.time()
    last = now + state.settings.uws_max_keep_s
    asked = last if text is None else moment("DESTRUCTION", text)
    if asked <= now:
        raise bad(f"expected DESTRUCTION, a time that is to come; got {text}")
    return min(asked, last)


def _given(form: dict[str, str], name: str) -> str:
    if name.lower() not in form:
        raise bad(f"expected {name}, got no such field")
    return form[name.lower()]


def _quote(row: JobRow) -> float | None:
    left_s = time_left_s(row)
    return None if left_s is None else time.time() + left_s


def _find(state: State, caller: Caller, job_id: str) -> JobRow:
    """The job's row, where it is this owner's; ``Problem`` 404 where it is not."""
    known = len(job_id) == 32 and set(job_id) <= set("0123456789abcdef")
    row = state.catalogue.jobs.get(job_id) if known else None
    if row is None or row.owner != caller.owner:
        raise Problem(404, "no-such-job", f"there is no job with id {job_id[:64]!a}")
    return row


def _terms(state: State, caller: Caller, job_id: str) -> tuple[JobRow, TermsRow]:
    return _find(state, caller, job_id), state.catalogue.uws.terms(job_id)


def _base_url(request: Request) -> str:
    return str(request.base_url).rstrip("/")


def _jobs_url(request: Request) -> str:
    return f"{_base_url(request)}{router.prefix}"


def _see(request: Request, job_id: str) -> Response:
    return RedirectResponse(f"{_jobs_url(request)}/{job_id}", 303)


def _xml(content: bytes) -> Response:
    return Response(content, media_type=documents.MEDIA_TYPE)


def _text(content: str) -> Response:
    return PlainTextResponse(content)
