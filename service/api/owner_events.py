"""All jobs and bulk runs of an owner in one stream of server-sent events: ``/v1/events``.

Browsers open at most six connections to a server over HTTP/1.1. A page with one stream for each job would use them up.

The database is read every ``LOOK_EVERY_S`` seconds, with the same few queries however many jobs there are. A stream
remembers the last state of each job that has not ended, and sends those whose state is another one. A job that is no longer
among them has ended or was deleted: it is read by its id, so no clock decides about it. A job that the stream has not seen
before it ended is found by the time of its end. Bulk runs can be deleted after their end:
the stream also reads by their ids the ended ones that it has sent, and tells when they are gone. The id of an event is the
time (database clock) from which a reconnected client needs the ends of jobs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Generic

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, StringConstraints

from service.api.bulk import BulkView
from service.api.events import TYPE, Said, stream
from service.api.jobs import JobView
from service.http.callers import Reading
from service.http.problems import RESPONSES
from service.http.state import Shared
from workers.catalogue.followed.rows import MOST, Followable, Followed, Place, State

# Rows that ended up to this long before the last look are read again: they may have been committed late, and the machines
# that write the ends of bulk runs may have other clocks than the database.
OVERLAP_S = 10.0
MOST_NAMED = 50
_UNKNOWN = State("", None, ())

router = APIRouter(tags=["events"], responses=RESPONSES)
Id = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
Moment = Annotated[str | None, Header(alias="Last-Event-ID", pattern=r"^[0-9]{1,12}\.[0-9]{3}$")]
DESCRIBED: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Events `job` and `bulk`: the data is the complete job or bulk run, which is new or has changed. Events "
        '`gone`: the data is {"kind": "job" or "bulk", "id": ...} of one that was deleted. A bulk run that ended before the stream '
        "began is followed only if the request names it.",
        "content": {TYPE: {}},
    },
}


@dataclass(frozen=True)
class News:
    """An event. named: it is about a job or bulk run that the request names."""

    text: str
    named: bool


@dataclass(frozen=True)
class Watch(Generic[Followable]):
    """What a stream knows of the rows of one table: of the jobs, or of the bulk runs.

    kind: name of the events. named: ids that are followed in any phase. place: rows that ended after it are still to be read.
    known: the state that was sent last, by id; None if it was sent that the row is gone. after_end: so many of the rows that
    were sent and have ended are followed until they are deleted, those that ended last.
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
        """The news since the last look, and what is known then. This watch does not change, so a failed look loses nothing."""
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
        """Ids of rows whose state must be known after each look: those that had not ended, ``after_end`` of those that had, and
        those that the request names."""
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
    """A job or bulk run that was deleted, or that the request names and the owner does not have."""

    kind: str
    id: str


@router.get(
    "/v1/events",
    summary="The progress of all your jobs and bulk runs as events",
    response_class=Response,
    responses=DESCRIBED,
)
async def follow_all(
    request: Request,
    caller: Reading,
    state: Shared,
    job: Annotated[
        list[Id] | None,
        Query(max_length=MOST_NAMED, description="ids of jobs to send first, in whatever phase they are"),
    ] = None,
    bulk: Annotated[
        list[Id] | None,
        Query(
            max_length=MOST_NAMED, description="ids of bulk runs to send first, in whatever phase they are"
        ),
    ] = None,
    last_id: Moment = None,
) -> Response:
    """Send each job and bulk run that has not ended, and those that ended in the last seconds; then every one that changes.

    A client that reconnects with `Last-Event-ID` also gets those that ended since; it may get one again that it has. Of an owner
    with very many waiting jobs, the newest are sent; the others when they start. The jobs in which workers process the
    images of bulk runs are not sent.
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
            lambda row: BulkView.of(row, state),
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
        return Said(text)

    return stream(request, state, caller, say)


def _with_id(texts: Sequence[str], place: float, *, alone: bool) -> str:
    """The texts with the id of a place in the last one: a client that gets only some of them asks for all of them again.

    alone: send the id also if there is no text.
    """
    said = f"id: {math.floor(place * 1000) / 1000:.3f}\n"  # rounded up, it could leave out an end
    if not texts:
        return f"{said}\n" if alone else ""
    return "".join(texts[:-1]) + said + texts[-1]
