"""Bulk runs: many images deconvolved in the same way."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"

_OPEN = sa.text("phase IN ('ERROR', 'LISTING', 'PAUSED', 'RUNNING')")


def upgrade() -> None:
    """Create the tables of bulk runs and of their images."""
    op.create_table(
        "bulks",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("owner", sa.String(64), nullable=False),
        sa.Column("name", sa.String(80), nullable=False),
        sa.Column("phase", sa.String(16), nullable=False),
        sa.Column("request", sa.JSON, nullable=False),
        sa.Column("request_key", sa.String(64), nullable=False),
        sa.Column("psf_id", sa.String(64)),
        sa.Column("context_id", sa.String(64)),
        sa.Column("created_at", sa.Double, nullable=False),
        sa.Column("running_since", sa.Double),
        sa.Column("ended_at", sa.Double),
        sa.Column("listed", sa.Boolean, nullable=False),
        sa.Column("lister", sa.String(32)),
        sa.Column("total", sa.Integer, nullable=False),
        sa.Column("done", sa.Integer, nullable=False),
        sa.Column("reused", sa.Integer, nullable=False),
        sa.Column("failed", sa.Integer, nullable=False),
        sa.Column("error", sa.JSON),
        sa.Index("bulks_listed", "owner", "created_at", "id"),
        sa.Index("bulks_by_phase", "phase"),
        sa.Index(
            "one_open_bulk_a_request",
            "owner",
            "request_key",
            unique=True,
            sqlite_where=_OPEN,
            postgresql_where=_OPEN,
        ),
    )
    op.create_table(
        "bulk_items",
        sa.Column("bulk_id", sa.String(32), primary_key=True),
        sa.Column("position", sa.Integer, primary_key=True),
        sa.Column("uploaded", sa.Boolean, nullable=False),
        sa.Column("source", sa.String(1024), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("job_id", sa.String(32)),
        sa.Column("token", sa.String(32)),
        sa.Column("taken_at", sa.Double),
        sa.Column("ended_at", sa.Double),
        sa.Column("reused", sa.Boolean, nullable=False),
        sa.Column("image_sha256", sa.String(64)),
        sa.Column("psf_id", sa.String(64)),
        sa.Column("product_id", sa.String(64)),
        sa.Column("kept", sa.Boolean, nullable=False),
        sa.Column("output", sa.String(1200)),
        sa.Column("sha256", sa.String(64)),
        sa.Column("bytes", sa.BigInteger),
        sa.Column("score", sa.Double),
        sa.Column("statistics", sa.JSON),
        sa.Column("error", sa.JSON),
        sa.Index("bulk_items_by_state", "bulk_id", "state", "position"),
        sa.Index("bulk_items_by_score", "bulk_id", "score", "position"),
        sa.Index("bulk_items_by_end", "bulk_id", "ended_at"),
        sa.Index("bulk_items_by_product", "product_id"),
    )
