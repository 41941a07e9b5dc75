"""The task ``bulk``: one turn of a bulk run. A turn deconvolves images one after the other.

While one image is computed, a second thread reads the next image and a third thread writes the product of the previous
one. Only the main thread computes, with ``HELIOPSF_WORKER_THREADS`` threads.

A turn ends when no image is left, or when other jobs wait. A product that already exists is not made again, even if
another job made it. An image that cannot be deconvolved is recorded as failed, with the reason; the run continues.
"""

from __future__ import annotations

import contextvars
import dataclasses
import logging
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, TypeVar

from workers.bulk.image import Outcome, Ready, compute_one, done_before, read_one, write_one
from workers.bulk.listing import list_files, work_of
from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.bulks import Taken
from workers.contract.bulk import BulkPhase, BulkWork
from workers.contract.phases import Fault, JobError
from workers.tasks.context import Context, TurnOver
from workers.tasks.data.product import Made
from workers.tasks.stage_timer import STARTING

TELL_EVERY_S = 1.0  # interval at which a turn reports its progress and checks whether it must stop
BETWEEN = "between images"  # the stage between two images: the worker checks whether the run continues
TURN_S = (
    60.0  # a turn ends after this time, so that other bulk runs get turns; an attempt may take much longer
)
Answer = TypeVar("Answer")
log = logging.getLogger(__name__)


def bulk_turn(context: Context, parameters: Mapping[str, Any]) -> str:
    """Deconvolve images of a bulk run; returns the id of the run. Raises ``TurnOver`` if images are left but the turn must end."""
    bulk_id: str = parameters["bulk_id"]
    assert context.lease is not None
    while True:
        bulk = context.catalogue.bulks.get(bulk_id)
        if bulk is None or (bulk.phase == BulkPhase.LISTING and not list_files(context, bulk, context.lease)):
            return bulk_id
        if bulk.phase != BulkPhase.LISTING:
            break
    turn = _Turn(context, bulk)
    try:
        turn.run()
    finally:
        turn.close()
    return bulk_id


@dataclass(frozen=True)
class _Reading:
    """An image that the reading thread takes and then reads."""

    taken: Future[Taken | None]
    ready: Future[tuple[Ready | Outcome, float] | None]


@dataclass(frozen=True)
class _Writing:
    """An image whose product the writing thread writes."""

    taken: Taken
    written: Future[None]


class _Stopped(Exception):
    """The turn ends, so the image that was read ahead is given back."""


