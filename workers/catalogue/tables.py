"""The tables of the catalogue.

Times are seconds since 1970 (UTC). What changes here is brought to databases that are there already by a revision in
``workers/migrations/versions``.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, BigInteger, Double, Index, String, text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from workers.contract.contract import LIVE
from workers.contract.queues import Queue

DEFAULT_OWNER = "local"


class Base(DeclarativeBase):
    """Root of the tables."""

    type_annotation_map = {  # noqa: RUF012 - SQLAlchemy's own convention
        dict[str, Any]: JSON,
        list[str]: JSON,
        float: Double,  # what it means without this depends on SQLAlchemy's version
    }


_RELEASED = text("status IN ('certified', 'deprecated')")
_DEPRECATED = text("status = 'deprecated'")
_EXECUTING = text("phase = 'EXECUTING'")


def _listed(table: str, *by: str) -> Index:
    """The index that a list of an owner's rows is read from in its order, all or those with one value in columns."""
    return Index("_".join((table, "listed", *(("by", *by) if by else ()))), "owner", *by, "created_at", "id")


class Uploaded:
    """Columns of an upload; its id is the hash of its bytes."""

    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float]
    bytes: Mapped[int] = mapped_column(BigInteger, index=True)
    filename: Mapped[str | None]
    summary: Mapped[dict[str, Any]]


class ImageRow(Uploaded, Base):
    """An uploaded image."""

    __tablename__ = "images"
    __table_args__ = (_listed("images"),)


class TransitRow(Uploaded, Base):
    """An uploaded transit, as the archive that was sent."""

    __tablename__ = "transits"
    __table_args__ = (_listed("transits"),)


class PsfRow(Base):
    """A PSF, uploaded, built or fitted. Its content is immutable: another content is another row.

    ``version`` is what its file says, until the PSF is certified under a version of its series.
    """

    __tablename__ = "psfs"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float]
    name: Mapped[str]
    version: Mapped[str]
    instrument: Mapped[str | None]
    channel: Mapped[str | None]  # the wavelength in whole angstrom, as 174
    kind: Mapped[str] = mapped_column(server_default="total")  # total, a component's name, uploaded
    series: Mapped[str | None]  # of these three; none without an instrument
    status: Mapped[str]
    # Of a PSF that is or was certified: times of observation, open ends as infinities.
    valid_from: Mapped[float | None]
    valid_to: Mapped[float | None]
    successor_id: Mapped[str | None] = mapped_column(String(64))
    origin: Mapped[str]  # built | fitted | uploaded
    file_sha256: Mapped[str] = mapped_column(String(64))
    bytes: Mapped[int] = mapped_column(BigInteger)
    preview_sha256: Mapped[str | None] = mapped_column(String(64))
    details: Mapped[dict[str, Any]]

    __table_args__ = (
        Index("psfs_bytes", "origin", "bytes"),
        *(
            _listed("psfs", *by.split())
            for by in (
                "",
                "instrument",
                "channel",
                "kind",
                "series",
                "series status",
                "name",
                "version",
                "status",
            )
        ),
        Index("psfs_by_validity", "owner", "series", "status", "valid_from"),
        # Every version is given once in its series, and never again.
        Index(
            "one_psf_a_version",
            "owner",
            "series",
            "version",
            unique=True,
            sqlite_where=_RELEASED,
            postgresql_where=_RELEASED,
        ),
        Index("psfs_deprecated", "owner", "id", sqlite_where=_DEPRECATED, postgresql_where=_DEPRECATED),
    )


class PsfSeriesRow(Base):
    """A series of PSFs that some PSF was certified in. Who changes what is certified in it holds this row's lock."""

    __tablename__ = "psf_series"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    series: Mapped[str] = mapped_column(String(128), primary_key=True)


class PsfChangeRow(Base):
    """A change of a PSF's status: who made it, when and why. Rows are added and never changed."""

    __tablename__ = "psf_changes"
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    owner: Mapped[str] = mapped_column(String(64))
    psf_id: Mapped[str] = mapped_column(String(64))
    at: Mapped[float]
    by: Mapped[str] = mapped_column(String(128))
    status_before: Mapped[str] = mapped_column(String(16))
    status: Mapped[str] = mapped_column(String(16))
    version_before: Mapped[str]
    version: Mapped[str]
    valid_from: Mapped[float | None]
    valid_to: Mapped[float | None]
    successor_id: Mapped[str | None] = mapped_column(String(64))
    reason: Mapped[str] = mapped_column(String(400))

    __table_args__ = (Index("psf_changes_of_a_psf", "owner", "psf_id", "number"),)


class PsfContextRow(Base):
    """A named set of PSFs, one a series and range of times. Immutable; its id is the hash of its name and its pins."""

    __tablename__ = "psf_contexts"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    name: Mapped[str] = mapped_column(String(80))
    created_at: Mapped[float]
    created_by: Mapped[str] = mapped_column(String(128))
    reason: Mapped[str] = mapped_column(String(400))
    pins: Mapped[int]

    __table_args__ = (
        Index("one_context_a_name", "owner", "name", unique=True),
        _listed("psf_contexts"),
    )


