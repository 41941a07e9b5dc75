"""The tables of the catalogue.

Times are seconds since 1970 (UTC). A change of the tables needs a new revision in
``workers/catalogue/migrations/versions``. The revision upgrades existing databases.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    ColumnElement,
    Double,
    Index,
    String,
    TextClause,
    case,
    false,
    literal_column,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, MappedColumn, mapped_column

from psfcore.fits.header import HeaderJson
from workers.catalogue.database import Now
from workers.contract.documents import PositionJson, TransitJson
from workers.contract.jobs import Queue

DEFAULT_OWNER = "local"
MOST_LETTERS = 1024  # longest path of a file of a bulk run


class Base(DeclarativeBase):
    """Base class of the tables."""

    type_annotation_map = {  # noqa: RUF012 - SQLAlchemy's own convention
        dict[str, Any]: JSON,
        list[str]: JSON,
        float: Double,  # without this line, the type depends on the version of SQLAlchemy
    }

    @classmethod
    def thing(cls) -> str:
        """The name of what a row describes, for example "image"."""
        return str(cls.__tablename__.removesuffix("s"))


_RELEASED = text("status IN ('certified', 'deprecated')")
_DEPRECATED = text("status = 'deprecated'")
_LIVE = text("phase IN ('COMPLETED', 'EXECUTING', 'QUEUED')")
_EXECUTING = text("phase = 'EXECUTING'")
_OPEN = text("phase IN ('ERROR', 'LISTING', 'PAUSED', 'RUNNING')")


def _listed(table: str, *by: str) -> Index:
    """An index for lists of an owner's rows, newest first, which are filtered by the columns ``by``."""
    return Index("_".join((table, "listed", *(("by", *by) if by else ()))), "owner", *by, "created_at", "id")


def _summed(table: str) -> Index:
    """An index with which the bytes of an owner's files are added up without reading the rows."""
    return Index(f"{table}_summed", "owner", "bytes")


def _partial(name: str, condition: TextClause, *columns: str, unique: bool = False) -> Index:
    """An index of the rows that meet a condition."""
    return Index(name, *columns, unique=unique, sqlite_where=condition, postgresql_where=condition)


def _change_time() -> MappedColumn[float]:
    """The time of the last change that a reader can see, by the database's clock (``workers.catalogue.changes``).

    Each UPDATE sets it, unless the statement gives it a value. It grows even if the clock was set back or did not move.
    """
    before: ColumnElement[float] = literal_column("changed_at", Double)
    later = case((before < Now(), Now()), else_=before + 0.001)
    return mapped_column(default=Now(), server_default="0", onupdate=later)


class OwnerColumns:
    """The columns of every row that belongs to an owner."""

    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float]


class Change:
    """Columns of a change: the person who made it, its time and the reason. Rows are never changed or deleted."""

    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    owner: Mapped[str] = mapped_column(String(64))
    at: Mapped[float]
    by: Mapped[str] = mapped_column(String(128))
    reason: Mapped[str] = mapped_column(String(400))


class FileColumns(OwnerColumns):
    """The columns of every row that belongs to an owner and has a file in the store."""

    file_sha256: Mapped[str] = mapped_column(String(64))
    bytes: Mapped[int] = mapped_column(BigInteger)


class RunColumns:
    """Columns of a job or of a bulk run."""

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    owner: Mapped[str] = mapped_column(String(64))
    phase: Mapped[str] = mapped_column(String(16))
    request_key: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[float]
    ended_at: Mapped[float | None]
    changed_at: Mapped[float] = _change_time()
    error: Mapped[dict[str, str] | None] = mapped_column(JSON(none_as_null=True))


class UploadColumns(OwnerColumns):
    """Columns of an upload; its id is the SHA-256 of its bytes."""

    bytes: Mapped[int] = mapped_column(BigInteger)
    filename: Mapped[str | None]


class ImageRow(UploadColumns, Base):
    """An uploaded image."""

    __tablename__ = "images"
    summary: Mapped[HeaderJson] = mapped_column(JSON)

    __table_args__ = (_listed("images"), _summed("images"))


class TransitRow(UploadColumns, Base):
    """An uploaded transit: the archive, unchanged."""

    __tablename__ = "transits"
    summary: Mapped[TransitJson] = mapped_column(JSON)

    __table_args__ = (_listed("transits"), _summed("transits"))


