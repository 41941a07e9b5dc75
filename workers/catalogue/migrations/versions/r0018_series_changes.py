"""Series whose PSFs may be interpolated, and contexts that keep which series these are."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"


def upgrade() -> None:
    """Create the table, and add the column to the pins of contexts. In existing contexts, no series is interpolated."""
    op.create_table(
        "series_changes",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("owner", sa.String(64), nullable=False),
        sa.Column("series", sa.String(128), nullable=False),
        sa.Column("interpolated", sa.Boolean, nullable=False),
        sa.Column("at", sa.Double, nullable=False),
        sa.Column("by", sa.String(128), nullable=False),
        sa.Column("reason", sa.String(400), nullable=False),
    )
    op.create_index("series_changes_of_a_series", "series_changes", ["owner", "series", "number"])
    op.add_column(
        "psf_pins", sa.Column("interpolated", sa.Boolean, nullable=False, server_default=sa.false())
    )
