"""Progress as server-sent events: of one job or bulk run, ``/v1/jobs/{id}/events`` and ``/v1/bulk/{id}/events``, and of
all jobs and bulk runs of an owner, ``/v1/events``.

The streams of an owner read the database together every ``LOOK_EVERY_S`` seconds (``service.http.lookout``), so any server
can send them.

The stream of one job or bulk run reads its row. The id of an event is a hash of the row's state. If a client reconnects
with the id of its last event (``Last-Event-ID``), it gets an event at once only if the state has changed in the
meantime.

Browsers open at most six connections to a server over HTTP/1.1. A page with one stream for each job would use all six.
Therefore one stream sends all jobs of an owner; its number of queries does not depend on the number of jobs. The stream
remembers the last state of each open job (a job that has not ended), and sends the jobs whose state has changed. A
remembered job that is no longer open has ended or was deleted; the stream reads it by its id, without comparing times.
A job that ended before the stream first read it is found by the time of its end. Bulk runs can be deleted after their
end: the stream also reads the ended runs that it has sent, and reports the deleted runs. The id of an event is a time
(database clock): a client that reconnects with this id gets the jobs that ended after this time.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse
from pydantic import StringConstraints
from starlette.types import Receive, Scope, Send

from service.api.bulk import BulkId, BulkView
from service.api.bulk import find as find_bulk
from service.api.jobs import JobId
from service.api.jobs import find as find_job
from service.http.callers import Caller, Reading, still_let_in
from service.http.lookout import OVERLAP_S, Follower, Lookout, OwnerFollower, RowFollower, Watch
from service.http.problems import RESPONSES
from service.http.state import Shared
from service.views import JobView
from workers.catalogue.followed import MOST, Place

ALIVE_EVERY_S = 15.0
COME_BACK_MS = 2000
TYPE = "text/event-stream"
MOST_NAMED = 50

router = APIRouter(tags=["events"], responses=RESPONSES)
LastId = Annotated[str | None, Header(alias="Last-Event-ID", max_length=64)]
Id = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
Moment = Annotated[str | None, Header(alias="Last-Event-ID", pattern=r"^[0-9]{1,12}\.[0-9]{3}$")]
DESCRIBED: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Events `progress`. The data of each event is the complete job or bulk run. The last event is `end`.",
        "content": {TYPE: {}},
    },
    204: {"description": "The last event that the client received was `end`; no more events follow."},
}
DESCRIBED_OF_OWNER: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Events `job` and `bulk` are sent for new and changed jobs and bulk runs; the data is the complete job "
        'or bulk run. Events `gone` are sent for deleted ones; the data is {"kind": "job" or "bulk", "id": ...}. '
        "A bulk run that ended before the stream began is followed only if the request names it.",
        "content": {TYPE: {}},
    },
}


@router.get(
    "/v1/jobs/{job_id}/events",
    summary="The progress of a job as events",
    response_class=Response,
    responses=DESCRIBED,
)
async def follow_job(
    job_id: JobId, request: Request, caller: Reading, state: Shared, last_id: LastId = None
) -> Response:
    """Send the job now and after every change, until the job ends."""
    row = await run_in_threadpool(find_job, state, caller, job_id)
    follower = RowFollower(caller, state.catalogue.followed_jobs, job_id, JobView.of, last_id)
    return _ended() if follower.knows_end(row) else _stream(request, state, caller, follower)


@router.get(
    "/v1/bulk/{bulk_id}/events",
    summary="The progress of a bulk run as events",
    response_class=Response,
    responses=DESCRIBED,
)
async def follow_bulk(
    bulk_id: BulkId, request: Request, caller: Reading, state: Shared, last_id: LastId = None
) -> Response:
    """Send the bulk run now and after every change, until the run ends. The stream of a paused run stays open."""
    row = await run_in_threadpool(find_bulk, state, caller, bulk_id)
    view = partial(BulkView.of, state=state)
    follower = RowFollower(caller, state.catalogue.followed_bulks, bulk_id, view, last_id)
    return _ended() if follower.knows_end(row) else _stream(request, state, caller, follower)


def _ended() -> Response:
    return Response(status_code=204)  # it tells a browser not to reconnect


def _stream(request: Request, state: Shared, caller: Caller, follower: Follower) -> Response:
    """The stream of a follower, which counts as a stream of the caller until it ends.

    The stream ends after the last text, or after ``stream_s`` seconds, but not before its first look. It also ends when
    the server stops, and when the key is revoked or expires.
    """
    state.streams.open(caller.account)
    ends_at = time.monotonic() + state.settings.stream_s
    lookout = state.lookouts.setdefault(caller.owner, Lookout(partial(still_let_in, state)))

    async def texts() -> AsyncIterator[str]:
        yield f"retry: {COME_BACK_MS}\n\n"
        said_at = time.monotonic()
        while True:
            text, last = await lookout.next(follower)
            if text or time.monotonic() - said_at > ALIVE_EVERY_S:
                said_at = time.monotonic()
                # The comment keeps the connection open while nothing changes.
                yield text or ": still here\n\n"
            if last or time.monotonic() > ends_at or getattr(request.app.state, "stopping", False):
                return

    def close() -> None:
        lookout.leave(follower)
        state.streams.close(caller.account)

    return _Stream(texts(), close)


class _Stream(StreamingResponse):
    """A streaming response that calls ``close`` at its end, also after an error."""

    def __init__(self, texts: AsyncIterator[str], close: Callable[[], None]) -> None:
        # This header tells proxies not to buffer, because a buffer would delay events.
        super().__init__(texts, media_type=TYPE, headers={"X-Accel-Buffering": "no"})
        self._close = close

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._close()


@router.get(
    "/v1/events",
    summary="The progress of all your jobs and bulk runs as events",
    response_class=Response,
    responses=DESCRIBED_OF_OWNER,
)
async def follow_all(
    request: Request,
    caller: Reading,
    state: Shared,
    job: Annotated[
        list[Id] | None,
        Query(max_length=MOST_NAMED, description="ids of jobs to send first, in any phase"),
    ] = None,
    bulk: Annotated[
        list[Id] | None,
        Query(max_length=MOST_NAMED, description="ids of bulk runs to send first, in any phase"),
    ] = None,
    last_id: Moment = None,
) -> Response:
    """Send the state of your jobs and bulk runs, and then each job or bulk run again when it changes.

    The first events are for all jobs and bulk runs that have not ended or that ended in the last seconds, and for those
    that the request names.

    A client that reconnects with `Last-Event-ID` also gets the jobs and bulk runs that ended in the meantime; it may
    get some of these jobs and bulk runs twice. If an owner has very many waiting jobs, only the newest are sent at
    first; each of the others is sent when it starts. The turns of bulk runs, which are jobs too, are not sent.
    """
    catalogue, owner = state.catalogue, caller.owner
    since = Place(
        float(last_id)
        if last_id is not None
        else await run_in_threadpool(catalogue.followed_jobs.now) - OVERLAP_S
    )
    watches: list[Watch[Any]] = [
        Watch("job", catalogue.followed_jobs, JobView.of, owner, frozenset(job or ()), since),
        Watch(
            "bulk",
            catalogue.followed_bulks,
            partial(BulkView.of, state=state),
            owner,
            frozenset(bulk or ()),
            since,
            after_end=MOST,
        ),
    ]
    return _stream(request, state, caller, OwnerFollower(caller, watches))