class PsfRow(FileColumns, Base):
    """An uploaded, built or fitted PSF. Its content never changes; a PSF with other content has another row.

    Before the PSF is certified, ``version`` is the version in the file. Afterwards it is the version in the series.
    """

    __tablename__ = "psfs"
    name: Mapped[str]
    version: Mapped[str]
    instrument: Mapped[str | None]
    channel: Mapped[str | None]  # the wavelength in whole angstrom, such as 174
    kind: Mapped[str] = mapped_column(server_default="total")  # "total", "uploaded" or a component's name
    series: Mapped[str | None]  # instrument/channel/kind; None without an instrument
    status: Mapped[str]
    # The range of observation times, only if the PSF is or was certified. An open end is an infinity.
    valid_from: Mapped[float | None]
    valid_to: Mapped[float | None]
    successor_id: Mapped[str | None] = mapped_column(String(64))
    origin: Mapped[str]  # built | fitted | uploaded
    preview_sha256: Mapped[str | None] = mapped_column(String(64))
    details: Mapped[dict[str, Any]]

    __table_args__ = (
        _summed("psfs"),
        Index("psfs_bytes", "origin", "bytes"),
        _listed("psfs"),
        _listed("psfs", "series", "status"),
        *(
            _listed("psfs", by)
            for by in ("instrument", "channel", "kind", "series", "name", "version", "status")
        ),
        Index("psfs_by_validity", "owner", "series", "status", "valid_from"),
        # Each version occurs only once in a series.
        _partial("one_psf_a_version", _RELEASED, "owner", "series", "version", unique=True),
        _partial("psfs_deprecated", _DEPRECATED, "owner", "id"),
    )


class PsfSeriesRow(Base):
    """A series of which a PSF was certified. A change of the status of a PSF in the series locks this row."""

    __tablename__ = "psf_series"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    series: Mapped[str] = mapped_column(String(128), primary_key=True)


class SeriesChangeRow(Change, Base):
    """A change of a series: whether its PSFs may be interpolated. The latest row of a series is valid.

    The PSFs of a series without a row may not be interpolated.
    """

    __tablename__ = "series_changes"
    series: Mapped[str] = mapped_column(String(128))
    interpolated: Mapped[bool]

    __table_args__ = (Index("series_changes_of_a_series", "owner", "series", "number"),)


class PsfChangeRow(Change, Base):
    """A change of a PSF's status, with the person, time and reason."""

    __tablename__ = "psf_changes"
    psf_id: Mapped[str] = mapped_column(String(64))
    status_before: Mapped[str] = mapped_column(String(16))
    status: Mapped[str] = mapped_column(String(16))
    version_before: Mapped[str]
    version: Mapped[str]
    valid_from: Mapped[float | None]
    valid_to: Mapped[float | None]
    successor_id: Mapped[str | None] = mapped_column(String(64))

    __table_args__ = (Index("psf_changes_of_a_psf", "owner", "psf_id", "number"),)


class PsfContextRow(OwnerColumns, Base):
    """A context: a named set of PSFs, with one PSF for each series and range of times.

    A context never changes. Its id is the hash of its name and of its pins.
    """

    __tablename__ = "psf_contexts"
    name: Mapped[str] = mapped_column(String(80))
    created_by: Mapped[str] = mapped_column(String(128))
    reason: Mapped[str] = mapped_column(String(400))
    pins: Mapped[int]

    __table_args__ = (
        Index("one_context_a_name", "owner", "name", unique=True),
        _listed("psf_contexts"),
    )


class PsfPinRow(Base):
    """A pin: the PSF that a context uses for a series and a range of observation times."""

    __tablename__ = "psf_pins"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    context_id: Mapped[str] = mapped_column(String(64), primary_key=True)
    series: Mapped[str] = mapped_column(String(128), primary_key=True)
    valid_from: Mapped[float] = mapped_column(primary_key=True)
    valid_to: Mapped[float]
    psf_id: Mapped[str] = mapped_column(String(64))
    version: Mapped[str]
    # Whether the PSFs of the series may be interpolated in this context; all pins of a series have the same value.
    interpolated: Mapped[bool] = mapped_column(default=False, server_default=false())


class DefaultContextRow(Change, Base):
    """A change of an owner's default context. The latest row of an owner is valid.

    If ``context_id`` is None, the owner uses the PSFs that are certified now.
    """

    __tablename__ = "default_contexts"
    context_id: Mapped[str | None] = mapped_column(String(64))

    __table_args__ = (Index("default_contexts_of_an_owner", "owner", "number"),)


class ProductRow(FileColumns, Base):
    """A deconvolved image; its id is the identity of its request."""

    __tablename__ = "products"
    kind: Mapped[str]
    image_id: Mapped[str] = mapped_column(String(64))
    psf_id: Mapped[str] = mapped_column(String(64))
    psf_version: Mapped[str]
    preview_sha256: Mapped[str] = mapped_column(String(64))
    details: Mapped[dict[str, Any]]

    __table_args__ = (
        _listed("products"),
        _listed("products", "image_id"),
        _listed("products", "psf_id"),
        _summed("products"),
    )


