"""The estimate of a job's time and memory, made when the job was submitted. Existing jobs have no estimate."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Add the column."""
    op.add_column("jobs", sa.Column("estimate", sa.JSON, nullable=True))
