"""The gate in front of work that takes long for some requests: decodings, inspections, cut-outs, headers, calls of the
store.

The work runs in threads of the gate. Those of the pool, in which all other requests are answered, stay free.

Each owner has a queue. A place goes to the owner who holds the fewest places; of several, to the one whose work has
taken the least time while all of them were here. The time is measured, because what a file declares says little: 65,536
tiles in 1.5 kB take 15 s. An owner gets a second place only if no other owner waits and one place stays free, so that
the first request of another owner never waits for the end of a long one.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

import anyio
import anyio.to_thread

P = ParamSpec("P")
T = TypeVar("T")
Endpoint = TypeVar("Endpoint", bound=Callable[..., object])


@dataclass
class _Queue:
    """The requests of an owner.

    Attributes
    ----------
    taken_s
        The time that the owner's work has taken, s, without the time of the places that the owner holds now.
    """

    taken_s: float
    waiting: deque[anyio.Event] = field(default_factory=deque)
    since: list[float] = field(default_factory=list)  # when each held place was given

    def used_s(self, now: float) -> float:
        return self.taken_s + sum(now - start for start in self.since)


class Gate:
    """Gives places to the work of owners in turn. The function ``now`` is a clock, s."""

    def __init__(self, places: int, now: Callable[[], float] = time.monotonic) -> None:
        """Let ``places`` works run at the same time, at least 2."""
        self._free, self._now = places, now
        self._queues: dict[str, _Queue] = {}
        self._threads = anyio.CapacityLimiter(places)

    async def run(self, owner: str, work: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """What ``work`` returns, called in a thread as soon as it is the owner's turn."""
        queue = self._queues.get(owner)
        if queue is None:
            # Nobody is first for ever because of a time in which the others were not here, and nobody last.
            now = self._now()
            queue = _Queue(min((one.used_s(now) for one in self._queues.values()), default=0.0))
            self._queues[owner] = queue
        turn = anyio.Event()
        queue.waiting.append(turn)
        self._give()
        try:
            await turn.wait()
            return await anyio.to_thread.run_sync(partial(work, *args, **options), limiter=self._threads)
        finally:
            if turn.is_set():
                start = queue.since.pop(0)  # which of the owner's places ends does not matter for the sum
                queue.taken_s += self._now() - start
                self._free += 1
            else:  # cancelled
                queue.waiting.remove(turn)
            if not queue.waiting and not queue.since:
                del self._queues[owner]
            self._give()

    def _give(self) -> None:
        """Give the free places to those whose turn it is."""
        now = self._now()
        while self._free:
            waiting = [one for one in self._queues.values() if one.waiting]
            alone = len(waiting) == 1 and self._free > 1
            may = [one for one in waiting if alone or not one.since]
            if not may:
                return
            queue = min(may, key=lambda one: (len(one.since), one.used_s(now)))
            queue.since.append(now)
            self._free -= 1
            queue.waiting.popleft().set()


def in_turn(register: Callable[[Callable[..., object]], object]) -> Callable[[Endpoint], Endpoint]:
    """Register an endpoint that calls the store, such as ``@in_turn(router.get("/{psf_id}"))``: it runs behind the gate
    ``stored``.

    The endpoint has the parameters ``caller`` and ``state``. Other functions can still call it.
    """

    def decorate(endpoint: Endpoint) -> Endpoint:
        @wraps(endpoint)
        async def run(**given: Any) -> object:
            return await given["state"].stored.run(given["caller"].owner, endpoint, **given)

        register(run)
        return endpoint

    return decorate
