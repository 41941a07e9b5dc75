"""The catalogue: images, transits, PSFs, products and jobs, in SQLite or PostgreSQL through SQLAlchemy.

The job table is the only truth about jobs; the broker may lose what it likes. Every change of a job's phase
is a compare-and-set on the row, so that any number of workers, servers and reconcilers may try at once.
Times are seconds since 1970 (UTC).
"""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy import (
    JSON,
    BigInteger,
    Engine,
    Index,
    Select,
    String,
    and_,
    case,
    create_engine,
    delete,
    event,
    func,
    inspect,
    or_,
    select,
    text,
    tuple_,
    update,
)
from sqlalchemy.engine import CursorResult
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column, sessionmaker

from workers.contract import LIVE, Fault, JobError, Phase, canonical_hash

DEFAULT_OWNER = "local"


class Base(DeclarativeBase):
    """Root of the tables."""

    type_annotation_map = {dict[str, Any]: JSON}  # noqa: RUF012 - SQLAlchemy's own convention


class Uploaded:
    """Columns of an upload; its id is the hash of its bytes."""

    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float] = mapped_column(index=True)
    bytes: Mapped[int] = mapped_column(BigInteger, index=True)
    filename: Mapped[str | None]
    summary: Mapped[dict[str, Any]]


class ImageRow(Uploaded, Base):
    """An uploaded image."""

    __tablename__ = "images"


class TransitRow(Uploaded, Base):
    """An uploaded transit, as the archive that was sent."""

    __tablename__ = "transits"


class PsfRow(Base):
    """A PSF version, uploaded or built. Immutable: another content is another row."""

    __tablename__ = "psfs"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float] = mapped_column(index=True)
    name: Mapped[str]
    version: Mapped[str]
    instrument: Mapped[str | None] = mapped_column(index=True)
    status: Mapped[str]
    origin: Mapped[str]  # built | uploaded
    file_sha256: Mapped[str] = mapped_column(String(64))
    bytes: Mapped[int] = mapped_column(BigInteger)
    preview_sha256: Mapped[str | None] = mapped_column(String(64))
    details: Mapped[dict[str, Any]]

    __table_args__ = (Index("psfs_bytes", "origin", "bytes"),)


class ProductRow(Base):
    """A deconvolved image; its id is the identity of the request that made it."""

    __tablename__ = "products"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float] = mapped_column(index=True)
    kind: Mapped[str]
    image_id: Mapped[str] = mapped_column(String(64), index=True)
    psf_id: Mapped[str] = mapped_column(String(64), index=True)
    psf_version: Mapped[str]
    file_sha256: Mapped[str] = mapped_column(String(64))
    bytes: Mapped[int] = mapped_column(BigInteger, index=True)
    preview_sha256: Mapped[str] = mapped_column(String(64))
    details: Mapped[dict[str, Any]]


class JobRow(Base):
    """A job. ``request_key`` is the identity of what it makes."""

    __tablename__ = "jobs"
    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    owner: Mapped[str] = mapped_column(String(64))
    kind: Mapped[str]
    parameters: Mapped[dict[str, Any]]
    request_key: Mapped[str] = mapped_column(String(64))
    phase: Mapped[str] = mapped_column(String(16))
    created_at: Mapped[float] = mapped_column(index=True)
    started_at: Mapped[float | None]
    ended_at: Mapped[float | None]
    submitted_at: Mapped[float | None]
    submissions: Mapped[int] = mapped_column(default=0)
    attempt: Mapped[int] = mapped_column(default=0)
    lease: Mapped[str | None] = mapped_column(String(32))
    heartbeat_at: Mapped[float | None]
    worker: Mapped[str | None]
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    step: Mapped[int] = mapped_column(default=0)
    steps: Mapped[int] = mapped_column(default=0)
    stage: Mapped[str] = mapped_column(default="")
    result_id: Mapped[str | None] = mapped_column(String(64))
    error: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))

    __table_args__ = (
        # Two equal requests at the same moment: the second insert fails and finds the first.
        Index(
            "one_live_job_a_request",
            "owner",
            "request_key",
            unique=True,
            sqlite_where=phase.in_(sorted(LIVE)),
            postgresql_where=phase.in_(sorted(LIVE)),
        ),
        Index("jobs_by_phase", "phase", "heartbeat_at", "submitted_at"),
        # All that tally() asks for, so that it never reads the rows themselves.
        Index("jobs_tallied", "kind", "phase", "attempt", "started_at", "ended_at"),
    )


