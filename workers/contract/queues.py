"""The queues that jobs wait in, and the order that workers take from them in: what a person waits for goes first."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum


class Queue(StrEnum):
    """Where a job waits, the most urgent first."""

    INTERACTIVE = "interactive"
    CROSSVAL = "crossval"
    BULK = "bulk"


def queue_of(kind: str) -> Queue:
    """Where a job of this kind waits, unless it is said otherwise: a cross-validation takes long, and goes after the quick."""
    return {"cross-validate": Queue.CROSSVAL, "bulk": Queue.BULK}.get(kind, Queue.INTERACTIVE)


def queues_named(names: str) -> tuple[Queue, ...]:
    """The queues in a text such as ``interactive,bulk``, most urgent first; ``ValueError`` says which there are."""
    wanted = {name.strip() for name in names.split(",") if name.strip()}
    if not wanted or wanted - set(Queue):
        raise ValueError(f"expected queues of {', '.join(Queue)}, separated by commas; got {names!r}")
    return tuple(queue for queue in Queue if queue in wanted)


def by_urgency(names: Iterable[str]) -> list[str]:
    """Names of the broker's queues in our order; those that are not ours, as of control, come first."""
    order = {broker_name(queue): place for place, queue in enumerate(Queue)}
    return sorted(names, key=lambda name: order.get(name, -1))


def broker_name(queue: Queue | str) -> str:
    """What the queue is called in the broker, which others may use too."""
    return f"heliopsf.{queue}"
