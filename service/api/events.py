"""Progress as server-sent events: ``/v1/jobs/{id}/events`` and ``/v1/bulk/{id}/events``.

A stream reads the row of its job or bulk run from the database every ``LOOK_EVERY_S`` seconds, so any server can send it.
The id of an event is a hash of the row's state. If a client reconnects with the id of its last event
(``Last-Event-ID``), it gets an event at once only if the state has changed in the meantime.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter, Header, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse
from pydantic import BaseModel
from sqlalchemy.exc import SQLAlchemyError
from starlette.types import Receive, Scope, Send

from service.api.bulk import BulkId, BulkView
from service.api.bulk import find as find_bulk
from service.api.jobs import JobId
from service.api.jobs import find as find_job
from service.http.callers import Caller, Reading, still_let_in
from service.http.problems import RESPONSES
from service.http.state import Shared
from service.views import JobView
from workers.contract.bulk import BULK_ENDED, BulkPhase
from workers.contract.phases import Phase

log = logging.getLogger(__name__)
LOOK_EVERY_S = 0.5
ALIVE_EVERY_S = 15.0
COME_BACK_MS = 2000
TYPE = "text/event-stream"

router = APIRouter(tags=["events"], responses=RESPONSES)
LastId = Annotated[str | None, Header(alias="Last-Event-ID", max_length=64)]
DESCRIBED: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Events `progress`. The data of each event is the complete job or bulk run. The last event is `end`.",
        "content": {TYPE: {}},
    },
    204: {"description": "The last event that the client received was `end`; no more events follow."},
}


@dataclass(frozen=True)
class Seen:
    """The state of a row: the id of its event, its view, and whether it is the final state."""

    id: str
    view: Callable[[], BaseModel]
    ended: bool


Look = Callable[[], Seen | None]  # None: the row was deleted


@dataclass(frozen=True)
class Said:
    """The next text of a stream; empty if nothing has changed. last: the stream ends after this text."""

    text: str
    last: bool = False


Say = Callable[[], Said]


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
    await run_in_threadpool(find_job, state, caller, job_id)

    def look() -> Seen | None:
        row = state.catalogue.jobs.get(job_id)
        if row is None:
            return None
        said = (row.phase, row.attempt, row.stage, row.step, row.steps, row.cancel_requested, row.queue)
        return Seen(_id(*said), lambda: JobView.of(row), Phase(row.phase).ended)

    return await _follow(request, state, caller, look, last_id)


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
    await run_in_threadpool(find_bulk, state, caller, bulk_id)

    def look() -> Seen | None:
        row = state.catalogue.bulks.get(bulk_id)
        if row is None:
            return None
        said = (row.phase, row.total, row.done, row.failed)
        return Seen(_id(*said), lambda: BulkView.of(row, state), BulkPhase(row.phase) in BULK_ENDED)

    return await _follow(request, state, caller, look, last_id)


async def _follow(
    request: Request, state: Shared, caller: Caller, look: Look, last_id: str | None
) -> Response:
    """The stream of one row, until the row reaches its final state or is deleted."""
    now = await run_in_threadpool(look)
    if now is not None and now.ended and now.id == last_id:
        return Response(status_code=204)  # 204 tells a browser not to reconnect

    def say() -> Said:
        nonlocal last_id
        now = look()
        text = _event(now, last_id)
        last_id = last_id if now is None else now.id
        return Said(text, now is None or now.ended)

    return stream(request, state, caller, say)


def stream(request: Request, state: Shared, caller: Caller, say: Say) -> Response:
    """A stream of the texts of ``say``, which counts as a stream of the caller until it ends.

    The stream ends after a text with ``last``, or after ``stream_s`` seconds. The stream also ends when the server
    stops, and when the key is revoked or expires. ``say`` is called every ``LOOK_EVERY_S`` seconds in a thread. If
    ``say`` raises SQLAlchemyError, it is called again later and must then return the same text: a failed call must
    not change the state of ``say``.
    """
    state.streams.open(caller.name)
    ends_at = time.monotonic() + state.settings.stream_s

    def over() -> bool:
        return time.monotonic() > ends_at or getattr(request.app.state, "stopping", False)

    def may_read() -> bool:
        return still_let_in(state, caller)

    return _Stream(_texts(say, may_read, over), lambda: state.streams.close(caller.name))


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


async def _texts(say: Say, may_read: Callable[[], bool], over: Callable[[], bool]) -> AsyncIterator[str]:
    """The texts of a stream, with comments that keep the connection open while nothing changes.

    The stream also ends when the key or the session of the caller ends.
    """
    yield f"retry: {COME_BACK_MS}\n\n"
    said_at = time.monotonic()
    while not over():
        try:
            if not await run_in_threadpool(may_read):
                return  # a client that connects again gets 401 with the reason
            said = await run_in_threadpool(say)
        except SQLAlchemyError as error:
            log.warning(
                "an event stream cannot read the database; it waits and tries again: %s",
                str(error).splitlines()[0],
            )
            said = Said("")
        if said.text or time.monotonic() - said_at > ALIVE_EVERY_S:
            said_at = time.monotonic()
            yield said.text or ": still here\n\n"
        if said.last:
            return
        await asyncio.sleep(LOOK_EVERY_S)


def _event(now: Seen | None, last_id: str | None) -> str:
    """The text of the event for a state; empty if the client already has this event."""
    if now is None:
        return "event: gone\ndata: {}\n\n"
    if now.id == last_id and not now.ended:
        return ""
    name = "end" if now.ended else "progress"
    return f"id: {now.id}\nevent: {name}\ndata: {now.view().model_dump_json()}\n\n"


def _id(*said: object) -> str:
    return hashlib.sha256(json.dumps(said).encode()).hexdigest()[:16]