class TermsRow(Base):
    """What a UWS client said of a job beside its parameters. A job without such a row has no name and no limits."""

    __tablename__ = "job_terms"
    job_id: Mapped[str] = mapped_column(String(32), primary_key=True)
    run_id: Mapped[str | None] = mapped_column(default=None)
    execution_duration_s: Mapped[int] = mapped_column(default=0)  # 0: as long as it takes
    destruction_at: Mapped[float | None] = mapped_column(default=None, index=True)


class ReportRow(Base):
    """What a study of a transit found (a cross-validation); its id is the identity of the request that made it."""

    __tablename__ = "reports"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float] = mapped_column(index=True)
    kind: Mapped[str]
    transit_id: Mapped[str] = mapped_column(String(64), index=True)
    file_sha256: Mapped[str] = mapped_column(String(64))
    bytes: Mapped[int] = mapped_column(BigInteger, index=True)
    preview_sha256: Mapped[str | None] = mapped_column(String(64))
    details: Mapped[dict[str, Any]]


class PartRow(Base):
    """A part of a job that several workers share: open, taken under a token, or done with its result.

    Parts belong to the request, not to the job: what is done stays done when the job is tried again.
    """

    __tablename__ = "parts"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    request_key: Mapped[str] = mapped_column(String(64), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    token: Mapped[str | None] = mapped_column(String(32))
    heartbeat_at: Mapped[float | None]
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))


class WorkerRow(Base):
    """A worker process that is there, at work or not; it says so again and again, and takes its leave."""

    __tablename__ = "workers"
    name: Mapped[str] = mapped_column(String(128), primary_key=True)  # host:process, as in a job's row
    started_at: Mapped[float]
    heartbeat_at: Mapped[float]
    version: Mapped[str] = mapped_column(String(64))


@dataclass(frozen=True)
class JobTally:
    """Jobs of one kind in one phase, counted."""

    kind: str
    phase: str
    jobs: int
    attempts: int
    retries: int
    run_s: float  # of those that ended: from the last start to the end


@dataclass(frozen=True)
class FileTally:
    """Files of one kind, counted: what came from users, and what jobs made."""

    kind: str
    origin: str  # uploaded | built
    files: int
    bytes: int


@dataclass(frozen=True)
class SchemaFaults:
    """What the database lacks of what this version works with."""

    tables: tuple[str, ...]
    columns: tuple[str, ...]
    indexes: tuple[str, ...]
    empty: bool  # there is none of our tables


@dataclass(frozen=True)
class Part:
    """The right to work on a part; results written under a lost right do nothing."""

    owner: str
    request_key: str
    number: int
    token: str


@dataclass(frozen=True)
class Lease:
    """The right to work on a job: changes made under a lost lease do nothing."""

    job_id: str
    token: str


@dataclass(frozen=True)
class JobLine:
    """A job as a list shows it."""

    id: str
    phase: str
    owner: str
    created_at: float
    run_id: str | None


Row = TypeVar("Row", ImageRow, TransitRow, PsfRow, ProductRow, ReportRow)
AnyRow = TypeVar("AnyRow", ImageRow, TransitRow, PsfRow, ProductRow, ReportRow, JobRow)


