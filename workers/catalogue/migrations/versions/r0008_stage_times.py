"""The total time that jobs spent in each stage, by kind. The sums stay when the jobs are deleted."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """Create the table. There are no times of earlier jobs."""
    op.create_table(
        "stage_times",
        sa.Column("kind", sa.String(32), primary_key=True),
        sa.Column("stage", sa.String(64), primary_key=True),
        sa.Column("seconds", sa.Double, nullable=False),
        sa.Column("steps", sa.BigInteger, nullable=False),
    )
