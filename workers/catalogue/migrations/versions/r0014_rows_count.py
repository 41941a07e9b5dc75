"""The database rows of an owner count in the quota, in addition to the files."""

from __future__ import annotations

from alembic import op

revision = "0014"
down_revision = "0013"

# As `workers.catalogue.owners.counted_bytes` counts at this revision: the columns of a row, and its JSON.
ROW_BYTES = 1024
TABLES = {
    "images": "summary",
    "transits": "summary",
    "psfs": "details",
    "products": "details",
    "reports": "details",
}


def upgrade() -> None:
    """Add the rows to the counts of all owners."""
    for table, about in TABLES.items():
        op.execute(
            f"UPDATE owners SET bytes = bytes + coalesce((SELECT sum({ROW_BYTES} + length(CAST({about} AS text))) "
            f"FROM {table} WHERE {table}.owner = owners.owner), 0)"
        )
