"""Indexes for streams of events: the jobs and bulk runs of an owner, in the order in which they ended."""

from __future__ import annotations

from alembic import op

revision = "0016"
down_revision = "0015"


def upgrade() -> None:
    """Create the indexes."""
    for table in ("jobs", "bulks"):
        op.create_index(f"{table}_ended", table, ["owner", "ended_at", "id"])