class PsfPinRow(Base):
    """A PSF that a context pins for a series and a range of times of observation."""

    __tablename__ = "psf_pins"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    context_id: Mapped[str] = mapped_column(String(64), primary_key=True)
    series: Mapped[str] = mapped_column(String(128), primary_key=True)
    valid_from: Mapped[float] = mapped_column(primary_key=True)
    valid_to: Mapped[float]
    psf_id: Mapped[str] = mapped_column(String(64))
    version: Mapped[str]


class DefaultContextRow(Base):
    """The context that an owner's images are looked up in from this moment on; none: what is certified. The last counts."""

    __tablename__ = "default_contexts"
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    owner: Mapped[str] = mapped_column(String(64))
    context_id: Mapped[str | None] = mapped_column(String(64))
    at: Mapped[float]
    by: Mapped[str] = mapped_column(String(128))
    reason: Mapped[str] = mapped_column(String(400))

    __table_args__ = (Index("default_contexts_of_an_owner", "owner", "number"),)


class ProductRow(Base):
    """A deconvolved image; its id is the identity of the request that made it."""

    __tablename__ = "products"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float]
    kind: Mapped[str]
    image_id: Mapped[str] = mapped_column(String(64))
    psf_id: Mapped[str] = mapped_column(String(64))
    psf_version: Mapped[str]
    file_sha256: Mapped[str] = mapped_column(String(64))
    bytes: Mapped[int] = mapped_column(BigInteger, index=True)
    preview_sha256: Mapped[str] = mapped_column(String(64))
    details: Mapped[dict[str, Any]]

    __table_args__ = (_listed("products"), _listed("products", "image_id"), _listed("products", "psf_id"))


class JobRow(Base):
    """A job. ``work_key`` is the identity of what it makes; so is ``request_key``, unless an equal live job has that."""

    __tablename__ = "jobs"
    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    owner: Mapped[str] = mapped_column(String(64))
    kind: Mapped[str]
    parameters: Mapped[dict[str, Any]]
    request_key: Mapped[str] = mapped_column(String(64))
    work_key: Mapped[str | None] = mapped_column(String(64))  # none while PENDING
    phase: Mapped[str] = mapped_column(String(16))
    queue: Mapped[str] = mapped_column(String(16), default=Queue.INTERACTIVE, server_default="interactive")
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
    estimate: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))  # when it was taken

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
        # Two jobs that make the same: the second one's claim fails while the first is at work.
        Index(
            "one_at_work_a_result",
            "owner",
            "work_key",
            unique=True,
            sqlite_where=_EXECUTING,
            postgresql_where=_EXECUTING,
        ),
        Index("jobs_by_phase", "phase", "heartbeat_at", "submitted_at"),
        Index("jobs_waiting", "phase", "queue", "created_at", "submitted_at"),
        _listed("jobs"),
        _listed("jobs", "phase"),
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
    """What a study of a transit found (a cross-validation), or a thing made again; its id is the identity of the request."""

    __tablename__ = "reports"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    created_at: Mapped[float]
    kind: Mapped[str]
    transit_id: Mapped[str | None] = mapped_column(String(64))
    about_id: Mapped[str | None] = mapped_column(String(64))  # the PSF or product that was made again
    file_sha256: Mapped[str] = mapped_column(String(64))
    bytes: Mapped[int] = mapped_column(BigInteger, index=True)
    preview_sha256: Mapped[str | None] = mapped_column(String(64))
    details: Mapped[dict[str, Any]]

    __table_args__ = (_listed("reports"), _listed("reports", "transit_id"), _listed("reports", "about_id"))


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


class StageTimeRow(Base):
    """What all attempts of jobs of a kind spent in a stage. It stays when the jobs are gone."""

    __tablename__ = "stage_times"
    kind: Mapped[str] = mapped_column(String(32), primary_key=True)
    stage: Mapped[str] = mapped_column(String(64), primary_key=True)
    seconds: Mapped[float]
    steps: Mapped[int] = mapped_column(BigInteger)


class OwnerRow(Base):
    """How many bytes an owner has kept, and the limit where it is not that of all."""

    __tablename__ = "owners"
    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    bytes: Mapped[int] = mapped_column(BigInteger, default=0)
    quota_mib: Mapped[int | None]  # 0: no limit


class KeyRow(Base):
    """A key that lets its owner in. The secret itself is nowhere: only its hash is kept."""

    __tablename__ = "keys"
    id: Mapped[str] = mapped_column(String(16), primary_key=True)  # the part of the key that may be seen
    owner: Mapped[str] = mapped_column(String(64), index=True)
    secret_sha256: Mapped[str] = mapped_column(String(64))
    scopes: Mapped[list[str]]
    label: Mapped[str] = mapped_column(String(80))
    created_at: Mapped[float]
    expires_at: Mapped[float | None]
    revoked_at: Mapped[float | None]
    last_used_at: Mapped[float | None]
