"""The jobs of the service by IVOA UWS 1.1, for clients of the Virtual Observatory: ``/uws/jobs``.

Citation: REC-UWS-1.1 (24 October 2016), section 2.2. A job is PENDING until the client starts it. A job has a limit
on its execution time, and a time at which it is destroyed. Each request has a job of its own, but identical requests
share their result: one of the identical jobs runs, and the others wait in phase QUEUED. If that job fails, the next
one runs. Destroying a job does not delete its result. Errors are plain text.
"""

from __future__ import annotations

import time
from typing import Annotated

import anyio
from fastapi import APIRouter, Depends, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import PlainTextResponse, RedirectResponse

from service.api.jobs import check_own, find
from service.http.callers import Caller, Reading, Submitting
from service.http.forms import URL_ENCODED
from service.http.problems import Problem, RouteOptions, problem
from service.http.state import Shared, State
from service.views import time_left_s
from service.vo import job_documents as documents
from service.vo.job_forms import check, kind_of, resolved
from service.vo.parameters import (
    PLAIN_ERRORS,
    Form,
    PlainErrors,
    bad,
    base_url,
    integer,
    moment,
    one,
    query,
    refuse,
    values_of,
)
from workers.catalogue.tables import JobRow
from workers.contract.jobs import JobError, Phase
from workers.lookup import no_such

MAX_RUN_ID = 256
MOST = 2**31 - 1
MOST_LISTED = 10_000  # largest number of jobs in one document, because the document is built in memory
PENDING_ONLY = "parameters can be set only while a job is PENDING"
FIRST_LOOK_S, LONGEST_LOOK_S = 0.05, 1.0  # a waiting request checks its job at growing intervals
# The last four are phases of the standard. Jobs of this service are never in these phases, but clients may
# ask for such jobs.
PHASES = frozenset({*Phase, "HELD", "SUSPENDED", "UNKNOWN", "ARCHIVED"})


TEXT: RouteOptions = {"response_class": PlainTextResponse}
XML: RouteOptions = {
    "response_class": Response,
    "responses": {200: {"content": {documents.MEDIA_TYPE: {}}, "description": "A document of UWS 1.1"}},
}
TO_JOB: RouteOptions = {"status_code": 303, "response_class": RedirectResponse}


def _form(**described: str) -> RouteOptions:
    """A route that reads a form and answers with the address of a job. Its fields have the descriptions in
    ``described``.
    """
    fields = {name: {"type": "string", "description": text} for name, text in described.items()}
    schema = {"type": "object", "properties": fields, "additionalProperties": {"type": "string"}}
    return {**TO_JOB, "openapi_extra": {"requestBody": {"content": {URL_ENCODED: {"schema": schema}}}}}


router = APIRouter(
    prefix="/uws/jobs",
    tags=["uws"],
    route_class=PlainErrors,
    responses=PLAIN_ERRORS,
)


def _find(job_id: str, caller: Reading, state: Shared) -> JobRow:
    """The row of a job. Raises ``Problem`` 404 if the caller has no such job."""
    if len(job_id) != 32 or not set(job_id) <= set("0123456789abcdef"):
        raise problem(no_such("job", f"{job_id[:64]!a}"))
    return find(state, caller, job_id)


def _find_own(job_id: str, caller: Submitting, state: Shared) -> JobRow:
    """The row of a job that the caller may change."""
    return check_own(_find(job_id, caller, state))


Job = Annotated[JobRow, Depends(_find)]
OwnJob = Annotated[JobRow, Depends(_find_own)]


@router.get(
    "",
    summary="UWS: the job list",
    **XML
    | {
        "openapi_extra": query(
            PHASE="list jobs in this phase; may be repeated",
            AFTER="list jobs created after this time (ISO 8601, UTC)",
            LAST=f"list only this number of the newest jobs; at most {MOST_LISTED}, which is also the default",
        )
    },
)
def list_uws_jobs(request: Request, caller: Reading, state: Shared) -> Response:
    """Your jobs, newest first. /v1/jobs lists all of them in pages."""
    sent = values_of(request.query_params.multi_items(), "phase")
    after, last = one(sent, "after"), one(sent, "last")
    # Documents show times to the millisecond. Therefore AFTER excludes the whole millisecond that the client names.
    from_time = None if after is None else (int(moment("AFTER", after) * 1000) + 1) / 1000
    lines = state.catalogue.uws.lines(
        phases=[_phase(text) for text in sent.get("phase", ())],
        from_time=from_time,
        last=MOST_LISTED if last is None else min(integer("LAST", last, 1), MOST_LISTED),
        owner=caller.owner,
    )
    return _xml(documents.job_list(lines, _jobs_url(request)))


