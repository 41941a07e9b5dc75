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
from functools import partial
from typing import TypeVar

from psfcore.errors import DataError
from workers.bulk.image import Destination, Outcome, Ready, compute_one, done_before, read_one, write_one
from workers.bulk.listing import list_files
from workers.catalogue.tables import BulkItemRow, BulkRow
from workers.contract.bulk import AT_WORK, BulkPhase, BulkWork
from workers.contract.jobs import JobError
from workers.stage_timer import STARTING
from workers.tasks.catalogue_workspace import CatalogueWorkspace
from workers.tasks.workspace import Result, TurnOver

TELL_EVERY_S = 1.0  # interval at which a turn reports its progress and checks whether it must stop
BETWEEN = "between images"  # the stage between two images: the worker checks whether the run continues
LISTING = "listing files"  # the stage of a turn that waits for images
TURN_S = (
    60.0  # a turn ends after this time, so that other bulk runs get turns; an attempt may take much longer
)
Answer = TypeVar("Answer")
log = logging.getLogger(__name__)


def bulk_turn(workspace: CatalogueWorkspace, parameters: Mapping[str, object]) -> str:
    """Deconvolve images of a bulk run; returns the id of the run. Raises ``TurnOver`` if images are left but the turn
    must end.
    """
    bulk_id = str(parameters["bulk_id"])
    bulk = workspace.catalogue.bulks.get(bulk_id)
    if bulk is not None and bulk.phase in AT_WORK:
        with ThreadPoolExecutor(4, "bulk") as pool:
            turn = _Turn(workspace, bulk, pool)
            try:
                turn.run()
            finally:
                turn.close()
    return bulk_id


@dataclass(frozen=True)
class _Reading:
    """An image that a thread takes and then reads.

    Attributes
    ----------
    item
        The row of the image in the run; None if there was no image to take.
    image
        The image itself, and the time that reading took, s; None if there was no image to take.
    """

    item: Future[BulkItemRow | None]
    image: Future[tuple[Ready | Outcome, float] | None]


class _Stopped(Exception):
    """The turn ends, so the image that was read ahead is given back."""


