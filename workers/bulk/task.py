"""The task ``bulk``: one turn of a bulk run. A turn deconvolves images one after the other.

While one image is computed, a second thread reads the next image and a third thread writes the product of the previous
one. Only the main thread computes, with ``HELIOPSF_WORKER_THREADS`` threads. While files are being listed, one turn of
the run lists them in a fourth thread, and all turns process the images that are already listed.

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
from workers.catalogue.jobs import Lease
from workers.contract.bulk import AT_WORK, BulkPhase, BulkWork
from workers.contract.phases import Fault, JobError
from workers.stage_timer import STARTING
from workers.tasks.context import Context, TurnOver
from workers.tasks.data.product import Made

TELL_EVERY_S = 1.0  # interval at which a turn reports its progress and checks whether it must stop
BETWEEN = "between images"  # the stage between two images: the worker checks whether the run continues
LISTING = "listing files"  # the stage of a turn that waits for images
TURN_S = (
    60.0  # a turn ends after this time, so that other bulk runs get turns; an attempt may take much longer
)
Answer = TypeVar("Answer")
log = logging.getLogger(__name__)


def bulk_turn(context: Context, parameters: Mapping[str, Any]) -> str:
    """Deconvolve images of a bulk run; returns the id of the run. Raises ``TurnOver`` if images are left but the turn must end."""
    bulk_id: str = parameters["bulk_id"]
    bulk = context.catalogue.bulks.get(bulk_id)
    if bulk is not None and bulk.phase in AT_WORK:
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


class _Listing:
    """The thread of a turn that lists files. lease: the lease of the turn.

    The thread ends when all files are listed, and when the run or the turn stops.
    """

    def __init__(self, context: Context, bulk: BulkRow, lease: Lease, stops: threading.Event) -> None:
        self._context, self._bulk, self._lease, self._stops = context, bulk, lease, stops
        self._pool = ThreadPoolExecutor(1, "bulk-lister")
        self._running: Future[None] | None = None
        self._news = threading.Event()

    def begin(self) -> bool:
        """List files, if the run is LISTING and no other turn lists them. Returns whether this turn lists files now.

        Raises the exception with which the thread ended.
        """
        if self._running is not None and not self._running.done():
            return True
        if self._running is not None:
            self._running.result()
        begun = self._context.catalogue.bulks.begin_listing(self._bulk.id, self._lease)
        if begun is None:
            return False
        run = contextvars.copy_context().run
        self._running = self._pool.submit(
            run, list_files, self._context, begun, self._lease, self._news.set, self._stops.is_set
        )
        self._running.add_done_callback(lambda _: self._news.set())
        return True

    def wait(self) -> None:
        """Wait until images were added or the thread ended, but for ``TELL_EVERY_S`` at most."""
        self._news.wait(TELL_EVERY_S or 0.1)
        self._news.clear()

    def close(self) -> None:
        """Wait for the thread. Raises the exception with which it ended."""
        self._pool.shutdown()
        if self._running is not None:
            self._running.result()


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
        assert context.lease is not None
        self._listing = _Listing(self._beside, bulk, context.lease, self._stop)

    def run(self) -> None:
        """Process images until no image is left. Raises ``TurnOver`` if the turn must end before."""
        context = self._context
        if self._bulk.phase == BulkPhase.LISTING:
            self._listing.begin()
        while True:
            bulk = context.catalogue.bulks.get(self._bulk.id)
            if bulk is None or bulk.phase not in AT_WORK or _stopped_for_quota(context, bulk):
                return
            self._bulk = bulk
            ahead, self._ahead = self._ahead, None
            reading = ahead or self._read()
            taken = reading.taken.result()
            if taken is not None:
                self._do(taken, reading.ready)
            elif ahead is not None:
                continue  # images may have been listed after this turn asked for one
            elif bulk.phase == BulkPhase.LISTING and self._listing.begin():
                self._wait_for_images()
            elif bulk.phase == BulkPhase.RUNNING or not self._is_running():
                return
            if time.monotonic() > self._ends_at or context.others_wait():
                raise TurnOver

    def _wait_for_images(self) -> None:
        """Wait a moment until further images are listed. This wait does not count towards the time limit of a job."""
        self._finish_writing()
        error = self._context.guarded(lambda: self._context.report(LISTING, 0, 1))
        assert error is None, error
        self._listing.wait()

    def _is_running(self) -> bool:
        """Whether the listing ended a moment ago, so that images may have been added after this turn asked for one."""
        bulk = self._context.catalogue.bulks.get(self._bulk.id)
        return bulk is not None and bulk.phase == BulkPhase.RUNNING

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
            self._listing.close()

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
    usage = context.catalogue.owners.limited(context.owner, context.settings.quota_mib)
    if usage is None or not usage.full or not work_of(bulk).keeps_products:
        return False
    message = (
        f"expected room for more products; {usage.used_bytes} of {usage.limit_bytes} bytes of the quota are used: delete "
        "products that you no longer need (`heliopsf product delete`), or ask the operator for a larger quota; then "
        "resume the run"
    )
    context.catalogue.bulks.stop_with(
        bulk.id, JobError(fault=Fault.USER, code="quota-exceeded", message=message)
    )
    return True
