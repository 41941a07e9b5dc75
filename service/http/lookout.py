"""One look at the database for all streams of events of an owner, every ``LOOK_EVERY_S`` seconds.

Each stream is a follower. Its first look is its own: it brings what the client does not know yet. From then on the lookout of
the owner looks for all followers together. First looks and common ones come one after the other, so no change falls between
them: what a first look did not see, the next common look tells.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextvars import Context
from dataclasses import dataclass, field, replace
from typing import Any, Generic

from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel
from sqlalchemy.exc import SQLAlchemyError

from workers.catalogue.followed import MOST, Followable, Followed, Place, State

log = logging.getLogger(__name__)
LOOK_EVERY_S = 0.5
# Rows that ended up to this number of seconds before the last look are read again: they may have been committed late,
# and the clocks of the machines that write the ends of bulk runs may differ from the clock of the database.
OVERLAP_S = 10.0
# Texts that wait for a client. A stream whose client is slower ends, and the client connects again.
MOST_UNREAD = 16
_UNKNOWN = State("", None, ())

# The next text of a stream, empty if nothing has changed; and whether the stream ends after it.
Said = tuple[str, bool]


@dataclass(frozen=True)
class News:
    """An event. named: whether the request names the job or bulk run of the event."""

    text: str
    named: bool


@dataclass(frozen=True)
class Watch(Generic[Followable]):
    """The rows of one table (jobs or bulk runs) as streams last read them.

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

    def with_named(self, other: Watch[Followable]) -> Watch[Followable]:
        """This watch, which also knows what another one last sent of its named rows, if they ended before this watch looked."""
        ended = {
            one: other.known[one]
            for one in other.named & other.known.keys()
            if (state := other.known[one]) is None or (state.ended_at and state.ended_at <= self.place.at)
        }
        return replace(self, known=ended | self.known)

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


class Follower:
    """A stream of events, as the lookout of its owner sees it. said: the texts that the client has not got yet.

    caller: whose key must stay valid. joined: whether the first looks have ended, so that the lookout looks for this follower
    too. begun: whether one was tried.
    """

    def __init__(self, caller: Hashable) -> None:
        self.caller, self.begun, self.joined = caller, False, False
        self.said: asyncio.Queue[Said] = asyncio.Queue(MOST_UNREAD)

    def first(self, lookout: Lookout) -> Said:
        """A look of this follower alone; the last one sets ``joined``."""
        raise NotImplementedError

    def tell(self, said: Said) -> None:
        """Pass a text to the stream, or its end if the client is too slow. A look without news only wakes the stream."""
        if self.said.full():
            while not self.said.empty():
                self.said.get_nowait()
            said = ("", True)
        if said != ("", False) or self.said.empty():
            self.said.put_nowait(said)


class RowFollower(Follower, Generic[Followable]):
    """Follows one row, until the row reaches its final state or is deleted. last_id: the id of the last event."""

    def __init__(
        self,
        caller: Hashable,
        rows: Followed[Followable],
        identity: str,
        view: Callable[[Followable], BaseModel],
        last_id: str | None,
    ) -> None:
        super().__init__(caller)
        self.rows, self.identity, self._view, self._last_id = rows, identity, view, last_id

    def first(self, lookout: Lookout) -> Said:
        """The row as it is now."""
        said = self.say(self.rows.named([self.identity]).get(self.identity))
        self.joined = True
        return said

    def knows_end(self, row: Followable | None) -> bool:
        """Whether the client already has the last event."""
        return row is not None and self._event(row) == (self._last_id, True)

    def say(self, row: Followable | None) -> Said:
        """The event for the row, or nothing if its state is that of the last event. None: the row was deleted."""
        if row is None:
            return "event: gone\ndata: {}\n\n", True
        event_id, ended = self._event(row)
        if event_id == self._last_id and not ended:
            return "", False
        name = "end" if ended else "progress"
        text = f"id: {event_id}\nevent: {name}\ndata: {self._view(row).model_dump_json()}\n\n"
        self._last_id = event_id
        return text, ended

    def _event(self, row: Followable) -> tuple[str, bool]:
        """The id of the event for the state of the row, and whether the row has ended."""
        now = self.rows.state(row)
        return hashlib.sha256(json.dumps(now.values).encode()).hexdigest()[:16], now.ended_at is not None


class OwnerFollower(Follower):
    """Follows all jobs and bulk runs of its owner. watches: those of its first looks."""

    def __init__(self, caller: Hashable, watches: Sequence[Watch[Any]]) -> None:
        super().__init__(caller)
        self.watches, self._alone = list(watches), True

    def first(self, lookout: Lookout) -> Said:
        """The next page of what the client missed. After the last page the lookout watches for this follower."""
        text, self.watches = looked(self.watches, alone=self._alone)
        self._alone = False
        if not any(watch.place.id for watch in self.watches):  # no page was full
            lookout.share(self.watches)
            self.joined = True
        return text, False