class JobRow(RunColumns, Base):
    """A job. ``work_key`` is the identity of its result.

    ``request_key`` normally equals ``work_key``. It is a different key if another queued, executing or completed job
    already has this key.
    """

    __tablename__ = "jobs"
    kind: Mapped[str]
    parameters: Mapped[dict[str, Any]]
    work_key: Mapped[str | None] = mapped_column(String(64))  # None while PENDING
    queue: Mapped[str] = mapped_column(String(16), default=Queue.INTERACTIVE, server_default="interactive")
    started_at: Mapped[float | None]
    submitted_at: Mapped[float | None]
    submissions: Mapped[int] = mapped_column(default=0)
    # A temporary failure ended the last attempt, and the job has not been submitted again yet.
    delayed: Mapped[bool] = mapped_column(default=False, server_default=false())
    attempt: Mapped[int] = mapped_column(default=0)
    lease: Mapped[str | None] = mapped_column(String(32))
    heartbeat_at: Mapped[float | None]
    worker: Mapped[str | None]
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    step: Mapped[int] = mapped_column(default=0)
    steps: Mapped[int] = mapped_column(default=0)
    stage: Mapped[str] = mapped_column(default="")
    # A job counts its steps several times. These are the time and the step at which the current count began; the
    # remaining time of the job is estimated from them.
    count_at: Mapped[float | None]
    count_step: Mapped[int] = mapped_column(default=0, server_default="0")
    result_id: Mapped[str | None] = mapped_column(String(64))
    # The estimate was made when the job was submitted.
    estimate: Mapped[dict[str, float] | None] = mapped_column(JSON(none_as_null=True))

    __table_args__ = (
        # If two identical requests arrive at the same moment, the second insert fails; the request then finds the first
        # job.
        _partial("one_live_job_a_request", _LIVE, "owner", "request_key", unique=True),
        # If two jobs have the same result, the second cannot be claimed while the first executes.
        _partial("one_at_work_a_result", _EXECUTING, "owner", "work_key", unique=True),
        Index("ix_jobs_created_at", "created_at"),
        Index("jobs_by_phase", "phase", "heartbeat_at", "submitted_at"),
        # This index contains the owner, so that the owners of many waiting jobs are found without reading the rows.
        Index("jobs_waiting", "phase", "queue", "created_at", "submitted_at", "owner"),
        _listed("jobs"),
        _listed("jobs", "phase"),
        Index("jobs_changed", "owner", "changed_at", "id"),
        # This index contains all columns that tally() needs, so that tally() need not read the rows.
        Index("jobs_tallied", "kind", "phase", "attempt", "started_at", "ended_at"),
    )


class TermsRow(Base):
    """The UWS terms of a job: run id, time limit and destruction time. A job without such a row has no UWS terms."""

    __tablename__ = "job_terms"
    job_id: Mapped[str] = mapped_column(String(32), primary_key=True)
    run_id: Mapped[str | None] = mapped_column(default=None)
    execution_duration_s: Mapped[int] = mapped_column(default=0)  # 0: unlimited
    destruction_at: Mapped[float | None] = mapped_column(default=None, index=True)


class BulkRow(RunColumns, Base):
    """A bulk run: many images that are deconvolved in the same way.

    A transaction that changes the items of the run also changes its counts.
    """

    __tablename__ = "bulks"
    name: Mapped[str] = mapped_column(String(80))
    # without the ids of uploaded images; they are items of the run
    request: Mapped[dict[str, object]] = mapped_column(JSON)
    psf_id: Mapped[str | None] = mapped_column(String(64))
    context_id: Mapped[str | None] = mapped_column(String(64))
    running_since: Mapped[float | None]
    listed: Mapped[bool]  # whether all files have been listed as items
    lister: Mapped[str | None] = mapped_column(
        String(32)
    )  # token of the lease of the worker that lists files
    # how far the files are listed (``workers.bulk.listing.SearchPosition``); null: the listing has not begun, or it has
    # no files
    listed_to: Mapped[PositionJson | None] = mapped_column(JSON(none_as_null=True))
    total: Mapped[int] = mapped_column(default=0)
    done: Mapped[int] = mapped_column(default=0)
    reused: Mapped[int] = mapped_column(default=0)  # done images whose product existed before
    failed: Mapped[int] = mapped_column(default=0)

    __table_args__ = (
        _listed("bulks"),
        Index("bulks_by_phase", "phase"),
        Index("bulks_changed", "owner", "changed_at", "id"),
        # If two identical requests arrive at the same moment, the second insert fails; the request then finds the first
        # run.
        _partial("one_open_bulk_a_request", _OPEN, "owner", "request_key", unique=True),
    )