class _Turn:
    """The images of one turn: one is read, one is computed and one is written at the same time.

    If a worker is lost, each of these images has lost an attempt. Therefore an image in a second attempt is processed
    alone: an image that ends the process must not use up the attempts of its neighbours.
    """

    def __init__(self, workspace: CatalogueWorkspace, bulk: BulkRow, pool: ThreadPoolExecutor) -> None:
        self._workspace, self._bulk, self._pool = workspace, bulk, pool
        self._bulks = workspace.catalogue.bulks
        # Products name the bulk run as their job, because the job of a turn is soon deleted.
        self._computing = dataclasses.replace(workspace, report=self._report, job_id=bulk.id)
        self._beside = dataclasses.replace(workspace, report=self._check, job_id=bulk.id)
        self._stop, self._news = threading.Event(), threading.Event()
        self._ahead: _Reading | None = None
        self._writing: tuple[BulkItemRow, Future[None]] | None = None
        self._listing: Future[None] | None = None
        self._product_ids: set[str] = set()
        self._ends_at = time.monotonic() + TURN_S
        self._reports_s = self._reported_at = 0.0

    def run(self) -> None:
        """Process images until no image is left. Raises ``TurnOver`` if the turn must end before."""
        if self._bulk.phase == BulkPhase.LISTING:
            self._lists()
        while self._is_at_work() and not self._stopped_for_quota():
            ahead, self._ahead = self._ahead, None
            reading = ahead or self._read()
            item = reading.item.result()
            if item is not None:
                self._do(item, reading)
            elif ahead is not None:
                continue  # images may have been listed after this turn asked for one
            elif self._bulk.phase == BulkPhase.RUNNING:
                return
            elif self._lists():
                self._wait_for_images()
            elif self._is_at_work() and self._bulk.phase == BulkPhase.LISTING:
                return  # another turn lists files
            if time.monotonic() > self._ends_at or self._workspace.others_wait():
                raise TurnOver

    def close(self) -> None:
        """Give back the image that was read ahead, and wait until the last product is written and the listing has
        ended.
        """
        self._stop.set()
        try:
            if self._ahead is not None:
                self._give_back(self._ahead)
            self._finish_writing()
        finally:
            if self._listing is not None:
                self._listing.result()

    def _is_at_work(self) -> bool:
        """Read the row of the run again. Returns whether the run is LISTING or RUNNING."""
        bulk = self._bulks.get(self._bulk.id)
        self._bulk = bulk or self._bulk
        return bulk is not None and bulk.phase in AT_WORK

    def _stopped_for_quota(self) -> bool:
        """Stop the run if its owner's quota is used up. Returns whether it was stopped. The run can be resumed when
        there is room.
        """
        workspace = self._workspace
        usage = workspace.catalogue.quotas.limited(workspace.owner, workspace.settings.quota_mib)
        if usage is None or not usage.full:
            return False
        if not BulkWork.model_validate(self._bulk.request).keeps_products:
            return False
        message = f"{usage.no_room('no further product could be kept')}, then resume the run"
        self._bulks.stop_with(self._bulk.id, JobError.of(DataError("quota-exceeded", message)))
        return True

    # Listing ------------------------------------------------------------------------------------------

    def _lists(self) -> bool:
        """List files in a thread, if no other turn lists them. Returns whether this turn lists files now.

        Raises the exception with which the thread ended.
        """
        if self._listing is not None and not self._listing.done():
            return True
        if self._listing is not None:
            self._listing.result()
        assert self._workspace.lease is not None
        bulk = self._bulks.begin_listing(self._bulk.id, self._workspace.lease)
        if bulk is None:
            return False
        self._listing = self._submit(list_files, self._beside, bulk, self._news.set, self._stop.is_set)
        self._listing.add_done_callback(lambda _: self._news.set())
        return True

    def _wait_for_images(self) -> None:
        """Wait until further images are listed or the listing ended, but for ``TELL_EVERY_S`` at most.

        This wait does not count towards the time limit of a job.
        """
        self._finish_writing()
        error = self._workspace.guarded(lambda: self._workspace.report(LISTING, 0, 1))
        assert error is None, error
        self._news.wait(TELL_EVERY_S or 0.1)
        self._news.clear()

    # Images -------------------------------------------------------------------------------------------

    def _read(self) -> _Reading:
        """Let a thread take an image and read it."""
        workspace, bulk = self._workspace, self._bulk
        next_item = self._submit(self._bulks.take, bulk.id, workspace.lease, workspace.settings.max_attempts)

        def read() -> tuple[Ready | Outcome, float] | None:
            item, began = next_item.result(), time.perf_counter()
            if item is None:
                return None
            return read_one(self._beside, bulk, item), time.perf_counter() - began

        return _Reading(next_item, self._submit(read))

    def _give_back(self, reading: _Reading) -> None:
        error = reading.item.exception()
        if error is not None:
            log.warning("bulk run %s: could not take the next image: %s", self._bulk.id, error)
            return
        reading.image.exception()  # waits until the thread has stopped reading; another turn meets the same error
        item = reading.item.result()
        if item is not None:
            self._bulks.release(item)

    def _do(self, item: BulkItemRow, reading: _Reading) -> None:
        """Deconvolve one image, and let a thread write it and record its result.

        If the whole turn must stop, the image is released for another turn.
        """
        self._workspace.times.begin(STARTING)
        write = self._ended_or_released(item, lambda: self._computed(item, reading))
        self._workspace.times.begin(BETWEEN)
        if write is not None:
            self._finish_writing()
            self._writing = item, self._submit(write)

    def _computed(self, item: BulkItemRow, reading: _Reading) -> Callable[[], None]:
        """Deconvolve an image. Returns the function that writes the product and records the result."""
        read = _awaited(reading.image, lambda: self._report("reading", 0, 1))
        assert read is not None
        ready, read_s = read
        if item.attempts > 1 or self._workspace.settings.max_attempts == 1:
            self._finish_writing()
        elif time.monotonic() < self._ends_at:
            self._ahead = self._read()
        if isinstance(ready, Ready):
            ready = self._made_meanwhile(ready.destination) or ready
        if isinstance(ready, Outcome):
            existing = ready
            return partial(self._record, item, lambda: existing, read_s)
        self._product_ids.add(ready.destination.identity)
        began, reports_s = time.perf_counter(), self._reports_s
        result = compute_one(self._computing, ready)
        # without the time that was spent on reports of progress
        kernel_s = time.perf_counter() - began - (self._reports_s - reports_s)
        return partial(self._record, item, partial(self._written, ready, result, kernel_s), read_s + kernel_s)

    def _made_meanwhile(self, destination: Destination) -> Outcome | None:
        """The product of an image whose content this turn deconvolved after the image was read; None for another
        image.
        """
        if destination.identity not in self._product_ids:
            return None
        self._finish_writing()
        return done_before(self._workspace, destination)

    def _written(self, ready: Ready, result: Result, kernel_s: float) -> Outcome:
        outcome = write_one(self._beside, ready, result)
        kernel = {"kernel_seconds": round(kernel_s, 3), "start_s": ready.start_s}
        return dataclasses.replace(outcome, statistics=outcome.statistics | kernel)

    def _record(self, item: BulkItemRow, write: Callable[[], Outcome], before_s: float) -> None:
        """Write a product, and record the result of its image. The worker already spent ``before_s`` seconds on the
        image.
        """
        began = time.perf_counter()
        outcome = write()
        seconds = before_s + time.perf_counter() - began
        statistics = {**outcome.statistics, "seconds": round(seconds, 3)}
        self._bulks.finish(item, **{**vars(outcome), "statistics": statistics})

    def _finish_writing(self) -> None:
        """Wait until the product of the previous image is written. An error of this image is recorded with it."""
        writing, self._writing = self._writing, None
        if writing is not None:
            self._ended_or_released(writing[0], writing[1].result)

    def _ended_or_released(self, item: BulkItemRow, work: Callable[[], Answer]) -> Answer | None:
        """Do a part of the work on an image; returns its result. If it fails, record the error with the image.

        If the whole turn must stop, the image is released for another turn, and the exception is raised.
        """
        answers: list[Answer] = []
        try:
            error = self._workspace.guarded(lambda: answers.append(work()))
        except BaseException:
            self._bulks.release(item)
            raise
        if error is not None:
            self._bulks.fail(item, error)
            return None
        return answers[0]

    # Threads and reports ------------------------------------------------------------------------------

    def _submit(self, work: Callable[..., Answer], *arguments: object) -> Future[Answer]:
        """Run a function in a thread, with the trace and the log fields of this thread."""
        return self._pool.submit(contextvars.copy_context().run, work, *arguments)

    def _report(self, stage: str, step: int, _steps: int) -> None:
        """Count the stage of an image, and report the images that are done, at most once a second. Raises if the turn
        must stop.
        """
        with self._workspace.times.step(stage, step):
            began = time.perf_counter()
            if began - self._reported_at >= TELL_EVERY_S:
                self._workspace.report("images", self._bulk.done + self._bulk.failed, self._bulk.total)
                self._reported_at = time.perf_counter()
                self._reports_s += self._reported_at - began

    def _check(self, _stage: str, _step: int, _steps: int) -> None:
        """The progress function of the other threads, whose times are not stages of the turn."""
        if self._stop.is_set():
            raise _Stopped


def _awaited(future: Future[Answer], report: Callable[[], None]) -> Answer:
    """The result of another thread. Reports now and every second, so that the turn can be stopped meanwhile."""
    report()
    while not wait([future], TELL_EVERY_S or 0.1).done:
        report()
    return future.result()