class _Turn:
    """The images of one turn: one is read, one is computed and one is written at the same time.

    If a worker is lost, each of these images has lost an attempt. Therefore an image in a second attempt is processed
    alone: an image that ends the process must not use up the attempts of its neighbours.
    """

    def __init__(self, context: Context, bulk: BulkRow) -> None:
        self._context, self._bulk = context, bulk
        self._request: BulkWork = work_of(bulk)
        self._reader = ThreadPoolExecutor(1, "bulk-reader")
        self._writer = ThreadPoolExecutor(1, "bulk-writer")
        self._stop = threading.Event()
        self._beside = dataclasses.replace(context, report=self._check, job_id=bulk.id)
        self._ahead: _Reading | None = None
        self._writing: _Writing | None = None
        self._made: set[str] = set()
        self._ends_at = time.monotonic() + TURN_S

    def run(self) -> None:
        """Process images until no image is left. Raises ``TurnOver`` if the turn must end before."""
        context = self._context
        while True:
            bulk = context.catalogue.bulks.get(self._bulk.id)
            if bulk is None or bulk.phase != BulkPhase.RUNNING or _stopped_for_quota(context, bulk):
                return
            self._bulk = bulk
            reading, self._ahead = self._ahead or self._read(), None
            taken = reading.taken.result()
            if taken is None:
                return
            self._do(taken, reading.ready)
            if time.monotonic() > self._ends_at or context.others_wait():
                raise TurnOver

    def close(self) -> None:
        """Give back the image that was read ahead, and wait until the last product is written."""
        self._stop.set()
        try:
            if self._ahead is not None:
                self._give_back(self._ahead)
            self._finish_writing()
        finally:
            self._reader.shutdown()
            self._writer.shutdown()

    def _give_back(self, reading: _Reading) -> None:
        error = reading.taken.exception()
        if error is not None:
            log.warning("bulk run %s: could not take the next image: %s", self._bulk.id, error)
            return
        reading.ready.exception()  # waits until the thread has stopped reading; another turn meets the same error
        taken = reading.taken.result()
        if taken is not None:
            self._context.catalogue.bulks.release(taken)

    def _read(self) -> _Reading:
        """Let the reading thread take an image and read it."""
        context, bulk = self._context, self._bulk
        assert context.lease is not None
        taken = self._reader.submit(
            context.catalogue.bulks.take, bulk.id, context.lease, context.settings.max_attempts
        )

        def read() -> tuple[Ready | Outcome, float] | None:
            found, started = taken.result(), time.perf_counter()
            if found is None:
                return None
            ready = read_one(self._beside, bulk, self._request, found)
            return ready, time.perf_counter() - started

        return _Reading(taken, self._reader.submit(contextvars.copy_context().run, read))

    def _check(self, _stage: str, _step: int, _steps: int) -> None:
        """The progress function of the two threads, whose times are not stages of the turn."""
        if self._stop.is_set():
            raise _Stopped

    def _do(self, taken: Taken, reading: Future[tuple[Ready | Outcome, float] | None]) -> None:
        """Deconvolve one image, and let the writing thread write it and record its result.

        If the whole turn must stop, the image is released for another turn.
        """
        context, bulks = self._context, self._context.catalogue.bulks
        progress = _Progress(context, self._bulk)
        # Products name the bulk run as their job, because the job of a turn is soon deleted.
        of_image = dataclasses.replace(context, report=progress.report, job_id=self._bulk.id)
        found: list[Outcome | tuple[Ready, Made]] = []
        times: dict[str, float] = {}

        def compute() -> None:
            read = _awaited(reading, lambda: progress.report("reading", 0, 1))
            assert read is not None
            ready, times["read"] = read
            alone = taken.attempt > 1 or context.settings.max_attempts == 1
            if alone:
                self._finish_writing()
            elif time.monotonic() < self._ends_at:
                self._ahead = self._read()
            before = ready if isinstance(ready, Outcome) else self._made_meanwhile(ready)
            if before is not None:
                found.append(before)
                return
            assert isinstance(ready, Ready)
            self._made.add(ready.identity)
            started, told_s = time.perf_counter(), progress.told_s
            made = compute_one(of_image, self._request, ready)
            # without the time that was spent on reports of progress
            times["kernel"] = time.perf_counter() - started - (progress.told_s - told_s)
            found.append((ready, made))

        context.times.begin(STARTING)
        try:
            error = context.guarded(compute)
        except BaseException:
            bulks.release(taken)
            raise
        finally:
            context.times.begin(BETWEEN)
        if error is not None:
            bulks.fail(taken, error)
            return
        self._finish_writing()
        (computed,) = found

        def write() -> None:
            started = time.perf_counter()
            values = vars(
                computed if isinstance(computed, Outcome) else self._written(*computed, times["kernel"])
            )
            seconds = sum(times.values()) + time.perf_counter() - started
            statistics = {**values["statistics"], "seconds": round(seconds, 3)}
            bulks.finish(taken, **{**values, "statistics": statistics})

        self._writing = _Writing(taken, self._writer.submit(contextvars.copy_context().run, write))

    def _made_meanwhile(self, ready: Ready) -> Outcome | None:
        """The product of an image whose content this turn deconvolved after the image was read; None for another image."""
        if ready.identity not in self._made:
            return None
        self._finish_writing()
        return done_before(self._context, ready.wanted, self._request, ready.target)

    def _written(self, ready: Ready, made: Made, kernel_s: float) -> Outcome:
        outcome = write_one(self._beside, self._request, ready, made)
        kernel = {"kernel_seconds": round(kernel_s, 3)}
        return dataclasses.replace(outcome, statistics=outcome.statistics | kernel)

    def _finish_writing(self) -> None:
        """Wait until the product of the previous image is written. An error of this image is recorded with it."""
        writing, self._writing = self._writing, None
        if writing is None:
            return
        bulks = self._context.catalogue.bulks
        try:
            error = self._context.guarded(writing.written.result)
        except BaseException:
            bulks.release(writing.taken)
            raise
        if error is not None:
            bulks.fail(writing.taken, error)


class _Progress:
    """Reports the progress of an image as progress of its turn. told_s: time that the reports took, in seconds."""

    def __init__(self, context: Context, bulk: BulkRow) -> None:
        self._context, self._bulk = context, bulk
        self.told_s = self._told_at = 0.0

    def report(self, stage: str, step: int, _steps: int) -> None:
        """Count the stage, and report the images that are done, at most once a second. Raises if the turn must stop."""
        bulk = self._bulk
        with self._context.times.step(stage, step):
            began = time.perf_counter()
            if began - self._told_at >= TELL_EVERY_S:
                self._context.report("images", bulk.done + bulk.failed, bulk.total)
                self._told_at = time.perf_counter()
                self.told_s += self._told_at - began


def _awaited(future: Future[Answer], report: Callable[[], None]) -> Answer:
    """The result of another thread. Reports now and every second, so that the turn can be stopped meanwhile."""
    report()
    while not wait([future], TELL_EVERY_S or 0.1).done:
        report()
    return future.result()


def _stopped_for_quota(context: Context, bulk: BulkRow) -> bool:
    """Stop the bulk run if its owner's quota is used up. Returns whether it was stopped. The run can be resumed when there is room."""
    usage = context.catalogue.owners.usage(context.owner, context.settings.quota_mib)
    if not usage.full or not work_of(bulk).keeps_products:
        return False
    message = (
        f"expected room for more products; {usage.used_bytes} of {usage.limit_bytes} bytes of the quota are used: delete "
        "products or other bulk runs that you no longer need (`heliopsf product delete`, `heliopsf bulk delete`), or ask "
        "the operator for a larger quota; then resume the run"
    )
    context.catalogue.bulks.stop_with(
        bulk.id, JobError(fault=Fault.USER, code="quota-exceeded", message=message)
    )
    return True