@router.post(
    "",
    summary="UWS: create a job",
    **_form(
        KIND="kind of job, for example deconvolve",
        PHASE="RUN: start the job at once",
        RUNID="your own name for the job",
        EXECUTIONDURATION="seconds that the job may execute",
        DESTRUCTION="time at which the job is destroyed",
    ),
)
def create_uws_job(caller: Submitting, form: Form, request: Request, state: Shared) -> Response:
    """Create a job. All other fields are parameters of the job; write objects as JSON, and inputs by the ids of their
    uploads.
    """
    run_id, start = form.pop("runid", None), form.pop("phase", None)
    duration, destruction = form.pop("executionduration", None), form.pop("destruction", None)
    kind = kind_of(form)
    if run_id is not None and (not run_id.isprintable() or len(run_id) > MAX_RUN_ID):
        raise bad(f"expected RUNID of at most {MAX_RUN_ID} printable characters; got {run_id[:40]!a}")
    if start not in (None, "RUN"):
        raise bad(f"expected PHASE=RUN or no PHASE; got {start[:40]!a}")
    check(kind, form)
    ready = resolved(state, caller.owner, kind, form) if start else None
    row = state.catalogue.uws.draft(
        kind,
        form,
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
    **XML
    | {
        "openapi_extra": query(
            WAIT="seconds to wait for a change of the phase; -1: as long as the service allows",
            PHASE="with WAIT: wait only if the job is in this phase",
        )
    },
)
async def get_uws_job(job_id: str, request: Request, caller: Reading, state: Shared) -> Response:
    """Show the job: at once, or with WAIT as soon as its phase changes."""
    sent = values_of(request.query_params.multi_items())
    most = state.settings.uws_max_wait_s
    wait_s = integer("WAIT", one(sent, "wait") or "0", -1)
    deadline = time.monotonic() + (most if wait_s < 0 else min(wait_s, most))
    row = await run_in_threadpool(_find, job_id, caller, state)
    seen = _phase(sent["phase"][0]) if "phase" in sent else row.phase
    look_s = FIRST_LOOK_S
    while row.phase == seen and not Phase(row.phase).ended:
        left_s = deadline - time.monotonic()
        if left_s <= 0 or getattr(request.app.state, "stopping", False) or await request.is_disconnected():
            break
        await anyio.sleep(min(look_s, left_s))
        look_s = min(look_s * 1.4, LONGEST_LOOK_S)
        row = await run_in_threadpool(_find, job_id, caller, state)
    terms = await run_in_threadpool(state.catalogue.uws.terms, job_id)
    return _xml(documents.job(row, terms, _quote(row), base_url(request)))


@router.delete("/{job_id}", summary="UWS: abort and destroy a job", **TO_JOB)
def delete_uws_job(row: OwnJob, request: Request, state: Shared) -> Response:
    """Delete the job in any phase. If a worker runs the job, the worker stops it. The result of the job stays in the
    catalogue.
    """
    state.catalogue.uws.destroy(row.id)
    return RedirectResponse(_jobs_url(request), 303)


@router.post("/{job_id}", summary="UWS: destroy a job", **_form(ACTION="DELETE"))
def post_uws_job(row: OwnJob, form: Form, request: Request, state: Shared) -> Response:
    """The same as DELETE, for browsers."""
    if form.get("action") != "DELETE":
        raise bad(f"expected ACTION=DELETE, got {form.get('action', '')[:40]!a}")
    return delete_uws_job(row, request, state)


@router.get("/{job_id}/phase", summary="UWS: a job's phase", **TEXT)
def get_uws_phase(row: Job) -> Response:
    """The phase as one word."""
    return PlainTextResponse(row.phase)


@router.post("/{job_id}/phase", summary="UWS: start or abort a job", **_form(PHASE="RUN or ABORT"))
def post_uws_phase(row: OwnJob, form: Form, caller: Submitting, request: Request, state: Shared) -> Response:
    """RUN queues a PENDING job. ABORT stops a job that has not ended. A repeated request changes nothing."""
    match form.get("phase"):
        case "RUN":
            _start(state, caller, row)
        case "ABORT":
            state.catalogue.jobs.cancel(row.id)
        case other:
            raise bad(f"expected PHASE=RUN or PHASE=ABORT, got {(other or '')[:40]!a}")
    return _see(request, row.id)


@router.get("/{job_id}/executionduration", summary="UWS: how long a job may execute", **TEXT)
def get_uws_duration(row: Job, state: Shared) -> Response:
    """Seconds; 0: unlimited."""
    return PlainTextResponse(str(state.catalogue.uws.terms(row.id).execution_duration_s))


@router.post(
    "/{job_id}/executionduration",
    summary="UWS: limit how long a job may execute",
    **_form(EXECUTIONDURATION="seconds; 0: unlimited"),
)
def post_uws_duration(row: OwnJob, form: Form, request: Request, state: Shared) -> Response:
    """Set the limit. If it exceeds the largest limit that the operator allows, the service sets that limit."""
    limit_s = _duration(state, _field(form, "EXECUTIONDURATION"))
    state.catalogue.uws.set_terms(row.id, execution_duration_s=limit_s)
    return _see(request, row.id)


@router.get("/{job_id}/destruction", summary="UWS: when a job is destroyed", **TEXT)
def get_uws_destruction(row: Job, state: Shared) -> Response:
    """A time; empty if the job is never destroyed."""
    return _time(state.catalogue.uws.terms(row.id).destruction_at)


