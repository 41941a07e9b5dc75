"""Bulk runs and their images in the catalogue: create and delete a run, list its files, take images, and store the results.

A worker takes an image by compare-and-set under the lease of its job (``workers.bulk.task``). If the lease is lost,
another worker can take the image. The counts and the end of a run are written in the transaction that changes its
images.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

from sqlalchemy import ColumnElement, Delete, Update, case, delete, func, insert, null, select, update
from sqlalchemy.engine import CursorResult
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from psfcore.errors import DataError
from workers.catalogue.bulk_progress import BATCH, BulkProgress
from workers.catalogue.bulk_tables import BulkItemRow, BulkRow
from workers.catalogue.database import Database
from workers.catalogue.jobs import Lease
from workers.catalogue.owners import lock_owner
from workers.catalogue.tables import JobRow
from workers.contract.bulk import AT_WORK, DELETABLE, OPEN, STOPPED, BulkPhase, ItemState
from workers.contract.phases import Fault, JobError, Phase

# Errors of files whose paths the catalogue cannot store. Such files are not retried, because the stored path is wrong.
NOT_UTF_8, TOO_LONG = "path-not-utf-8", "path-too-long"
LOST = JobError(
    fault=Fault.INTERNAL,
    code="worker-lost",
    message="every worker that processed this image was lost: retry the run to process the image again",
)


@dataclass(frozen=True)
class Listed:
    """An image of a run, or the error if it cannot be used."""

    source: str
    uploaded: bool
    error: JobError | None = None


@dataclass(frozen=True)
class Taken:
    """The right to work on an image. When the right is lost, further changes by this worker have no effect."""

    bulk_id: str
    position: int
    source: str
    uploaded: bool
    attempt: int
    lease: Lease


class Bulks:
    """The tables of bulk runs; each method is one transaction, or one transaction per batch."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self.progress = BulkProgress(database)

    # A bulk run ---------------------------------------------------------------------------------------

    def get(self, bulk_id: str) -> BulkRow | None:
        """The run's row, or None."""
        with self._database.reading() as session:
            return session.get(BulkRow, bulk_id)

    def at_work(self) -> Sequence[BulkRow]:
        """Runs that list or process images now (LISTING, RUNNING), oldest first."""
        query = select(BulkRow).where(BulkRow.phase.in_(sorted(AT_WORK)))
        with self._database.reading() as session:
            return sorted(session.scalars(query), key=lambda bulk: bulk.created_at)

    def create(self, row: BulkRow, uploaded: Sequence[str]) -> tuple[BulkRow, bool]:
        """Create a run whose first images are these uploads, or find the open run of an identical request.

        Returns the run, and whether it is new.
        """
        row.total = len(uploaded)
        for _ in range(3):  # between the two statements, the identical run may end
            try:
                with self._database.writing.begin() as session:
                    session.add(row)
                    session.flush()
                    _add(session, row.id, 0, (Listed(one, True) for one in uploaded))
                return row, True
            except IntegrityError:
                existing = self._equal_open(row)
                if existing is not None:
                    return existing, False
        raise RuntimeError(f"bulk run for request {row.request_key} neither inserted nor found")

    def pause(self, bulk_id: str) -> bool:
        """LISTING, RUNNING -> PAUSED. Workers finish the images that they have taken."""
        return self._set(bulk_id, AT_WORK, phase=BulkPhase.PAUSED)

    def resume(self, bulk_id: str) -> bool:
        """PAUSED, ERROR -> RUNNING, or LISTING if not all files of the run are listed.

        The listing continues where it ended. If it has found nothing, it starts again.
        """
        now = {"running_since": time.time(), "error": None}
        listed_to = case((BulkRow.total > 0, BulkRow.listed_to), else_=null())
        return self._set(bulk_id, STOPPED, BulkRow.listed, phase=BulkPhase.RUNNING, **now) or self._set(
            bulk_id, STOPPED, BulkRow.listed.is_(False), phase=BulkPhase.LISTING, listed_to=listed_to, **now
        )

    def cancel(self, bulk_id: str) -> bool:
        """Any open phase -> CANCELLED."""
        return self._set(bulk_id, OPEN, phase=BulkPhase.CANCELLED, ended_at=time.time())

    def delete(self, bulk_id: str) -> bool:
        """Delete a run and its images; their products stay. Returns False if there is no such run, or if the run is
        LISTING or RUNNING.

        The run is cancelled first, so that nobody resumes it. Then its images are deleted in batches, and finally the
        run. Each batch is one transaction. If this process stops before the end, a cancelled run with fewer images
        remains; this run can be deleted again.
        """
        ended_at = func.coalesce(BulkRow.ended_at, time.time())
        if not self._set(bulk_id, DELETABLE, phase=BulkPhase.CANCELLED, ended_at=ended_at):
            return False
        row = self.get(bulk_id)
        while row is not None and self._delete_batch(bulk_id, row.owner):
            pass
        return True

    def _delete_batch(self, bulk_id: str, owner: str) -> bool:
        """Delete the next images of a cancelled run, or the run if it has no image. Returns whether images were deleted."""
        here = BulkItemRow.bulk_id == bulk_id
        next_ones = select(BulkItemRow.position).where(here).order_by(BulkItemRow.position).limit(BATCH)
        with self._database.writing.begin() as session:
            # Two deletions of the same run follow one another. Then the images are locked before the run, as in a
            # worker that records a result.
            lock_owner(session, owner)
            positions = session.scalars(next_ones).all()
            if not positions:
                row = session.get(BulkRow, bulk_id, with_for_update=True)
                if row is not None:  # no other request deleted it meanwhile
                    session.delete(row)
                return False
            batch = delete(BulkItemRow).where(here, BulkItemRow.position.between(positions[0], positions[-1]))
            told = batch.returning(BulkItemRow.state, BulkItemRow.reused)
            deleted = session.execute(told.execution_options(synchronize_session=False)).all()
            counts = {
                "total": len(deleted),
                "done": sum(state == ItemState.DONE for state, _ in deleted),
                "reused": sum(reused for _, reused in deleted),
                "failed": sum(state == ItemState.FAILED for state, _ in deleted),
            }
            fewer = {name: getattr(BulkRow, name) - count for name, count in counts.items()}
            _changed(session, update(BulkRow).where(BulkRow.id == bulk_id).values(**fewer))
            return True

    def stop_with(self, bulk_id: str, error: JobError) -> bool:
        """LISTING, RUNNING -> ERROR, for an error that concerns the whole run and not only one image."""
        return self._set(bulk_id, AT_WORK, phase=BulkPhase.ERROR, error=error.model_dump(mode="json"))

    def retry(self, bulk_id: str) -> int | None:
        """Let the failed images be processed again; returns their number, or None for a cancelled run.

        Files whose paths could not be stored stay failed. Raises DataError "equal-bulk-open" if this run has ended and
        another run of an identical request is open.
        """
        for _ in range(3):  # the identical run may end between the two statements
            try:
                return self._retry(bulk_id)
            except IntegrityError:
                bulk = self.get(bulk_id)
                equal = None if bulk is None else self._equal_open(bulk)
            if equal is not None:
                raise DataError(
                    "equal-bulk-open",
                    f"expected no other open bulk run of the same request; run {equal.id} is {equal.phase}: cancel that run, "
                    "or try again when it has ended",
                )
        raise RuntimeError(f"bulk run {bulk_id} neither reopened nor its identical run found")

    def _retry(self, bulk_id: str) -> int | None:
        with self._database.writing.begin() as session:
            bulk = session.get(BulkRow, bulk_id, with_for_update=True)
            if bulk is None or bulk.phase == BulkPhase.CANCELLED:
                return None
            again = update(BulkItemRow).where(
                BulkItemRow.bulk_id == bulk_id,
                BulkItemRow.state == ItemState.FAILED,
                BulkItemRow.error["code"].as_string().not_in((NOT_UTF_8, TOO_LONG)),
            )
            changed = _changed(
                session, again.values(state=ItemState.WAITING, attempts=0, ended_at=None, error=None)
            )
            bulk.failed -= changed
            if changed and bulk.phase == BulkPhase.COMPLETED:
                bulk.phase, bulk.ended_at, bulk.running_since = BulkPhase.RUNNING, None, time.time()
            return changed

    def _equal_open(self, row: BulkRow) -> BulkRow | None:
        """Find another open run of an identical request; None if there is none."""
        equal = select(BulkRow).where(
            BulkRow.owner == row.owner,
            BulkRow.request_key == row.request_key,
            BulkRow.phase.in_(OPEN),
            BulkRow.id != row.id,
        )
        with self._database.reading() as session:
            return session.scalars(equal).first()

    # Listing ------------------------------------------------------------------------------------------

    def begin_listing(self, bulk_id: str, lease: Lease) -> BulkRow | None:
        """Begin to list the files under this lease, or continue after the place up to which they are listed.

        Returns the run, or None if the lease is lost, the run is not LISTING, or another worker lists the files now.
        """
        with self._database.writing.begin() as session:
            bulk = session.get(BulkRow, bulk_id, with_for_update=True)
            if bulk is None or bulk.phase != BulkPhase.LISTING or not _good(session, lease):
                return None
            if bulk.lister not in (None, lease.token) and _is_lease(session, bulk.lister):
                return None
            bulk.lister = lease.token
            if bulk.listed_to is None:
                self._forget_files(session, bulk)
            return bulk

    def _forget_files(self, session: Session, bulk: BulkRow) -> None:
        """Remove the files that a version without ``listed_to`` has listed. None of them was taken before all were listed."""
        files = delete(BulkItemRow).where(BulkItemRow.bulk_id == bulk.id, BulkItemRow.uploaded.is_(False))
        told = files.returning(BulkItemRow.state).execution_options(synchronize_session=False)
        states = session.scalars(told).all()
        bulk.total -= len(states)
        bulk.failed -= sum(state == ItemState.FAILED for state in states)

    def add_listed(
        self, bulk_id: str, lease: Lease, images: Sequence[Listed], listed_to: Mapping[str, Any]
    ) -> bool:
        """Add images to a run. Returns False if another lease now lists the files, or if the run is not LISTING.

        listed_to: the place up to which the files are then listed.
        """
        with self._database.writing.begin() as session:
            bulk = session.get(BulkRow, bulk_id, with_for_update=True)
            if bulk is None or bulk.phase != BulkPhase.LISTING or bulk.lister != lease.token:
                return False
            bulk.failed += sum(image.error is not None for image in images)
            bulk.listed_to = dict(listed_to)
            bulk.total += _add(session, bulk_id, bulk.total, images)
            return True

    def end_listing(self, bulk_id: str, lease: Lease) -> bool:
        """LISTING -> RUNNING, or LISTING -> COMPLETED if no image is left. Returns False under the conditions of
        ``add_listed``."""
        with self._database.writing.begin() as session:
            bulk = session.get(BulkRow, bulk_id, with_for_update=True)
            if bulk is None or bulk.phase != BulkPhase.LISTING or bulk.lister != lease.token:
                return False
            bulk.phase, bulk.listed, bulk.lister = BulkPhase.RUNNING, True, None
            session.flush()
            _end_if_done(session, bulk_id)
            return True

    # Images -------------------------------------------------------------------------------------------

    def take(self, bulk_id: str, lease: Lease, max_attempts: int) -> Taken | None:
        """Take an image whose worker was lost, or else the next waiting image.

        Returns None if no image is left, the run is not LISTING or RUNNING, or the lease is lost. An image that was
        taken ``max_attempts`` times becomes a failed image.
        """
        while True:
            with self._database.writing.begin() as session:
                phase = session.scalar(select(BulkRow.phase).where(BulkRow.id == bulk_id))
                if phase not in AT_WORK or not _good(session, lease):
                    return None
                item = session.scalars(_left(bulk_id)).first() or session.scalars(_waiting(bulk_id)).first()
                if item is None:
                    return None
                if item.attempts >= max_attempts:
                    item.state, item.ended_at = ItemState.FAILED, time.time()
                    item.error, item.token = LOST.model_dump(mode="json"), None
                    session.flush()
                    _count(session, bulk_id, failed=BulkRow.failed + 1)
                    continue
                item.state, item.taken_at, item.attempts = ItemState.TAKEN, time.time(), item.attempts + 1
                item.job_id, item.token = lease.job_id, lease.token
                return Taken(bulk_id, item.position, item.source, item.uploaded, item.attempts, lease)

    def release(self, taken: Taken) -> bool:
        """Give an image back, so that a worker can take it again. The attempt does not count. Returns False if the
        worker has lost the right to work on the image."""
        values = {"state": ItemState.WAITING, "attempts": BulkItemRow.attempts - 1, "token": None}
        return bool(self._database.change(update(BulkItemRow).where(*_holding(taken)).values(**values)))

    def finish(self, taken: Taken, *, reused: bool, **values: Any) -> bool:
        """Record that an image is done. Returns False if the worker has lost the right to work on the image."""
        done = update(BulkItemRow).where(*_holding(taken)).values(
            state=ItemState.DONE, ended_at=time.time(), token=None, error=None, reused=reused, **values
        )  # fmt: skip
        with self._database.writing.begin() as session:
            if not _changed(session, done):
                return False
            _count(session, taken.bulk_id, done=BulkRow.done + 1, reused=BulkRow.reused + int(reused))
            return True

    def fail(self, taken: Taken, error: JobError) -> bool:
        """Record that an image failed. Returns False if the worker has lost the right to work on the image."""
        failed = update(BulkItemRow).where(*_holding(taken)).values(
            state=ItemState.FAILED, ended_at=time.time(), token=None, error=error.model_dump(mode="json")
        )  # fmt: skip
        with self._database.writing.begin() as session:
            if not _changed(session, failed):
                return False
            _count(session, taken.bulk_id, failed=BulkRow.failed + 1)
            return True

    def _set(
        self,
        bulk_id: str,
        phases: Iterable[BulkPhase],
        *conditions: ColumnElement[bool] | Any,
        **values: Any,
    ) -> bool:
        changed = update(BulkRow).where(BulkRow.id == bulk_id, BulkRow.phase.in_(sorted(phases)), *conditions)
        return bool(self._database.change(changed.values(**values)))


