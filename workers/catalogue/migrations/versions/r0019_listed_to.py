"""How far the files of a bulk run are listed, so that another worker continues the listing."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"


def upgrade() -> None:
    """Add the column. A run that is being listed has no place: its files are listed again from the start."""
    op.add_column("bulks", sa.Column("listed_to", sa.JSON, nullable=True))