def looked(watches: Sequence[Watch[Any]], *, alone: bool = False) -> tuple[str, list[Watch[Any]]]:
    """The text of a look, and the watches for the next one. alone: as for ``_with_id``."""
    looks = [watch.look() for watch in watches]
    news = sorted((one for told, _ in looks for one in told), key=lambda one: not one.named)
    after = [watch for _, watch in looks]
    return _with_id([one.text for one in news], min(watch.place.at for watch in after), alone=alone), after


def _with_id(texts: Sequence[str], place: float, *, alone: bool) -> str:
    """The texts of events. Only the last text contains the id of ``place``. So a client that received only some of
    the texts asks for all of them again.

    alone: send the id even if there is no text.
    """
    said = f"id: {math.floor(place * 1000) / 1000:.3f}\n"  # rounded down, so that no ended job is left out
    if not texts:
        return f"{said}\n" if alone else ""
    return "".join(texts[:-1]) + said + texts[-1]


class Lookout:
    """Looks at the database for all followers of an owner. let_in: whether the key of a caller is still valid."""

    def __init__(self, let_in: Callable[[Any], bool]) -> None:
        self._let_in = let_in
        self._followers: list[Follower] = []
        self._watches: list[Watch[Any]] = []  # of all that follow the whole owner
        self._lock = asyncio.Lock()
        self._task: asyncio.Task[None] | None = None

    async def next(self, follower: Follower) -> Said:
        """The next text for a follower. Until the follower has joined, this is a look of its own."""
        if follower.joined:
            return await follower.said.get()
        if follower.begun:
            await asyncio.sleep(LOOK_EVERY_S)
        follower.begun = True
        async with self._lock:
            try:
                said = await run_in_threadpool(follower.first, self)
            except SQLAlchemyError as error:
                _away(error)
                said = ("", False)
            if follower.joined:
                self._followers.append(follower)
        if self._followers and (self._task is None or self._task.done()):
            # The records of its log belong to no request.
            self._task = asyncio.create_task(self._look_again(), context=Context())
        return said

    def leave(self, follower: Follower) -> None:
        """Look no more for a follower."""
        if follower in self._followers:
            self._followers.remove(follower)

    def share(self, watches: Sequence[Watch[Any]]) -> None:
        """Go on with the watches of a follower that joins. The followers before it are told what they do not know yet."""
        if _of_owner(self._followers):
            watches = [old.with_named(new) for old, new in zip(self._watches, watches, strict=True)]
        self._watches = list(watches)

    async def _look_again(self) -> None:
        """Look as long as there are followers. If a look fails by a fault of the service, their streams end."""
        try:
            while self._followers:
                await asyncio.sleep(LOOK_EVERY_S)
                async with self._lock:
                    for follower, said in await run_in_threadpool(self._look):
                        follower.tell(said)
        finally:
            for follower in self._followers:
                follower.tell(("", True))

    def _look(self) -> list[tuple[Follower, Said]]:
        """What each follower is told. A failed look changes nothing, so the next one tells what it missed."""
        followers = list(self._followers)
        try:
            let_in = set(filter(self._let_in, {one.caller for one in followers}))
            staying = [one for one in followers if one.caller in let_in]
            rows = _rows_of(staying)
            news = self._news(_of_owner(staying))
        except SQLAlchemyError as error:
            _away(error)
            return [(one, ("", False)) for one in followers]
        # A client that connects again after its key ended gets 401 with the reason.
        ended: list[tuple[Follower, Said]] = [(one, ("", True)) for one in followers if one not in staying]
        return ended + [
            (one, _said(one, rows) if isinstance(one, RowFollower) else (news, False)) for one in staying
        ]

    def _news(self, followers: Sequence[OwnerFollower]) -> str:
        """The text for all that follow the whole owner."""
        if not followers:
            return ""
        named = [
            frozenset[str]().union(*(watch.named for watch in each))
            for each in zip(*(one.watches for one in followers), strict=True)
        ]
        watches = [replace(watch, named=ids) for watch, ids in zip(self._watches, named, strict=True)]
        text, self._watches = looked(watches)
        return text


def _rows_of(followers: Sequence[Follower]) -> dict[str, Any]:
    """The rows that are followed one by one, by their ids."""
    ids: dict[Followed[Any], set[str]] = {}
    for one in followers:
        if isinstance(one, RowFollower):
            ids.setdefault(one.rows, set()).add(one.identity)
    return {name: row for table, names in ids.items() for name, row in table.named(names).items()}


def _said(follower: RowFollower[Any], rows: Mapping[str, Any]) -> Said:
    try:
        return follower.say(rows.get(follower.identity))
    except SQLAlchemyError as error:  # the view of a bulk run reads more
        _away(error)
        return "", False


def _of_owner(followers: Sequence[Follower]) -> list[OwnerFollower]:
    return [one for one in followers if isinstance(one, OwnerFollower)]


def _away(error: SQLAlchemyError) -> None:
    log.warning(
        "event streams cannot read the database; they wait and try again: %s", str(error).splitlines()[0]
    )
