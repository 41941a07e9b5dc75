"""The catalogue: images, transits, PSFs, products and jobs, in SQLite or PostgreSQL through SQLAlchemy.

The job table is the only truth about jobs; the broker may lose what it likes. Every change of a job's phase
is a compare-and-set on the row, so that any number of workers, servers and reconcilers may try at once.
Times are seconds since 1970 (UTC).
"""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Sequence
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
    create_engine,
    event,
    or_,
    select,
    tuple_,
    update,
)
from sqlalchemy.engine import CursorResult
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column, sessionmaker

from workers.contract import LIVE, Fault, JobError, Phase

DEFAULT_OWNER = "local"


class Base(DeclarativeBase):
    """Root of the tables."""

    type_annotation_map = {dict[str, Any]: JSON}  # noqa: RUF012 - SQLAlchemy's own convention


class Uploaded:
    """Columns of an upload; its id is the hash of its bytes."""

    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float] = mapped_column(index=True)
    bytes: Mapped[int] = mapped_column(BigInteger)
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
    bytes: Mapped[int] = mapped_column(BigInteger)
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
    )


class ReportRow(Base):
    """What a study of a transit found (a cross-validation); its id is the identity of the request that made it."""

    __tablename__ = "reports"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float] = mapped_column(index=True)
    kind: Mapped[str]
    transit_id: Mapped[str] = mapped_column(String(64), index=True)
    file_sha256: Mapped[str] = mapped_column(String(64))
    bytes: Mapped[int] = mapped_column(BigInteger)
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


Row = TypeVar("Row", ImageRow, TransitRow, PsfRow, ProductRow, ReportRow)
AnyRow = TypeVar("AnyRow", ImageRow, TransitRow, PsfRow, ProductRow, ReportRow, JobRow)


def open_engine(url: str) -> Engine:
    """An engine with the settings each database needs for many small concurrent writers."""
    if not url.startswith("sqlite"):
        return create_engine(url, pool_pre_ping=True, json_serializer=_strict_json)
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
        """Make the tables that are not there yet."""
        Base.metadata.create_all(self._engine)

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
        """QUEUED -> ABORTED at once; an executing job is asked to stop; an ended one stays as it is."""
        queued = [JobRow.id == job_id, JobRow.phase == Phase.QUEUED]
        if not self._set(queued, phase=Phase.ABORTED, ended_at=time.time(), cancel_requested=True):
            self._set([JobRow.id == job_id, JobRow.phase == Phase.EXECUTING], cancel_requested=True)

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
