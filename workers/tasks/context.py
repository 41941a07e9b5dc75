"""What a task may use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from psfcore.fits.header import FitsLimits
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.stage_times import StageTimes
from workers.contract.phases import JobError
from workers.files.store import Store
from workers.settings import Settings


class TurnOver(Exception):
    """The job lets others go first: it is queued again as if it had not been started."""


def _not_alone(_work: Callable[[], None]) -> JobError | None:
    raise NotImplementedError("only the task runner makes a job's error of an exception")


@dataclass(frozen=True)
class Context:
    """Where things are, and how to say how far the work is; ``report`` raises where it should stop.

    ``call_for_help(n)`` asks up to n idle workers to share the job's parts. For jobs that are many pieces of work:
    ``guarded(work)`` does one and returns what it died of, ``others_wait()`` says whether to end with ``TurnOver``,
    and ``lease`` is what the pieces are taken under. ``times`` counts the stages that are reported; a job whose pieces
    have stages of their own, which are not the job's, counts those there.
    """

    catalogue: Catalogue
    store: Store
    settings: Settings
    owner: str
    job_id: str
    report: Callable[[str, int, int], None]
    call_for_help: Callable[[int], None] = lambda workers: None
    guarded: Callable[[Callable[[], None]], JobError | None] = _not_alone
    others_wait: Callable[[], bool] = lambda: False
    lease: Lease | None = None
    times: StageTimes = field(default_factory=StageTimes)

    @property
    def limits(self) -> FitsLimits:
        """Limits of the files that are opened."""
        return FitsLimits(max_pixels=self.settings.max_pixels)