@router.post(
    "/{job_id}/destruction",
    summary="UWS: set when a job is destroyed",
    **_form(DESTRUCTION="a time (ISO 8601, UTC)"),
)
def post_uws_destruction(row: OwnJob, form: Form, request: Request, state: Shared) -> Response:
    """Set the time. If it is later than the latest time that the operator allows, the service sets that time."""
    at = _destruction(state, _field(form, "DESTRUCTION"))
    state.catalogue.uws.set_terms(row.id, destruction_at=at)
    return _see(request, row.id)


@router.get("/{job_id}/quote", summary="UWS: when a job is expected to end", **TEXT)
def get_uws_quote(row: Job) -> Response:
    """A time; empty if unknown."""
    return _time(_quote(row))


@router.get("/{job_id}/owner", summary="UWS: the owner of a job", **TEXT)
def get_uws_owner(row: Job) -> Response:
    """The owner's name."""
    return PlainTextResponse(row.owner)


@router.get("/{job_id}/parameters", summary="UWS: a job's parameters", **XML)
def get_uws_parameters(row: Job) -> Response:
    """While the job is PENDING, the parameters as the client sent them. After its start, the parameters with every
    default filled in.
    """
    return _xml(documents.parameters(row))


@router.post("/{job_id}/parameters", summary="UWS: change a pending job's parameters", **_form())
def post_uws_parameters(
    job_id: str, caller: Submitting, form: Form, request: Request, state: Shared
) -> Response:
    """Set parameters of a PENDING job. Parameters that are not sent do not change."""
    row = _find(job_id, caller, state)
    if row.phase != Phase.PENDING:
        raise _not_now(row, PENDING_ONLY)
    if kind_of({"kind": row.kind} | form) != row.kind:
        raise bad(
            f"expected KIND={row.kind}; got {form['kind']}: the kind of a job cannot change, so create another job"
        )
    form.pop("kind", None)

    def change(given: dict[str, str]) -> dict[str, str]:
        check(row.kind, given | form)
        return given | form

    if not state.catalogue.uws.amend(row.id, change):
        raise _not_now(_find(row.id, caller, state), PENDING_ONLY)
    return _see(request, row.id)


@router.get("/{job_id}/results", summary="UWS: a job's results", **XML)
def get_uws_results(row: Job, request: Request) -> Response:
    """Addresses of the results; empty until the job is COMPLETED."""
    return _xml(documents.results(row, base_url(request)))


@router.get("/{job_id}/results/{name}", summary="UWS: one of a job's results", **TO_JOB)
def get_uws_result(job_id: str, name: str, row: Job, request: Request) -> Response:
    """Redirect to the file that the job made (``result``) or to its description (``description``)."""
    result = documents.result_addresses(row).get(name)
    if result is None:
        raise Problem(
            404,
            "no-such-result",
            f"expected a result of job {job_id}; it is {row.phase} and has no result {name[:40]!a}",
        )
    return RedirectResponse(base_url(request) + result[0], 303)


@router.get("/{job_id}/error", summary="UWS: why a job failed", **TEXT)
def get_uws_error(row: Job) -> Response:
    """The error and its fault: user, transient or internal."""
    if row.error is None:
        raise Problem(
            404, "no-error", f"expected a job with an error; job {row.id} is {row.phase} and has none"
        )
    error = JobError.model_validate(row.error)
    return PlainTextResponse(f"{error.message}\n({error.code}, fault: {error.fault})\n")


def _phase(text: str) -> str:
    """A phase of the standard."""
    if text not in PHASES:
        refuse("PHASE", f"one of {', '.join(sorted(PHASES))}", text)
    return text


def _start(state: State, caller: Caller, row: JobRow) -> None:
    """Move a job from PENDING to QUEUED. Raises ``Problem`` 400 for wrong parameters, 403 if the job has ended."""
    while row.phase == Phase.PENDING:
        if state.catalogue.uws.start(
            row.id, row.parameters, *resolved(state, row.owner, row.kind, row.parameters)
        ):
            state.reconciler.wake()
            return
        row = _find(row.id, caller, state)  # another request changed the job in the meantime
    if Phase(row.phase).ended:
        raise _not_now(row, "PHASE=RUN can start only a PENDING job: create a new job")


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
        raise bad(f"expected DESTRUCTION, a time in the future; got {text}")
    return min(asked, last)


def _field(form: dict[str, str], name: str) -> str:
    if name.lower() not in form:
        raise bad(f"expected the field {name}; got none")
    return form[name.lower()]


def _quote(row: JobRow) -> float | None:
    left_s = time_left_s(row)
    return None if left_s is None else time.time() + left_s


def _jobs_url(request: Request) -> str:
    return f"{base_url(request)}{router.prefix}"


def _see(request: Request, job_id: str) -> Response:
    return RedirectResponse(f"{_jobs_url(request)}/{job_id}", 303)


def _xml(content: bytes) -> Response:
    return Response(content, media_type=documents.MEDIA_TYPE)


def _time(at: float | None) -> Response:
    return PlainTextResponse("" if at is None else documents.time_text(at))
