"""The time and the step at which a job began to count its present steps, from which its time left is estimated."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Add the columns. The time left of a job that executes now is unknown until its next count."""
    op.add_column("jobs", sa.Column("count_at", sa.Double, nullable=True))
    op.add_column("jobs", sa.Column("count_step", sa.Integer, nullable=False, server_default="0"))
