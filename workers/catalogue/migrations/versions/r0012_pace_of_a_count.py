"""A job counts its steps several times. New columns store the time and the step at which the current count began.

The remaining time of the job is estimated from them.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Add the columns. The remaining time of a job that executes now is unknown until its next count begins."""
    op.add_column("jobs", sa.Column("count_at", sa.Double, nullable=True))
    op.add_column("jobs", sa.Column("count_step", sa.Integer, nullable=False, server_default="0"))