def open_engine(url: str) -> Engine:
    """An engine with the settings each database needs for many small concurrent writers."""
    if not url.startswith("sqlite"):
        # Without a limit, a database that is cut off would hold whoever asks for minutes.
        patience = {"connect_timeout": 5} if url.startswith("postgresql") else {}
        return create_engine(url, pool_pre_ping=True, connect_args=patience, json_serializer=_strict_json)
    engine = create_engine(url, connect_args={"timeout": 30}, json_serializer=_strict_json)

    @event.listens_for(engine, "connect")
    def _pragmas(connection: Any, _record: Any) -> None:
        # The driver's own BEGIN comes too late for compare-and-set; see _begin.
        connection.isolation_level = None
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute("PRAGMA foreign_keys=ON")

    @event.listens_for(engine, "begin")
    def _begin(connection: Any) -> None:
        # IMMEDIATE waits for the write lock at the start; a deferred transaction that reads first and
        # writes later would fail with "database is locked" instead of waiting. Readers need no lock.
        reads = connection.get_execution_options().get("read_only", False)
        connection.exec_driver_sql("BEGIN" if reads else "BEGIN IMMEDIATE")

    return engine


def _strict_json(value: Any) -> str:
    """JSON without NaN and infinity, which PostgreSQL refuses and clients cannot read."""
    return json.dumps(value, allow_nan=False)