class BulkItemRow(Base):
    """An image of a bulk run. The worker that processes it holds the lease ``token`` of the job ``job_id``."""

    __tablename__ = "bulk_items"
    bulk_id: Mapped[str] = mapped_column(String(32), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    uploaded: Mapped[bool]
    source: Mapped[str] = mapped_column(String(MOST_LETTERS))  # an upload's id, or a file's path
    state: Mapped[str] = mapped_column(String(16))
    attempts: Mapped[int] = mapped_column(default=0)
    job_id: Mapped[str | None] = mapped_column(String(32))
    token: Mapped[str | None] = mapped_column(String(32))
    taken_at: Mapped[float | None]
    ended_at: Mapped[float | None]
    reused: Mapped[bool] = mapped_column(default=False)
    image_sha256: Mapped[str | None] = mapped_column(String(64))
    psf_id: Mapped[str | None] = mapped_column(String(64))
    product_id: Mapped[str | None] = mapped_column(String(64))
    kept: Mapped[bool] = mapped_column(default=False)  # whether the product is in the service's store
    output: Mapped[str | None] = mapped_column(String(1200))  # the file in the output folder
    sha256: Mapped[str | None] = mapped_column(String(64))
    bytes: Mapped[int | None] = mapped_column(BigInteger)
    score: Mapped[float | None]  # artefact score
    statistics: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    error: Mapped[dict[str, str] | None] = mapped_column(JSON(none_as_null=True))

    __table_args__ = (
        Index("bulk_items_by_state", "bulk_id", "state", "position"),
        Index("bulk_items_by_score", "bulk_id", "score", "position"),
        Index("bulk_items_by_end", "bulk_id", "ended_at"),
        Index("bulk_items_by_product", "product_id"),
    )


class OwnerTurnRow(Base):
    """When an owner's jobs of a queue were last claimed. In each queue, the claims are numbered."""

    __tablename__ = "owner_turns"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    queue: Mapped[str] = mapped_column(String(16), primary_key=True)
    number: Mapped[int] = mapped_column(BigInteger)


class ReportRow(FileColumns, Base):
    """A report about a transit or about a rerun; its id is the identity of the request."""

    __tablename__ = "reports"
    kind: Mapped[str]
    transit_id: Mapped[str | None] = mapped_column(String(64))
    about_id: Mapped[str | None] = mapped_column(String(64))  # the PSF or product of a rerun
    preview_sha256: Mapped[str | None] = mapped_column(String(64))
    details: Mapped[dict[str, Any]]

    __table_args__ = (
        _listed("reports"),
        _listed("reports", "transit_id"),
        _listed("reports", "about_id"),
        _summed("reports"),
    )


class SolutionRow(FileColumns, Base):
    """The kept solution of a transit.

    The solution is removed when it is old or when its room is needed, because a job can make it again.
    """

    __tablename__ = "solutions"


class PartRow(Base):
    """A part of a job that several workers share. A part is open, taken (it has a token), or done (it has a result).

    Parts belong to the request and not to the job. If the job is tried again, the results of its parts are still there.
    """

    __tablename__ = "parts"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    request_key: Mapped[str] = mapped_column(String(64), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    token: Mapped[str | None] = mapped_column(String(32))
    heartbeat_at: Mapped[float | None]
    result: Mapped[dict[str, object] | None] = mapped_column(JSON(none_as_null=True))


class WorkerRow(Base):
    """A running worker process. The process renews its heartbeat, and deletes the row when the process ends."""

    __tablename__ = "workers"
    name: Mapped[str] = mapped_column(
        String(128), primary_key=True
    )  # host:process:random, as in JobRow.worker
    started_at: Mapped[float]
    heartbeat_at: Mapped[float]
    version: Mapped[str] = mapped_column(String(64))


class StageTimeRow(Base):
    """The total time that jobs of a kind spent in a stage, in all attempts. The sum stays when the jobs are deleted."""

    __tablename__ = "stage_times"
    kind: Mapped[str] = mapped_column(String(32), primary_key=True)
    stage: Mapped[str] = mapped_column(String(64), primary_key=True)
    seconds: Mapped[float]
    steps: Mapped[int] = mapped_column(BigInteger)


class OwnerRow(Base):
    """The individual limit of an owner. If ``quota_mib`` is None, the default limit applies."""

    __tablename__ = "owners"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    quota_mib: Mapped[int | None]  # 0: unlimited


class KeyRow(Base):
    """An API key of an owner. Only the hash of the secret is stored."""

    __tablename__ = "keys"
    id: Mapped[str] = mapped_column(String(16), primary_key=True)  # the public part of the key
    owner: Mapped[str] = mapped_column(String(64), index=True)
    secret_sha256: Mapped[str] = mapped_column(String(64))
    scopes: Mapped[list[str]]
    label: Mapped[str] = mapped_column(String(80))
    created_at: Mapped[float]
    expires_at: Mapped[float | None]
    revoked_at: Mapped[float | None]
    last_used_at: Mapped[float | None]
    made_by: Mapped[str | None] = mapped_column(String(16))  # the key with which it was made over HTTP
