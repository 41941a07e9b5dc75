"""Phases of a job, the error with which a job fails, and the queues in which jobs wait.

The order of the queues is the order in which workers take jobs from them.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

from pydantic import BaseModel

from psfcore.errors import DataError

PREFIX = "heliopsf."  # separates our queues in the broker from those of other programs


class Phase(StrEnum):
    """Phases of a job, by their IVOA UWS names.

    A job submitted to ``/v1/jobs`` starts QUEUED. A job created by a UWS client starts PENDING: its parameters can
    be changed until the client starts it.
    """

    PENDING = "PENDING"
    QUEUED = "QUEUED"
    EXECUTING = "EXECUTING"
    COMPLETED = "COMPLETED"
    ERROR = "ERROR"
    ABORTED = "ABORTED"

    @property
    def ended(self) -> bool:
        """True for the final phases: COMPLETED, ERROR and ABORTED."""
        return self in ENDED


ENDED = frozenset({Phase.COMPLETED, Phase.ERROR, Phase.ABORTED})
# An identical request gets the existing job while that job is in one of these phases.
LIVE = frozenset({Phase.QUEUED, Phase.EXECUTING, Phase.COMPLETED})


class Fault(StrEnum):
    """The cause of an error: the user's data or request, a temporary failure, or the software itself."""

    USER = "user"
    TRANSIENT = "transient"
    INTERNAL = "internal"


class JobError(BaseModel):
    """Why a job failed."""

    fault: Fault
    code: str
    message: str

    @classmethod
    def of(cls, error: DataError) -> JobError:
        """The error of a job whose request or data is wrong."""
        return cls(fault=Fault.USER, code=error.code, message=error.message)


class Queue(StrEnum):
    """Queues of jobs, highest priority first."""

    INTERACTIVE = "interactive"
    CROSSVAL = "crossval"
    BULK = "bulk"


def queues_named(names: str) -> tuple[Queue, ...]:
    """The queues in a text such as ``interactive,bulk``, highest priority first; ValueError if the text names an
    unknown queue.
    """
    wanted = {name.strip() for name in names.split(",") if name.strip()}
    if not wanted or wanted - set(Queue):
        raise ValueError(f"expected queues of {', '.join(Queue)}, separated by commas; got {names!r}")
    return tuple(queue for queue in Queue if queue in wanted)


def by_urgency(names: Iterable[str]) -> list[str]:
    """Sort names of the broker's queues, highest priority first; Celery's own control queues come before all others."""
    order = {broker_name(queue): place for place, queue in enumerate(Queue)}
    return sorted(names, key=lambda name: order.get(name, -1))


def broker_name(queue: Queue | str) -> str:
    """The queue's name in the broker."""
    return f"{PREFIX}{queue}"


def queue_of_broker(name: str) -> Queue:
    """The queue that has this name in the broker. Raises ValueError if no queue has this name."""
    return Queue(name.removeprefix(PREFIX))
