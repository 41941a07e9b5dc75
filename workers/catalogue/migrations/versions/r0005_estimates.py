"""What a job was expected to need when it was taken. Of those that are there already nothing is known."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Add the column."""
    op.add_column("jobs", sa.Column("estimate", sa.JSON, nullable=True))
