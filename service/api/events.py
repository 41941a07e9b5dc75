"""Progress as server-sent events: of one job or bulk run, ``/v1/jobs/{id}/events`` and ``/v1/bulk/{id}/events``, and of
all jobs and bulk runs of an owner, ``/v1/events``.

The streams of an owner read the database together every ``LOOK_EVERY_S`` seconds (``service.http.lookout``), so any
server can send them. They ask what changed since the last look; the number of queries does not depend on the number of
jobs.

In the stream of one job or bulk run, the id of an event is the version of its row. If a client reconnects with the id
of its last event (``Last-Event-ID``), it gets an event at once only if the row has changed in the meantime.

Browsers open at most six connections to a server over HTTP/1.1. A page with one stream for each job would use all six.
Therefore one stream sends all jobs and bulk runs of an owner. The id of an event is a time (database clock): a client
that reconnects with this id gets what changed after this time. Deletions are found among the rows that the stream has
sent.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import Annotated

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
from service.http.lookout import Follower, Key, Lookout, OwnerFollower, StreamKind, version
from service.http.problems import RESPONSES, Descriptions
from service.http.state import Shared
from service.views import JobView
from workers.catalogue.tables import BulkRow, JobRow

ALIVE_EVERY_S = 15.0
COME_BACK_MS = 2000
TYPE = "text/event-stream"
MOST_NAMED = 50

router = APIRouter(tags=["events"], responses=RESPONSES)
LastId = Annotated[str | None, Header(alias="Last-Event-ID", max_length=64)]
Id = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
Moment = Annotated[str | None, Header(alias="Last-Event-ID", pattern=r"^[0-9]{1,12}\.[0-9]{3}$")]
STREAM: Descriptions = {
    200: {
        "description": "Events `progress`. The data of each event is the complete job or bulk run. The last event is "
        "`end`.",
        "content": {TYPE: {}},
    },
    204: {"description": "The last event that the client received was `end`; no more events follow."},
}
STREAM_OF_OWNER: Descriptions = {
    200: {
        "description": "Events `job` and `bulk` are sent for new and changed jobs and bulk runs; the data is the "
        "complete job "
        'or bulk run. Events `gone` are sent for deleted ones; the data is {"kind": "job" or "bulk", "id": ...}. '
        "A bulk run that ended before the stream began is followed only if the request names it.",
        "content": {TYPE: {}},
    },
}


@router.get(
    "/v1/jobs/{job_id}/events",
    summary="The progress of a job as events",
    response_class=Response,
    responses=STREAM,
)
async def follow_job(
    job_id: JobId, request: Request, caller: Reading, state: Shared, last_id: LastId = None
) -> Response:
    """Send the job now and after every change, until the job ends."""
    row = await run_in_threadpool(find_job, state, caller, job_id)
    return _stream_of(row, ("job", job_id), request, state, caller, last_id)


@router.get(
    "/v1/bulk/{bulk_id}/events",
    summary="The progress of a bulk run as events",
    response_class=Response,
    responses=STREAM,
)
async def follow_bulk(
    bulk_id: BulkId, request: Request, caller: Reading, state: Shared, last_id: LastId = None
) -> Response:
    """Send the bulk run now and after every change, until the run ends. The stream of a paused run stays open."""
    row = await run_in_threadpool(find_bulk, state, caller, bulk_id)
    return _stream_of(row, ("bulk", bulk_id), request, state, caller, last_id)


def _stream_of(
    row: JobRow | BulkRow, key: Key, request: Request, state: Shared, caller: Caller, last_id: str | None
) -> Response:
    """The stream of one job or bulk run."""
    if row.ended_at is not None and version(row.changed_at) == last_id:
        return Response(status_code=204)  # the client has the last event; it tells a browser not to reconnect
    return _stream(request, state, caller, Follower(caller, {key: last_id or ""}))


def _stream(request: Request, state: Shared, caller: Caller, follower: Follower) -> Response:
    """The stream of a follower, which counts as a stream of the caller until it ends.

    The stream ends after the last text, or after ``stream_s`` seconds, but not before its first look. It also ends when
    the server stops, and when the key is revoked or expires.
    """
    state.streams.open(caller.account)
    ends_at = time.monotonic() + state.settings.stream_s
    catalogue = state.catalogue
    lookout = Lookout(
        caller.owner,
        [
            StreamKind("job", catalogue.job_changes, JobView.of),
            StreamKind("bulk", catalogue.bulk_changes, partial(BulkView.of, state=state)),
        ],
        catalogue.clock,
        partial(still_let_in, state),
    )
    lookout = state.lookouts.setdefault(caller.owner, lookout)

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
    responses=STREAM_OF_OWNER,
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
    named = [("job", one) for one in job or ()] + [("bulk", one) for one in bulk or ()]
    after = None if last_id is None else [(float(last_id), "")] * 2  # jobs and bulk runs
    return _stream(request, state, caller, OwnerFollower(caller, named, after))
