"""The bytes that each owner keeps, counted from the existing rows, and the individual limits of owners."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"

COUNTED = ("images", "transits", "psfs", "products", "reports")


def upgrade() -> None:
    """Create the table and fill it."""
    owners = op.create_table(
        "owners",
        sa.Column("owner", sa.String(64), primary_key=True),
        sa.Column("bytes", sa.BigInteger, nullable=False),
        sa.Column("quota_mib", sa.Integer),
    )
    there = [sa.table(name, sa.column("owner"), sa.column("bytes")) for name in COUNTED]
    each = sa.union_all(*(sa.select(table.c.owner, table.c.bytes) for table in there)).subquery()
    total = sa.cast(sa.func.sum(each.c.bytes), sa.BigInteger)
    filled = sa.select(each.c.owner, total).group_by(each.c.owner)
    op.execute(owners.insert().from_select(["owner", "bytes"], filled))