def new_id() -> str:
    """A new id for a bulk run."""
    return uuid.uuid4().hex


def _add(session: Session, bulk_id: str, first: int, images: Iterable[Listed]) -> int:
    """Insert images at position ``first`` and the positions after it, in batches; returns the number of images."""
    numbered = enumerate(images, first)
    position = first
    while batch := [_values(bulk_id, number, image) for number, image in islice(numbered, BATCH)]:
        session.execute(insert(BulkItemRow), batch)
        position += len(batch)
    return position - first


def _values(bulk_id: str, position: int, image: Listed) -> Mapping[str, Any]:
    failed = image.error is not None
    return {
        "bulk_id": bulk_id,
        "position": position,
        "uploaded": image.uploaded,
        "source": image.source,
        "state": ItemState.FAILED if failed else ItemState.WAITING,
        "ended_at": time.time() if failed else None,
        "error": None if image.error is None else image.error.model_dump(mode="json"),
    }


def _waiting(bulk_id: str) -> Any:
    query = select(BulkItemRow).where(BulkItemRow.bulk_id == bulk_id, BulkItemRow.state == ItemState.WAITING)
    # If two workers take an image at the same moment, they get different images.
    return query.order_by(BulkItemRow.position).limit(1).with_for_update(skip_locked=True)


