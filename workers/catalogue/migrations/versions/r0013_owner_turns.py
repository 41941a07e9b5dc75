"""The order in which the owners of waiting jobs are served."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    """Create the table and the column, and add the owner to an index.

    At first, the table records no turn of any owner.
    """
    op.create_table(
        "owner_turns",
        sa.Column("owner", sa.String(64), primary_key=True),
        sa.Column("queue", sa.String(16), primary_key=True),
        sa.Column("number", sa.BigInteger, nullable=False),
    )
    op.add_column("jobs", sa.Column("delayed", sa.Boolean, nullable=False, server_default=sa.false()))
    op.drop_index("jobs_waiting", "jobs")
    op.create_index("jobs_waiting", "jobs", ["phase", "queue", "created_at", "submitted_at", "owner"])