class Catalogue:
    """All reading and writing of rows; each method is one transaction."""

    def __init__(self, url: str) -> None:
        self._engine = open_engine(url)
        self._session: sessionmaker[Session] = sessionmaker(self._engine, expire_on_commit=False)
        self._reading: sessionmaker[Session] = sessionmaker(
            self._engine.execution_options(read_only=True), expire_on_commit=False
        )

    def create_tables(self) -> None:
        """Make the tables that are not there yet, and the indexes that an older version's tables lack."""
        Base.metadata.create_all(self._engine)
        for table in Base.metadata.sorted_tables:
            for index in table.indexes:
                index.create(self._engine, checkfirst=True)

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()

    def ping(self) -> None:
        """Raise ``sqlalchemy.exc.SQLAlchemyError`` where the database does not answer."""
        with self._reading() as session:
            session.execute(select(1))

    # Images, transits, PSFs, products ---------------------------------------------------------------

    def add(self, row: Row) -> tuple[Row, bool]:
        """Insert a content-addressed row; returns the row of that identity, and whether it is new."""
        try:
            with self._session.begin() as session:
                session.add(row)
            return row, True
        except IntegrityError:
            existing = self.get(type(row), row.id, row.owner)
            if existing is None:
                raise
            return existing, False

    def get(self, table: type[Row], identity: str, owner: str = DEFAULT_OWNER) -> Row | None:
        """The row of this identity, or None."""
        with self._reading() as session:
            return session.get(table, (owner, identity))

    def page(
        self,
        table: type[AnyRow],
        *,
        limit: int,
        after: tuple[float, str] | None = None,
        owner: str = DEFAULT_OWNER,
        **equal: str | None,
    ) -> Sequence[AnyRow]:
        """Rows newest first, from ``after`` = (created_at, id) of the last row seen; ``equal`` filters columns."""
        query: Select[AnyRow] = select(table).where(table.owner == owner)
        for column, value in equal.items():
            if value is not None:
                query = query.where(getattr(table, column) == value)
        if after is not None:
            query = query.where(tuple_(table.created_at, table.id) < after)
        query = query.order_by(table.created_at.desc(), table.id.desc()).limit(limit)
        with self._reading() as session:
            return session.scalars(query).all()

    def describe_psf(
        self, psf_id: str, owner: str = DEFAULT_OWNER, *, tables_sha256: str, preview_sha256: str
    ) -> None:
        """Note where the tables and the picture of a PSF are; both follow from its file, which stays as it is."""
        with self._session.begin() as session:
            row = session.get(PsfRow, (owner, psf_id), with_for_update=True)
            if row is not None:
                row.details = {**row.details, "tables_sha256": tables_sha256}
                row.preview_sha256 = preview_sha256

    # Jobs -------------------------------------------------------------------------------------------

    def submit(
        self, kind: str, parameters: dict[str, Any], request_key: str, owner: str = DEFAULT_OWNER
    ) -> tuple[JobRow, bool]:
        """A new queued job, or the live one of an equal request; and whether it is new."""
        live = select(JobRow).where(
            JobRow.owner == owner, JobRow.request_key == request_key, JobRow.phase.in_(LIVE)
        )
        for _ in range(3):  # the equal job may end badly between the two statements
            with self._reading() as session:
                existing = session.scalars(live).first()
            if existing is not None:
                return existing, False
            row = JobRow(
                id=uuid.uuid4().hex,
                owner=owner,
                kind=kind,
                parameters=parameters,
                request_key=request_key,
                phase=Phase.QUEUED,
                created_at=time.time(),
            )
            try:
                with self._session.begin() as session:
                    session.add(row)
                return row, True
            except IntegrityError:
                continue
        raise RuntimeError(f"job for request {request_key} neither inserted nor found")

    def job(self, job_id: str) -> JobRow | None:
        """The job's row, or None."""
        with self._reading() as session:
            return session.get(JobRow, job_id)

    def mark_submitted(self, job_id: str) -> None:
        """Note that the broker has been given the job's id."""
        self._set([JobRow.id == job_id], submitted_at=time.time(), submissions=JobRow.submissions + 1)

    def forget_submission(self, job_id: str) -> None:
        """Note that a queued job's message was taken from the broker, but not the job."""
        self._set([JobRow.id == job_id, JobRow.phase == Phase.QUEUED], submitted_at=None)

    def claim(self, job_id: str, worker: str) -> Lease | None:
        """QUEUED -> EXECUTING, for exactly one of those that try; None for all others."""
        lease = Lease(job_id, uuid.uuid4().hex)
        now = time.time()
        claimed = self._set(
            [JobRow.id == job_id, JobRow.phase == Phase.QUEUED],
            phase=Phase.EXECUTING,
            attempt=JobRow.attempt + 1,
            lease=lease.token,
            started_at=now,
            heartbeat_at=now,
            worker=worker,
            step=0,
            steps=0,
            stage="",
        )
        return lease if claimed else None

    def heartbeat(self, lease: Lease) -> bool:
        """Say that the job is alive; False where the lease is lost or the job was cancelled."""
        return self._set([*_held(lease), JobRow.cancel_requested.is_(False)], heartbeat_at=time.time())

    def progress(self, lease: Lease, stage: str, step: int, steps: int) -> bool:
        """Write how far the job is, which is a heartbeat too; False as for ``heartbeat``."""
        return self._set(
            [*_held(lease), JobRow.cancel_requested.is_(False)],
            stage=stage,
            step=step,
            steps=steps,
            heartbeat_at=time.time(),
        )

    def complete(self, lease: Lease, result_id: str) -> bool:
        """EXECUTING -> COMPLETED under the lease."""
        return self._set(
            _held(lease), phase=Phase.COMPLETED, ended_at=time.time(), result_id=result_id, lease=None
        )

    def fail(self, lease: Lease, error: JobError) -> bool:
        """EXECUTING -> ERROR under the lease."""
        return self._set(
            _held(lease),
            phase=Phase.ERROR,
            ended_at=time.time(),
            error=error.model_dump(mode="json"),
            lease=None,
        )

    def requeue(self, lease: Lease) -> bool:
        """EXECUTING -> QUEUED under the lease, after a passing failure: submitted again after the usual wait."""
        return self._set(
            _held(lease), phase=Phase.QUEUED, submitted_at=time.time(), submissions=JobRow.attempt, lease=None
        )

    def abort(self, lease: Lease) -> bool:
        """EXECUTING -> ABORTED under the lease, once the worker has stopped."""
        return self._set(
            [*_held(lease), JobRow.cancel_requested.is_(True)],
            phase=Phase.ABORTED,
            ended_at=time.time(),
            lease=None,
        )

    def cancel(self, job_id: str) -> None:
        """PENDING, QUEUED -> ABORTED at once; an executing job is asked to stop; an ended one stays as it is."""
        waiting = [JobRow.id == job_id, JobRow.phase.in_((Phase.PENDING, Phase.QUEUED))]
        if not self._set(waiting, phase=Phase.ABORTED, ended_at=time.time(), cancel_requested=True):
            self._set([JobRow.id == job_id, JobRow.phase == Phase.EXECUTING], cancel_requested=True)

    def hand_back(self, lease: Lease) -> bool:
        """EXECUTING -> QUEUED under the lease: the worker stops, the job is not to blame, the attempt not counted."""
        return self._set(
            [*_held(lease), JobRow.cancel_requested.is_(False)],
            phase=Phase.QUEUED,
            attempt=JobRow.attempt - 1,
            submitted_at=None,
            lease=None,
        )

    def give_up_silent(self, lease_s: float, max_attempts: int) -> list[str]:
        """Take back jobs whose worker fell silent; returns the ids of those queued again.

        A job that was cancelled is aborted, and one that was started ``max_attempts`` times is an error.
        """
        silent = [JobRow.phase == Phase.EXECUTING, JobRow.heartbeat_at < time.time() - lease_s]
        self._set(
            [*silent, JobRow.cancel_requested.is_(True)],
            phase=Phase.ABORTED,
            ended_at=time.time(),
            lease=None,
        )
        error = JobError(
            fault=Fault.INTERNAL,
            code="worker-lost",
            message=f"the worker was lost {max_attempts} times while it ran this job; it is not tried again",
        )
        self._set(
            [*silent, JobRow.attempt >= max_attempts],
            phase=Phase.ERROR,
            ended_at=time.time(),
            lease=None,
            error=error.model_dump(mode="json"),
        )
        with self._session.begin() as session:
            back = update(JobRow).where(*silent).values(phase=Phase.QUEUED, submitted_at=None, lease=None)
            return list(session.scalars(back.returning(JobRow.id)))

    def unsubmitted(self, resubmit_s: float) -> list[str]:
        """Ids of queued jobs that the broker was never given, or seems to have lost.

        The wait doubles with each submission of a job, so that a long queue is not submitted over and over.
        """
        now = time.time()
        query = select(JobRow).where(
            JobRow.phase == Phase.QUEUED,
            or_(JobRow.submitted_at.is_(None), JobRow.submitted_at < now - resubmit_s),
        )
        with self._reading() as session:
            rows = session.scalars(query.order_by(JobRow.created_at)).all()
        return [
            row.id
            for row in rows
            if row.submitted_at is None
            or row.submitted_at < now - resubmit_s * 2 ** min(row.submissions - 1, 8)
        ]

    # Jobs that are set up before they start, and the terms they run on -------------------------------

    def draft(
        self,
        kind: str,
        given: dict[str, Any],
        *,
        run_id: str | None = None,
        execution_duration_s: int = 0,
        destruction_at: float | None = None,
        owner: str = DEFAULT_OWNER,
    ) -> JobRow:
        """A new PENDING job with the parameters that were given so far. It shares nothing with equal requests."""
        row = JobRow(
            id=uuid.uuid4().hex,
            owner=owner,
            kind=kind,
            parameters=given,
            request_key="",
            phase=Phase.PENDING,
            created_at=time.time(),
        )
        terms = TermsRow(
            job_id=row.id,
            run_id=run_id,
            execution_duration_s=execution_duration_s,
            destruction_at=destruction_at,
        )
        with self._session.begin() as session:
            session.add_all((row, terms))
        return row

    def amend(self, job_id: str, change: Callable[[dict[str, Any]], dict[str, Any]]) -> bool:
        """Change what was given for a PENDING job; False, and nothing changed, in any other phase."""
        with self._session.begin() as session:
            row = session.get(JobRow, job_id, with_for_update=True)
            if row is None or row.phase != Phase.PENDING:
                return False
            row.parameters = change(dict(row.parameters))
            return True

    def start(self, job_id: str, given: dict[str, Any], parameters: dict[str, Any], request_key: str) -> bool:
        """PENDING -> QUEUED with the parameters that ``given`` was resolved to.

        False where the job is not PENDING, or what was given for it has changed since. Where an equal request has a
        live job already this one runs under a key of its own, and finds what that job made.
        """
        for key in (request_key, canonical_hash({"request_key": request_key, "job": job_id})):
            try:
                with self._session.begin() as session:
                    row = session.get(JobRow, job_id, with_for_update=True)
                    if row is None or row.phase != Phase.PENDING or row.parameters != given:
                        return False
                    row.phase, row.parameters, row.request_key = Phase.QUEUED, parameters, key
                return True
            except IntegrityError:
                continue
        raise RuntimeError(f"job {job_id} has an equal under a key of its own")

    def destroy(self, job_id: str) -> bool:
        """Remove the job in whatever phase; a worker that has it loses its lease and stops. What it made stays."""
        with self._session.begin() as session:
            session.execute(delete(TermsRow).where(TermsRow.job_id == job_id))
            result = session.execute(delete(JobRow).where(JobRow.id == job_id))
            assert isinstance(result, CursorResult)
            return bool(result.rowcount)

    def terms(self, job_id: str) -> TermsRow:
        """The terms of a job."""
        with self._reading() as session:
            return session.get(TermsRow, job_id) or TermsRow(job_id=job_id, execution_duration_s=0)

    def set_terms(self, job_id: str, **values: Any) -> None:
        """Change terms of a job."""
        with self._session.begin() as session:
            # The lock on the job's row orders changes, and a job that is gone gets no terms.
            if session.get(JobRow, job_id, with_for_update=True) is not None:
                session.merge(TermsRow(job_id=job_id, **values))

    def end_by_terms(self) -> list[str]:
        """Ask jobs that execute longer than their terms allow to stop; destroy those that are due, and return their ids."""
        now = time.time()
        too_long = select(JobRow.id).join(TermsRow, TermsRow.job_id == JobRow.id)
        too_long = too_long.where(
            JobRow.phase == Phase.EXECUTING,
            JobRow.cancel_requested.is_(False),
            TermsRow.execution_duration_s > 0,
            JobRow.started_at + TermsRow.execution_duration_s < now,
        )
        with self._reading() as session:
            stopped = list(session.scalars(too_long))
            due = list(session.scalars(select(TermsRow.job_id).where(TermsRow.destruction_at < now)))
        for job_id in stopped:
            self.cancel(job_id)
        return [job_id for job_id in due if self.destroy(job_id)]

    def job_lines(
        self,
        *,
        phases: Sequence[str] = (),
        from_time: float | None = None,
        last: int | None = None,
        owner: str = DEFAULT_OWNER,
    ) -> list[JobLine]:
        """All jobs of an owner, newest first; of some phases, created at ``from_time`` or later, the ``last`` ones."""
        query = select(JobRow.id, JobRow.phase, JobRow.owner, JobRow.created_at, TermsRow.run_id)
        query = query.outerjoin(TermsRow, TermsRow.job_id == JobRow.id).where(JobRow.owner == owner)
        if phases:
            query = query.where(JobRow.phase.in_(phases))
        if from_time is not None:
            query = query.where(JobRow.created_at >= from_time)
        query = query.order_by(JobRow.created_at.desc(), JobRow.id.desc()).limit(last)
        with self._reading() as session:
            return [JobLine(*line) for line in session.execute(query)]

    # Parts of jobs ----------------------------------------------------------------------------------

    def open_parts(self, owner: str, request_key: str, count: int) -> None:
        """Make the parts 0 to count - 1 that are not there yet."""
        with self._session.begin() as session:
            there = set(
                session.scalars(
                    select(PartRow.number).where(PartRow.owner == owner, PartRow.request_key == request_key)
                )
            )
            for number in range(count):
                if number not in there:
                    session.add(PartRow(owner=owner, request_key=request_key, number=number))

    def take_part(self, owner: str, request_key: str, lease_s: float) -> Part | None:
        """A part that is open, or whose holder fell silent; None where there is none."""
        free = [
            PartRow.owner == owner,
            PartRow.request_key == request_key,
            PartRow.result.is_(None),
            or_(PartRow.token.is_(None), PartRow.heartbeat_at < time.time() - lease_s),
        ]
        while True:
            with self._reading() as session:
                number = session.scalars(select(PartRow.number).where(*free).order_by(PartRow.number)).first()
            if number is None:
                return None
            part = Part(owner, request_key, number, uuid.uuid4().hex)
            if self._set_part([*free, PartRow.number == number], token=part.token, heartbeat_at=time.time()):
                return part

    def part_heartbeat(self, part: Part) -> bool:
        """Say that the part is worked on; False where it was taken by another."""
        return self._set_part(_holding(part), heartbeat_at=time.time())

    def finish_part(self, part: Part, result: dict[str, Any]) -> bool:
        """Write a part's result; False where it was taken by another, whose result will count."""
        return self._set_part(_holding(part), result=result, token=None)

    def release_part(self, part: Part) -> None:
        """Give a part back undone."""
        self._set_part(_holding(part), token=None)

    def part_results(self, owner: str, request_key: str) -> list[dict[str, Any]]:
        """Results of the parts that are done, in order."""
        query = select(PartRow.result).where(
            PartRow.owner == owner, PartRow.request_key == request_key, PartRow.result.is_not(None)
        )
        with self._reading() as session:
            return [dict(result) for result in session.scalars(query.order_by(PartRow.number)) if result]

    # Operation --------------------------------------------------------------------------------------

    def announce(self, worker: str, started_at: float, version: str) -> None:
        """Say that a worker process is there; those that have been silent for an hour are forgotten."""
        now = time.time()
        with self._session.begin() as session:
            session.execute(delete(WorkerRow).where(WorkerRow.heartbeat_at < now - 3600.0))
            session.merge(WorkerRow(name=worker, started_at=started_at, heartbeat_at=now, version=version))

    def take_leave(self, worker: str) -> None:
        """Say that a worker process ends."""
        with self._session.begin() as session:
            session.execute(delete(WorkerRow).where(WorkerRow.name == worker))

    def workers(self, lease_s: float) -> Sequence[WorkerRow]:
        """Worker processes that were heard of within ``lease_s``."""
        query = select(WorkerRow).where(WorkerRow.heartbeat_at >= time.time() - lease_s)
        with self._reading() as session:
            return session.scalars(query.order_by(WorkerRow.name)).all()

    def tally(self) -> list[JobTally]:
        """Jobs by kind and phase."""
        query = select(
            JobRow.kind,
            JobRow.phase,
            func.count(),
            func.sum(JobRow.attempt),
            func.sum(case((JobRow.attempt > 1, JobRow.attempt - 1), else_=0)),
            func.sum(func.coalesce(JobRow.ended_at - JobRow.started_at, 0.0)),
        ).group_by(JobRow.kind, JobRow.phase)
        with self._reading() as session:
            return [
                JobTally(kind, phase, int(jobs), int(attempts), int(retries), float(run_s))
                for kind, phase, jobs, attempts, retries, run_s in session.execute(query)
            ]

    def tally_files(self) -> list[FileTally]:
        """Files and their bytes, by what they are."""
        found = []
        with self._reading() as session:
            for kind, upload in (("image", ImageRow), ("transit", TransitRow)):
                files, size = session.execute(
                    select(func.count(), func.coalesce(func.sum(upload.bytes), 0)).select_from(upload)
                ).one()
                found.append(FileTally(kind, "uploaded", int(files), int(size)))
            query = select(PsfRow.origin, func.count(), func.sum(PsfRow.bytes)).group_by(PsfRow.origin)
            for origin, files, size in session.execute(query):
                found.append(FileTally("psf", origin, int(files), int(size)))
            for kind, made in (("product", ProductRow), ("report", ReportRow)):
                files, size = session.execute(
                    select(func.count(), func.coalesce(func.sum(made.bytes), 0)).select_from(made)
                ).one()
                found.append(FileTally(kind, "built", int(files), int(size)))
        return found

    def oldest_queued_at(self) -> float | None:
        """When the job was asked for that has waited longest; None where none waits."""
        with self._reading() as session:
            return session.scalar(select(func.min(JobRow.created_at)).where(JobRow.phase == Phase.QUEUED))

    def count_silent(self, lease_s: float) -> int:
        """Jobs at work whose worker has been silent for longer than the lease."""
        silent = (JobRow.phase == Phase.EXECUTING, JobRow.heartbeat_at < time.time() - lease_s)
        with self._reading() as session:
            return session.scalar(select(func.count()).select_from(JobRow).where(*silent)) or 0

    def count_unsubmitted(self, older_than_s: float) -> int:
        """Queued jobs that nobody gave to the broker in that time."""
        left = (
            JobRow.phase == Phase.QUEUED,
            JobRow.submitted_at.is_(None),
            JobRow.created_at < time.time() - older_than_s,
        )
        with self._reading() as session:
            return session.scalar(select(func.count()).select_from(JobRow).where(*left)) or 0

    def clock(self) -> float:
        """The database's own time, in seconds since 1970."""
        sqlite = self._engine.dialect.name == "sqlite"
        now = (
            "(julianday('now') - 2440587.5) * 86400.0" if sqlite else "extract(epoch from clock_timestamp())"
        )
        with self._reading() as session:
            return float(session.scalar(text(f"SELECT {now}")))

    def schema_faults(self) -> SchemaFaults:
        """What the database lacks; nothing is made."""
        found = inspect(self._engine)
        there = set(found.get_table_names())
        tables, columns, indexes = [], [], []
        for table in Base.metadata.sorted_tables:
            if table.name not in there:
                tables.append(table.name)
                continue
            has = {column["name"] for column in found.get_columns(table.name)}
            columns += [f"{table.name}.{column.name}" for column in table.columns if column.name not in has]
            known = {index["name"] for index in found.get_indexes(table.name)}
            indexes += [str(index.name) for index in table.indexes if index.name not in known]
        ours = len(Base.metadata.sorted_tables)
        return SchemaFaults(tuple(tables), tuple(columns), tuple(sorted(indexes)), len(tables) == ours)

    def _set_part(self, conditions: Sequence[Any], **values: Any) -> bool:
        with self._session.begin() as session:
            result = session.execute(update(PartRow).where(and_(*conditions)).values(**values))
            assert isinstance(result, CursorResult)
            return bool(result.rowcount)

    def _set(self, conditions: Sequence[Any], **values: Any) -> bool:
        """One UPDATE; True where it changed a row."""
        with self._session.begin() as session:
            result = session.execute(update(JobRow).where(and_(*conditions)).values(**values))
            assert isinstance(result, CursorResult)
            return bool(result.rowcount)


def _holding(part: Part) -> list[Any]:
    return [
        PartRow.owner == part.owner,
        PartRow.request_key == part.request_key,
        PartRow.number == part.number,
        PartRow.token == part.token,
        PartRow.result.is_(None),
    ]


def _held(lease: Lease) -> list[Any]:
    return [
        JobRow.id == lease.job_id,
        JobRow.lease == lease.token,
        JobRow.phase == Phase.EXECUTING,
    ]
