"""Bulk runs and their images in the catalogue: create and delete a run, list its files, take images, and store the
results.

A worker takes an image by compare-and-set under the lease of its job (``workers.bulk.turn``). If the lease is lost,
another worker can take the image. The counts and the end of a run are written in the transaction that changes its
images.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import ColumnElement, Select, case, delete, exists, func, insert, null, select, update
from sqlalchemy.orm import Session

from psfcore.errors import DataError
from workers.catalogue.bulk_progress import BATCH, BulkProgress
from workers.catalogue.database import Database, Queries, execute
from workers.catalogue.jobs import Lease
from workers.catalogue.quotas import lock_owner
from workers.catalogue.tables import BulkItemRow, BulkRow, JobRow
from workers.contract.bulk import AT_WORK, DELETABLE, OPEN, STOPPED, BulkPhase, ItemState
from workers.contract.documents import PositionJson
from workers.contract.jobs import Fault, JobError, Phase

# Errors of files whose paths the catalogue cannot store. Such files are not retried, because the stored path is wrong.
NOT_UTF_8, TOO_LONG = "path-not-utf-8", "path-too-long"
LOST = JobError(
    fault=Fault.INTERNAL,
    code="worker-lost",
    message="every worker that processed this image was lost: retry the run to process the image again",
)


@dataclass(frozen=True)
class BulkImage:
    """An image of a run, or the error if it cannot be used."""

    source: str
    uploaded: bool
    error: JobError | None = None


class Bulks(Queries):
    """The tables of bulk runs; each method is one transaction, or one transaction per batch.

    The row of an image that ``take`` returns is the right to work on the image, as it was when it was taken. When a
    worker has lost this right, ``release``, ``finish`` and ``fail`` change nothing and return False.
    """

    def __init__(self, database: Database) -> None:
        super().__init__(database)
        self.progress = BulkProgress(database)

    # A bulk run ---------------------------------------------------------------------------------------

    def get(self, bulk_id: str) -> BulkRow | None:
        """The run's row, or None."""
        return self._database.row(BulkRow, bulk_id)

    def at_work(self) -> Sequence[BulkRow]:
        """Runs that list or process images now (LISTING, RUNNING), oldest first."""
        query = select(BulkRow).where(BulkRow.phase.in_(sorted(AT_WORK)))
        # Sorted here: no index of the database has this order.
        return sorted(self._database.all(query), key=lambda bulk: bulk.created_at)

    def create(self, row: BulkRow, uploaded: Sequence[str]) -> tuple[BulkRow, bool]:
        """Create a run whose first images are these uploads, or find the open run of an identical request.

        Returns the run, and whether it is new.
        """
        row.total = len(uploaded)
        with self._database.writing.begin() as session:
            lock_owner(session, row.owner)
            existing = session.scalars(_equal_open(row)).first()
            if existing is not None:
                return existing, False
            session.add(row)
            session.flush()
            _add(session, row.id, 0, [BulkImage(one, True) for one in uploaded])
            return row, True

    def pause(self, bulk_id: str) -> bool:
        """LISTING, RUNNING -> PAUSED. Workers finish the images that they have taken."""
        return self._set(bulk_id, AT_WORK, phase=BulkPhase.PAUSED)

    def resume(self, bulk_id: str) -> bool:
        """PAUSED, ERROR -> RUNNING, or LISTING if not all files of the run are listed.

        The listing continues where it ended. If it has found nothing, it starts again.
        """
        return self._set(
            bulk_id,
            STOPPED,
            phase=case((BulkRow.listed, BulkPhase.RUNNING.value), else_=BulkPhase.LISTING.value),
            listed_to=case((BulkRow.total > 0, BulkRow.listed_to), else_=null()),
            running_since=time.time(),
            error=None,
        )

    def cancel(self, bulk_id: str) -> bool:
        """Any open phase -> CANCELLED."""
        return self._set(bulk_id, OPEN, phase=BulkPhase.CANCELLED, ended_at=time.time())

    def stop_with(self, bulk_id: str, error: JobError) -> bool:
        """LISTING, RUNNING -> ERROR, for an error that concerns the whole run and not only one image."""
        return self._set(bulk_id, AT_WORK, phase=BulkPhase.ERROR, error=error.model_dump(mode="json"))

    def retry(self, bulk_id: str) -> int | None:
        """Let the failed images be processed again; returns their number, or None for a cancelled run.

        Files whose paths could not be stored stay failed. Raises DataError "equal-bulk-open" if this run has ended and
        another run of an identical request is open.
        """
        there = self.get(bulk_id)
        if there is None:
            return None
        with self._database.writing.begin() as session:
            lock_owner(session, there.owner)
            bulk = session.get(BulkRow, bulk_id, with_for_update=True)
            if bulk is None or bulk.phase == BulkPhase.CANCELLED:
                return None
            again = update(BulkItemRow).where(
                BulkItemRow.bulk_id == bulk_id,
                BulkItemRow.state == ItemState.FAILED,
                BulkItemRow.error["code"].as_string().not_in((NOT_UTF_8, TOO_LONG)),
            )
            waiting = {"state": ItemState.WAITING, "attempts": 0, "ended_at": None, "error": None}
            changed = execute(session, again.values(**waiting))
            bulk.failed -= changed
            if not changed or bulk.phase != BulkPhase.COMPLETED:
                return changed
            equal = session.scalars(_equal_open(bulk)).first()
            if equal is not None:
                raise DataError(
                    "equal-bulk-open",
                    f"expected no other open bulk run of the same request; run {equal.id} is {equal.phase}: cancel "
                    "that run, or try again when it has ended",
                )
            bulk.phase, bulk.ended_at, bulk.running_since = BulkPhase.RUNNING, None, time.time()
            return changed

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
        while row is not None and self._delete_batch(row):
            pass
        return True

    def _delete_batch(self, bulk: BulkRow) -> bool:
        """Delete the next images of a cancelled run, or the run if it has no image. Returns whether images were
        deleted.
        """
        here = BulkItemRow.bulk_id == bulk.id
        next_ones = select(BulkItemRow.position).where(here).order_by(BulkItemRow.position).limit(BATCH)
        with self._database.writing.begin() as session:
            # Two deletions of the same run follow one another. Then the images are locked before the run, as in a
            # worker that records a result.
            lock_owner(session, bulk.owner)
            positions = session.scalars(next_ones).all()
            if not positions:
                execute(session, delete(BulkRow).where(BulkRow.id == bulk.id))
                return False
            batch = delete(BulkItemRow).where(here, BulkItemRow.position.between(positions[0], positions[-1]))
            statement = batch.returning(BulkItemRow.state, BulkItemRow.reused)
            rows = session.execute(statement.execution_options(synchronize_session=False)).all()
            states = [state for state, _ in rows]
            fewer = {
                "total": BulkRow.total - len(rows),
                "done": BulkRow.done - states.count(ItemState.DONE),
                "reused": BulkRow.reused - sum(reused for _, reused in rows),
                "failed": BulkRow.failed - states.count(ItemState.FAILED),
            }
            execute(session, update(BulkRow).where(BulkRow.id == bulk.id).values(**fewer))
            return True

    # Listing ------------------------------------------------------------------------------------------

    def begin_listing(self, bulk_id: str, lease: Lease) -> BulkRow | None:
        """Begin to list the files under this lease, or continue after the place up to which they are listed.

        Returns the run, or None if the lease is lost, the run is not LISTING, or another worker lists the files now.
        """
        with self._database.writing.begin() as session:
            bulk = session.get(BulkRow, bulk_id, with_for_update=True)
            if bulk is None or bulk.phase != BulkPhase.LISTING or not _is_held(session, lease.token):
                return None
            if bulk.lister not in (None, lease.token) and _is_held(session, bulk.lister):
                return None
            bulk.lister = lease.token
            return bulk

    def add_listed(
        self, bulk_id: str, lease: Lease, images: Sequence[BulkImage], listed_to: PositionJson
    ) -> bool:
        """Add images to a run. Returns False if another lease now lists the files, or if the run is not LISTING.

        Parameters
        ----------
        listed_to
            The place up to which the files are listed once these images are added.
        """
        with self._database.writing.begin() as session:
            bulk = _listed_by(session, bulk_id, lease)
            if bulk is None:
                return False
            _add(session, bulk_id, bulk.total, images)
            bulk.total += len(images)
            bulk.failed += sum(image.error is not None for image in images)
            bulk.listed_to = listed_to
            return True

    def end_listing(self, bulk_id: str, lease: Lease) -> bool:
        """Let a run whose files are all listed go on, or end if no image is left. Returns False under the conditions of
        ``add_listed``.
        """
        with self._database.writing.begin() as session:
            bulk = _listed_by(session, bulk_id, lease)
            if bulk is None:
                return False
            bulk.phase, bulk.listed, bulk.lister = BulkPhase.RUNNING, True, None
            session.flush()
            _end_if_done(session, bulk_id)
            return True

    # Images -------------------------------------------------------------------------------------------

    def take(self, bulk_id: str, lease: Lease, max_attempts: int) -> BulkItemRow | None:
        """Take an image whose worker was lost, or else the next waiting image.

        Returns None if no image is left, the run is not LISTING or RUNNING, or the lease is lost. An image that was
        taken ``max_attempts`` times becomes a failed image.
        """
        while True:
            with self._database.writing.begin() as session:
                phase = session.scalar(select(BulkRow.phase).where(BulkRow.id == bulk_id))
                if phase not in AT_WORK or not _is_held(session, lease.token):
                    return None
                lost = _next_image(bulk_id, BulkItemRow.state == ItemState.TAKEN, ~_IN_WORK)
                waiting = _next_image(bulk_id, BulkItemRow.state == ItemState.WAITING)
                item = session.scalars(lost).first() or session.scalars(waiting).first()
                if item is None:
                    return None
                if item.attempts < max_attempts:
                    item.state, item.taken_at, item.attempts = ItemState.TAKEN, time.time(), item.attempts + 1
                    item.job_id, item.token = lease.job_id, lease.token
                    return item
                item.state, item.ended_at = ItemState.FAILED, time.time()
                item.error, item.token = LOST.model_dump(mode="json"), None
                session.flush()
                _count(session, bulk_id, failed=1)

    def release(self, item: BulkItemRow) -> bool:
        """Give an image back, so that a worker can take it again. The attempt does not count."""
        values = {"state": ItemState.WAITING, "attempts": BulkItemRow.attempts - 1, "token": None}
        return self._database.set(BulkItemRow, _held(item), **values)

    def finish(self, item: BulkItemRow, *, reused: bool, **values: object) -> bool:
        """Record that an image is done."""
        values |= {"state": ItemState.DONE, "reused": reused, "error": None}
        return self._end(item, values, done=1, reused=int(reused))

    def fail(self, item: BulkItemRow, error: JobError) -> bool:
        """Record that an image failed."""
        return self._end(item, {"state": ItemState.FAILED, "error": error.model_dump(mode="json")}, failed=1)

    def _end(self, item: BulkItemRow, values: Mapping[str, object], **counts: int) -> bool:
        with self._database.writing.begin() as session:
            ended = update(BulkItemRow).where(*_held(item))
            if not execute(session, ended.values(ended_at=time.time(), token=None, **values)):
                return False
            _count(session, item.bulk_id, **counts)
            return True

    def _set(self, bulk_id: str, phases: Iterable[BulkPhase], **values: object) -> bool:
        return self._database.set(
            BulkRow, [BulkRow.id == bulk_id, BulkRow.phase.in_(sorted(phases))], **values
        )


