"""The tables as they were when revisions began.

Versions without revisions created missing tables and indexes at each start. This revision does the same in a database
that such a version made.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from workers.catalogue.database import make_missing

revision = "0001"
down_revision = None

METADATA = sa.MetaData()
_LIVE = sa.text("phase IN ('COMPLETED', 'EXECUTING', 'QUEUED')")


def _owned(name: str, *columns: sa.Column[object] | sa.Index) -> sa.Table:
    """A table whose rows have an owner and an identity."""
    return sa.Table(
        name,
        METADATA,
        sa.Column("owner", sa.String(64), primary_key=True),
        sa.Column("id", sa.String(64), primary_key=True),
        sa.Column("created_at", sa.Double, nullable=False, index=True),
        *columns,
    )


for _upload in ("images", "transits"):
    _owned(
        _upload,
        sa.Column("bytes", sa.BigInteger, nullable=False, index=True),
        sa.Column("filename", sa.String),
        sa.Column("summary", sa.JSON, nullable=False),
    )
_owned(
    "psfs",
    sa.Column("name", sa.String, nullable=False),
    sa.Column("version", sa.String, nullable=False),
    sa.Column("instrument", sa.String, index=True),
    sa.Column("status", sa.String, nullable=False),
    sa.Column("origin", sa.String, nullable=False),
    sa.Column("file_sha256", sa.String(64), nullable=False),
    sa.Column("bytes", sa.BigInteger, nullable=False),
    sa.Column("preview_sha256", sa.String(64)),
    sa.Column("details", sa.JSON, nullable=False),
    sa.Index("psfs_bytes", "origin", "bytes"),
)
_owned(
    "products",
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("image_id", sa.String(64), nullable=False, index=True),
    sa.Column("psf_id", sa.String(64), nullable=False, index=True),
    sa.Column("psf_version", sa.String, nullable=False),
    sa.Column("file_sha256", sa.String(64), nullable=False),
    sa.Column("bytes", sa.BigInteger, nullable=False, index=True),
    sa.Column("preview_sha256", sa.String(64), nullable=False),
    sa.Column("details", sa.JSON, nullable=False),
)
_owned(
    "reports",
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("transit_id", sa.String(64), nullable=False, index=True),
    sa.Column("file_sha256", sa.String(64), nullable=False),
    sa.Column("bytes", sa.BigInteger, nullable=False, index=True),
    sa.Column("preview_sha256", sa.String(64)),
    sa.Column("details", sa.JSON, nullable=False),
)
sa.Table(
    "jobs",
    METADATA,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("owner", sa.String(64), nullable=False),
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("parameters", sa.JSON, nullable=False),
    sa.Column("request_key", sa.String(64), nullable=False),
    sa.Column("phase", sa.String(16), nullable=False),
    sa.Column("created_at", sa.Double, nullable=False, index=True),
    sa.Column("started_at", sa.Double),
    sa.Column("ended_at", sa.Double),
    sa.Column("submitted_at", sa.Double),
    sa.Column("submissions", sa.Integer, nullable=False),
    sa.Column("attempt", sa.Integer, nullable=False),
    sa.Column("lease", sa.String(32)),
    sa.Column("heartbeat_at", sa.Double),
    sa.Column("worker", sa.String),
    sa.Column("cancel_requested", sa.Boolean, nullable=False),
    sa.Column("step", sa.Integer, nullable=False),
    sa.Column("steps", sa.Integer, nullable=False),
    sa.Column("stage", sa.String, nullable=False),
    sa.Column("result_id", sa.String(64)),
    sa.Column("error", sa.JSON),
    sa.Index(
        "one_live_job_a_request",
        "owner",
        "request_key",
        unique=True,
        sqlite_where=_LIVE,
        postgresql_where=_LIVE,
    ),
    sa.Index("jobs_by_phase", "phase", "heartbeat_at", "submitted_at"),
    sa.Index("jobs_tallied", "kind", "phase", "attempt", "started_at", "ended_at"),
)
sa.Table(
    "job_terms",
    METADATA,
    sa.Column("job_id", sa.String(32), primary_key=True),
    sa.Column("run_id", sa.String),
    sa.Column("execution_duration_s", sa.Integer, nullable=False),
    sa.Column("destruction_at", sa.Double, index=True),
)
sa.Table(
    "parts",
    METADATA,
    sa.Column("owner", sa.String(64), primary_key=True),
    sa.Column("request_key", sa.String(64), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True),
    sa.Column("token", sa.String(32)),
    sa.Column("heartbeat_at", sa.Double),
    sa.Column("result", sa.JSON),
)
sa.Table(
    "workers",
    METADATA,
    sa.Column("name", sa.String(128), primary_key=True),
    sa.Column("started_at", sa.Double, nullable=False),
    sa.Column("heartbeat_at", sa.Double, nullable=False),
    sa.Column("version", sa.String(64), nullable=False),
)


def upgrade() -> None:
    """Create the missing tables and indexes."""
    make_missing(METADATA, op.get_bind())