def _left(bulk_id: str) -> Any:
    """A query for an image that was taken under a lease that is now lost."""
    held = select(JobRow.id).where(
        JobRow.id == BulkItemRow.job_id, JobRow.lease == BulkItemRow.token, JobRow.phase == Phase.EXECUTING
    )
    query = select(BulkItemRow).where(
        BulkItemRow.bulk_id == bulk_id, BulkItemRow.state == ItemState.TAKEN, ~held.exists()
    )
    return query.order_by(BulkItemRow.position).limit(1).with_for_update(skip_locked=True)


def _good(session: Session, lease: Lease) -> bool:
    """Whether the lease is still valid."""
    held = select(JobRow.id).where(
        JobRow.id == lease.job_id, JobRow.lease == lease.token, JobRow.phase == Phase.EXECUTING
    )
    return session.scalar(held) is not None


def _is_lease(session: Session, token: str | None) -> bool:
    """Whether a job holds the lease with this token."""
    held = select(JobRow.id).where(JobRow.lease == token, JobRow.phase == Phase.EXECUTING)
    return session.scalars(held.limit(1)).first() is not None


def _holding(taken: Taken) -> Iterator[ColumnElement[bool]]:
    yield BulkItemRow.bulk_id == taken.bulk_id
    yield BulkItemRow.position == taken.position
    yield BulkItemRow.state == ItemState.TAKEN
    yield BulkItemRow.token == taken.lease.token


def _changed(session: Session, statement: Update | Delete) -> int:
    result = session.execute(statement.execution_options(synchronize_session=False))
    assert isinstance(result, CursorResult)
    return result.rowcount


def _count(session: Session, bulk_id: str, **values: Any) -> None:
    _changed(session, update(BulkRow).where(BulkRow.id == bulk_id).values(**values))
    _end_if_done(session, bulk_id)


def _end_if_done(session: Session, bulk_id: str) -> None:
    """Any open phase -> COMPLETED, if all images are listed and each of them is done or failed."""
    done = update(BulkRow).where(
        BulkRow.id == bulk_id,
        BulkRow.phase.in_(sorted(OPEN)),
        BulkRow.listed,
        BulkRow.done + BulkRow.failed == BulkRow.total,
    )
    _changed(session, done.values(phase=BulkPhase.COMPLETED, ended_at=time.time()))