def new_id() -> str:
    """A new id for a bulk run."""
    return uuid.uuid4().hex


def _equal_open(row: BulkRow) -> Select[BulkRow]:
    """A query for another open run of an identical request. Lock the owner first."""
    same = (BulkRow.owner == row.owner, BulkRow.request_key == row.request_key, BulkRow.id != row.id)
    return select(BulkRow).where(*same, BulkRow.phase.in_(sorted(OPEN)))


def _add(session: Session, bulk_id: str, first: int, images: Sequence[BulkImage]) -> None:
    """Insert images at position ``first`` and the positions after it, in batches."""
    for at in range(0, len(images), BATCH):
        batch = enumerate(images[at : at + BATCH], first + at)
        session.execute(insert(BulkItemRow), [_values(bulk_id, number, image) for number, image in batch])


def _values(bulk_id: str, position: int, image: BulkImage) -> dict[str, object]:
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


# The condition that the lease under which an image was taken is not lost.
_IN_WORK = exists().where(
    JobRow.id == BulkItemRow.job_id, JobRow.lease == BulkItemRow.token, JobRow.phase == Phase.EXECUTING
)


def _next_image(bulk_id: str, *conditions: ColumnElement[bool]) -> Select[BulkItemRow]:
    """A query for the first image of a run that meets the conditions. It is locked."""
    query = select(BulkItemRow).where(BulkItemRow.bulk_id == bulk_id, *conditions)
    # If two workers take an image at the same moment, they get different images.
    return query.order_by(BulkItemRow.position).limit(1).with_for_update(skip_locked=True)


