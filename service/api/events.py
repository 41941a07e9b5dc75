"""Progress as server-sent events: of one job or bulk run, ``/v1/jobs/{id}/events`` and ``/v1/bulk/{id}/events``, and of
all jobs and bulk runs of an owner, ``/v1/events``.

A stream reads the database every ``LOOK_EVERY_S`` seconds, so any server can send it.

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

import asyncio
import hashlib
import json
import logging
import math
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, Generic

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, StringConstraints
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
from workers.catalogue.followed import MOST, Followable, Followed, Place, State

log = logging.getLogger(__name__)
LOOK_EVERY_S = 0.5
ALIVE_EVERY_S = 15.0
COME_BACK_MS = 2000
TYPE = "text/event-stream"
# Rows that ended up to this number of seconds before the last look are read again: they may have been committed late,
# and the clocks of the machines that write the ends of bulk runs may differ from the clock of the database.
OVERLAP_S = 10.0
MOST_NAMED = 50
_UNKNOWN = State("", None, ())

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

# The next text of a stream, empty if nothing has changed; and whether the stream ends after it.
Said = tuple[str, bool]


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
    get = partial(state.catalogue.jobs.get, job_id)
    return await _follow(request, state, caller, get, state.catalogue.followed_jobs, JobView.of, last_id)


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
    get = partial(state.catalogue.bulks.get, bulk_id)
    view = partial(BulkView.of, state=state)
    return await _follow(request, state, caller, get, state.catalogue.followed_bulks, view, last_id)


async def _follow(
    request: Request,
    state: Shared,
    caller: Caller,
    get: Callable[[], Followable | None],
    rows: Followed[Followable],
    view: Callable[[Followable], BaseModel],
    last_id: str | None,
) -> Response:
    """The stream of one row, until the row reaches its final state or is deleted. get: None if the row was deleted."""

    def look(row: Followable) -> tuple[str, bool]:
        """The id of the event for the state of the row, and whether the row has ended."""
        now = rows.state(row)
        return hashlib.sha256(json.dumps(now.values).encode()).hexdigest()[:16], now.ended_at is not None

    row = await run_in_threadpool(get)
    if row is not None and look(row) == (last_id, True):
        return Response(status_code=204)  # 204 tells a browser not to reconnect

    def say() -> Said:
        nonlocal last_id
        row = get()
        if row is None:
            return "event: gone\ndata: {}\n\n", True
        event_id, ended = look(row)
        if event_id == last_id and not ended:
            return "", False
        name = "end" if ended else "progress"
        text = f"id: {event_id}\nevent: {name}\ndata: {view(row).model_dump_json()}\n\n"
        last_id = event_id
        return text, ended

    return _stream(request, state, caller, say)


def _stream(request: Request, state: Shared, caller: Caller, say: Callable[[], Said]) -> Response:
    """A stream of the texts of ``say``, which counts as a stream of the caller until it ends.

    The stream ends after the last text, or after ``stream_s`` seconds, but not before its first look. It also ends when
    the server stops, and when the key is revoked or expires. ``say`` is called every ``LOOK_EVERY_S`` seconds in a
    thread. If ``say`` raises SQLAlchemyError, it is called again later and must then return the same text: a failed call
    must not change the state of ``say``.
    """
    state.streams.open(caller.name)
    ends_at = time.monotonic() + state.settings.stream_s

    async def texts() -> AsyncIterator[str]:
        yield f"retry: {COME_BACK_MS}\n\n"
        said_at = time.monotonic()
        while True:
            try:
                if not await run_in_threadpool(still_let_in, state, caller):
                    return  # a client that connects again gets 401 with the reason
                text, last = await run_in_threadpool(say)
            except SQLAlchemyError as error:
                log.warning(
                    "an event stream cannot read the database; it waits and tries again: %s",
                    str(error).splitlines()[0],
                )
                text, last = "", False
            if text or time.monotonic() - said_at > ALIVE_EVERY_S:
                said_at = time.monotonic()
                # The comment keeps the connection open while nothing changes.
                yield text or ": still here\n\n"
            if last or time.monotonic() > ends_at or getattr(request.app.state, "stopping", False):
                return
            await asyncio.sleep(LOOK_EVERY_S)

    return _Stream(texts(), lambda: state.streams.close(caller.name))


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


@dataclass(frozen=True)
class News:
    """An event. named: whether the request names the job or bulk run of the event."""

    text: str
    named: bool


@dataclass(frozen=True)
class Watch(Generic[Followable]):
    """The rows of one table (jobs or bulk runs) as a stream last read them.

    kind: name of the events. named: ids that the request names; these rows are followed in any phase. place: the next
    look reads rows that ended after this place. known: for each id, the state of the row that was sent last; None if
    the last event was ``gone``. after_end: number of ended rows that the stream still follows, to report when they are
    deleted. These are the rows that ended last.
    """

    kind: str
    rows: Followed[Followable]
    view: Callable[[Followable], BaseModel]
    owner: str
    named: frozenset[str]
    place: Place
    known: dict[str, State | None] = field(default_factory=dict)
    after_end: int = 0

    def look(self) -> tuple[list[News], Watch[Followable]]:
        """The events since the last look, and the watch for the next look. This object does not change, so no event
        is lost if a look fails."""
        again_from = self.rows.now() - OVERLAP_S
        ended = self.rows.ended(self.owner, self.place)
        open_now = self.rows.open(self.owner)
        unseen = self._expected() - {one.id for one in (*ended, *open_now)}
        others = self.rows.among(self.owner, unseen)
        states = {one.id: one for one in (*others, *ended, *open_now)}
        read = self.rows.rows(
            self.owner, [one for one, state in states.items() if self.known.get(one) != state]
        )
        gone = [one for one in sorted(unseen - states.keys()) if self.known.get(one, _UNKNOWN) is not None]
        news = [*(self._changed(*read[one]) for one in states if one in read), *map(self._gone, gone)]
        known = self.known | states | {one: state for one, (state, _) in read.items()}
        known = {one: state for one, state in known.items() if one not in gone}
        kept = self.named.union((one.id for one in open_now), self._ended_last(known))
        known = {one: state for one, state in known.items() if one in kept or _ended_after(state, again_from)}
        # If a page of ended rows is full, the next look continues after it.
        place = Place(again_from) if len(ended) < MOST else Place(ended[-1].ended_at or 0.0, ended[-1].id)
        return news, replace(self, place=place, known=known | dict.fromkeys(self.named.intersection(gone)))

    def _expected(self) -> set[str]:
        """The ids of the rows that each look at the database must read again.

        They are: the rows that had not ended at the last look; the ``after_end`` rows that ended last; the rows that
        the request names.
        """
        not_ended = {one for one, state in self.known.items() if state and state.ended_at is None}
        return not_ended.union(self._ended_last(self.known), self.named)

    def _ended_last(self, known: Mapping[str, State | None]) -> list[str]:
        """The ids of the ``after_end`` rows that ended last."""
        ended = [
            (state.ended_at, one) for one, state in known.items() if state and state.ended_at is not None
        ]
        return [one for _, one in sorted(ended, reverse=True)[: self.after_end]]

    def _changed(self, state: State, row: Followable) -> News:
        return News(
            f"event: {self.kind}\ndata: {self.view(row).model_dump_json()}\n\n", state.id in self.named
        )

    def _gone(self, identity: str) -> News:
        data = Gone(kind=self.kind, id=identity).model_dump_json()
        return News(f"event: gone\ndata: {data}\n\n", identity in self.named)


def _ended_after(state: State | None, moment: float) -> bool:
    return state is not None and state.ended_at is not None and state.ended_at > moment


class Gone(BaseModel):
    """A job or bulk run that was deleted, or an id in the request that belongs to no job or bulk run of the owner."""

    kind: str
    id: str


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
    first = True

    def say() -> Said:
        nonlocal first
        looks = [watch.look() for watch in watches]
        watches[:] = [watch for _, watch in looks]
        news = sorted((one for found, _ in looks for one in found), key=lambda one: not one.named)
        text = _with_id([one.text for one in news], min(watch.place.at for watch in watches), alone=first)
        first = False
        return text, False

    return _stream(request, state, caller, say)


def _with_id(texts: Sequence[str], place: float, *, alone: bool) -> str:
    """The texts of events. Only the last text contains the id of ``place``. So a client that received only some of
    the texts asks for all of them again.

    alone: send the id even if there is no text.
    """
    said = f"id: {math.floor(place * 1000) / 1000:.3f}\n"  # rounded down, so that no ended job is left out
    if not texts:
        return f"{said}\n" if alone else ""
    return "".join(texts[:-1]) + said + texts[-1]
