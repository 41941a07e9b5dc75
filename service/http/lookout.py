"""One look at the database for all streams of events of an owner, every ``LOOK_EVERY_S`` seconds.

Each stream is a follower, which remembers the last version of each job and bulk run that it sent to its client. A new
follower first looks at the database alone, for all that its client does not know yet. From then on, the lookout of the
owner looks for all followers together. A first look and a common look never run at the same time, so no change is lost
between them: the next common look reports what the first look did not see.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from contextvars import Context
from dataclasses import dataclass
from typing import Any, Generic

from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel
from sqlalchemy.exc import SQLAlchemyError

from workers.catalogue.changes import MOST, Changes, Moment, Row

log = logging.getLogger(__name__)
LOOK_EVERY_S = 0.5
# Rows that changed up to this number of seconds before the last look are read again: they may have been committed late.
OVERLAP_S = 10.0
# Texts that wait for a client. A stream whose client is slower ends, and the client connects again.
MOST_UNREAD = 16
# Jobs and bulk runs whose deletion a stream reports: those that changed last, and those that the request names.
MOST_KNOWN = 300

# The next text of a stream, empty if nothing has changed; and whether the stream ends after it.
Said = tuple[str, bool]
Key = tuple[str, str]  # kind and id of a job or bulk run


@dataclass(frozen=True)
class StreamKind(Generic[Row]):
    """What events report: jobs or bulk runs.

    Attributes
    ----------
    name
        The name of the events.
    view
        Function that makes the description of a row.
    """

    name: str
    changes: Changes[Row]
    view: Callable[[Row], BaseModel]


@dataclass(frozen=True)
class State:
    """A job or bulk run as it is now.

    Attributes
    ----------
    data
        The description of the job or bulk run, as JSON.
    """

    version: str
    ended: bool
    data: str


def version(changed_at: float) -> str:
    """The version of a row that changed at this time."""
    return repr(changed_at)


@dataclass(frozen=True)
class Sight:
    """The result of a look.

    Attributes
    ----------
    after
        For each kind, the row after which the next look continues.
    changed
        The jobs and bulk runs whose changes the streams of the whole owner report.
    versions
        The versions of the jobs and bulk runs that changed or that a follower knows, if they exist.
    states
        The states of the jobs and bulk runs whose present version a follower does not know.
    """

    after: Sequence[Moment]
    changed: Collection[Key]
    versions: Mapping[Key, str]
    states: Mapping[Key, State]


class Follower:
    """A stream of the events of one job or bulk run, until it reaches its final state or is deleted, as the lookout of
    its owner sees it.

    Attributes
    ----------
    caller
        The caller whose key must stay valid.
    known
        The versions that the client knows; "": it knows none yet; None: it knows that the job or bulk run was deleted.
    whole
        Whether the stream follows all jobs and bulk runs of the owner, or only those in ``known``.
    after
        For each kind, the row after which the next look continues, as in ``Sight``; None: the next look reads the
        changes of the last seconds.
    begun
        Whether the follower has looked at the database.
    joined
        Whether the follower's own looks have ended, so that the lookout looks for it too.
    said
        The texts that the client has not got yet.
    """

    whole = False

    def __init__(
        self, caller: Hashable, known: Mapping[Key, str | None], after: Sequence[Moment] | None = None
    ) -> None:
        self.caller, self.known, self.after = caller, dict(known), after
        self.begun = self.joined = False
        self.said: asyncio.Queue[Said] = asyncio.Queue(MOST_UNREAD)

    def news(self, versions: Mapping[Key, str], changed: Iterable[Key]) -> list[Key]:
        """What the client does not know, of what this stream follows."""
        followed = dict.fromkeys([*changed, *self.known] if self.whole else self.known)
        return [key for key in followed if versions.get(key) != self.known.get(key)]

    def say(self, sight: Sight) -> Said:
        """The events for what the client does not know; afterwards the client knows it. The id of an event is a
        version.
        """
        for key in self.news(sight.versions, ()):
            state = sight.states.get(key)
            if state is None:
                return "event: gone\ndata: {}\n\n", True
            self.known[key] = state.version
            name = "end" if state.ended else "progress"
            return f"id: {state.version}\nevent: {name}\ndata: {state.data}\n\n", state.ended
        return "", False

    def tell(self, said: Said) -> None:
        """Pass a text to the stream, or its end if the client is too slow. A look without news only wakes the
        stream.
        """
        if self.said.full():
            while not self.said.empty():
                self.said.get_nowait()
            said = ("", True)
        if said != ("", False) or self.said.empty():
            self.said.put_nowait(said)


class OwnerFollower(Follower):
    """A stream of the events of all jobs and bulk runs of an owner.

    Attributes
    ----------
    named
        The jobs and bulk runs that the request names.
    """

    whole = True

    def __init__(self, caller: Hashable, named: Collection[Key], after: Sequence[Moment] | None) -> None:
        super().__init__(caller, dict.fromkeys(named, ""), after)
        self.named = frozenset(named)

    def say(self, sight: Sight) -> Said:
        """The events, those for the named first.

        Only the last event has an id: a time before which the client knows all changes. So a client that received only
        some of the events asks for all of them again. The first look sends the id also without an event.
        """
        news = sorted(self.news(sight.versions, sight.changed), key=lambda key: key not in self.named)
        events = [
            self._event(key, sight.states.get(key))
            for key in news
            if key in sight.states or key in self.known
        ]
        at = min(at for at, _ in sight.after)
        said = f"id: {math.floor(at * 1000) / 1000:.3f}\n"  # rounded down, so that no change is left out
        if not events:
            return "" if self.begun else f"{said}\n", False
        # What the next looks read again is not forgotten, otherwise it would be told again.
        old = [key for key, told in self.known.items() if told and float(told) <= at]
        for key in [one for one in old if one not in self.named][:-MOST_KNOWN]:
            del self.known[key]
        return "".join(events[:-1]) + said + events[-1], False

    def _event(self, key: Key, state: State | None) -> str:
        kind, identity = key
        self.known.pop(key, None)  # what was told last comes last
        if state is not None or key in self.named:
            self.known[key] = None if state is None else state.version
        if state is None:
            return f'event: gone\ndata: {{"kind":"{kind}","id":"{identity}"}}\n\n'
        return f"event: {kind}\ndata: {state.data}\n\n"


class Lookout:
    """Looks at the database for all followers of an owner."""

    def __init__(
        self,
        owner: str,
        kinds: Sequence[StreamKind[Any]],
        clock: Callable[[], float],
        let_in: Callable[[Hashable], bool],
    ) -> None:
        """Begin without followers.

        Parameters
        ----------
        clock
            Function that returns the time of the database, s since 1970.
        let_in
            Function that says whether the key of a caller is still valid.
        """
        self._owner, self._kinds, self._clock, self._let_in = owner, kinds, clock, let_in
        self._followers: list[Follower] = []
        self._after: Sequence[Moment] | None = None
        self._lock = asyncio.Lock()
        self._task: asyncio.Task[None] | None = None

    async def next(self, follower: Follower) -> Said:
        """The next text for a follower. Until the follower has joined, this is a look of its own."""
        if follower.joined:
            return await follower.said.get()
        async with self._lock:
            try:
                said = await run_in_threadpool(self.look_for, follower)
            except SQLAlchemyError as error:
                _away(error)
                said = ("", False)
            if follower.joined:
                self._followers.append(follower)
        if not follower.joined:
            await asyncio.sleep(LOOK_EVERY_S)
        if self._followers and (self._task is None or self._task.done()):
            # The records of its log belong to no request.
            self._task = asyncio.create_task(self._look_again(), context=Context())
        return said

    def leave(self, follower: Follower) -> None:
        """Look no more for a follower."""
        if follower in self._followers:
            self._followers.remove(follower)

    def look_for(self, follower: Follower) -> Said:
        """Tell a follower the next page of what its client missed. After the last page the follower joins."""
        sight = self._look([follower], follower.after)
        said = follower.say(sight)
        follower.after, follower.begun = sight.after, True
        follower.joined = not any(last for _, last in sight.after)  # no page was full
        if follower.joined and not self._followers:
            self._after = sight.after
        return said

    async def _look_again(self) -> None:
        """Look as long as there are followers. If a look fails by a fault of the service, their streams end."""
        try:
            while self._followers:
                await asyncio.sleep(LOOK_EVERY_S)
                async with self._lock:
                    for follower, said in await run_in_threadpool(self._look_for_all):
                        follower.tell(said)
        finally:
            for follower in self._followers:
                follower.tell(("", True))

    def _look_for_all(self) -> list[tuple[Follower, Said]]:
        """What each follower is told. A failed look changes nothing, so the next one tells what it missed."""
        followers = list(self._followers)
        try:
            let_in = set(filter(self._let_in, {one.caller for one in followers}))
            staying = [one for one in followers if one.caller in let_in]
            sight = self._look(staying, self._after)
        except SQLAlchemyError as error:
            _away(error)
            return [(one, ("", False)) for one in followers]
        self._after = sight.after
        # A client that connects again after its key ended gets 401 with the reason.
        return [(one, one.say(sight) if one in staying else ("", True)) for one in followers]

    def _look(self, followers: Sequence[Follower], after: Sequence[Moment] | None) -> Sight:
        """What has changed, of all that the followers follow."""
        again_from = (self._clock() - OVERLAP_S, "")
        after = after or [again_from] * len(self._kinds)
        begin = any(one.whole and not one.begun for one in followers)
        known = {key for one in followers for key in one.known}
        pages: list[Moment] = []
        changed: dict[Key, str] = {}
        others: dict[Key, str] = {}
        for kind, last in zip(self._kinds, after, strict=True):
            page = kind.changes.since(self._owner, last)
            pages.append(page[-1] if len(page) == MOST else again_from)
            found = [*page, *(kind.changes.open(self._owner) if begin else ())]
            changed |= {(kind.name, one): version(at) for at, one in found}
            rest = _ids(known, kind.name).difference(one for _, one in found)
            others |= {(kind.name, one): version(at) for at, one in kind.changes.among(self._owner, rest)}
        versions = changed | others
        unknown = {key for one in followers for key in one.news(versions, changed)}
        states = {
            (kind.name, row.id): State(
                version(row.changed_at), row.ended_at is not None, kind.view(row).model_dump_json()
            )
            for kind in self._kinds
            for row in kind.changes.rows(_ids(unknown & versions.keys(), kind.name))
        }
        return Sight(pages, changed, versions, states)


def _ids(keys: Iterable[Key], kind: str) -> set[str]:
    return {identity for name, identity in keys if name == kind}


def _away(error: SQLAlchemyError) -> None:
    log.warning(
        "event streams cannot read the database; they wait and try again: %s", str(error).splitlines()[0]
    )
