"""The queue of a job. Jobs that are already waiting go to the interactive queue."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Add the column, and an index from which waiting jobs are read in order."""
    op.add_column("jobs", sa.Column("queue", sa.String(16), nullable=False, server_default="interactive"))
    op.create_index("jobs_waiting", "jobs", ["phase", "queue", "created_at", "submitted_at"])
