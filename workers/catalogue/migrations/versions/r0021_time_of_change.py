"""Jobs and bulk runs have the time of their last change, by which streams of events find them."""

from __future__ import annotations

from alembic import op
from sqlalchemy import Column, Double

revision = "0021"
down_revision = "0020"


def upgrade() -> None:
    """Add the column: a row changed last when it ended or, if it is open, when it was created."""
    for table in ("jobs", "bulks"):
        op.add_column(table, Column("changed_at", Double, nullable=False, server_default="0"))
        op.execute(f"UPDATE {table} SET changed_at = coalesce(ended_at, created_at)")  # noqa: S608
        op.drop_index(f"{table}_ended", table)
        op.create_index(f"{table}_changed", table, ["owner", "changed_at", "id"])