def _is_held(session: Session, token: str | None) -> bool:
    """Whether a worker holds the lease with this token."""
    held = select(JobRow.id).where(JobRow.lease == token, JobRow.phase == Phase.EXECUTING)
    return session.scalars(held.limit(1)).first() is not None


def _listed_by(session: Session, bulk_id: str, lease: Lease) -> BulkRow | None:
    """The locked row of a run whose files are listed under this lease; None if they are not."""
    bulk = session.get(BulkRow, bulk_id, with_for_update=True)
    return bulk if bulk and bulk.phase == BulkPhase.LISTING and bulk.lister == lease.token else None


def _held(item: BulkItemRow) -> list[ColumnElement[bool]]:
    """The conditions that the worker still has the right to work on an image."""
    return [
        BulkItemRow.bulk_id == item.bulk_id,
        BulkItemRow.position == item.position,
        BulkItemRow.state == ItemState.TAKEN,
        BulkItemRow.token == item.token,
    ]


def _count(session: Session, bulk_id: str, **counts: int) -> None:
    """Add to the counts of a run, and end it if no image is left."""
    more = {name: getattr(BulkRow, name) + count for name, count in counts.items()}
    execute(session, update(BulkRow).where(BulkRow.id == bulk_id).values(**more))
    _end_if_done(session, bulk_id)


def _end_if_done(session: Session, bulk_id: str) -> None:
    """Any open phase -> COMPLETED, if all images are listed and each of them is done or failed."""
    done = update(BulkRow).where(
        BulkRow.id == bulk_id,
        BulkRow.phase.in_(sorted(OPEN)),
        BulkRow.listed,
        BulkRow.done + BulkRow.failed == BulkRow.total,
    )
    execute(session, done.values(phase=BulkPhase.COMPLETED, ended_at=time.time()))
