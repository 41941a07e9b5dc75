"""Rows without files count in the quota too: jobs, bulk runs with their images, contexts with their pins, changes and parts.

The counts of the owners are stored. This revision adds the existing rows to them, so that no recount is necessary. An owner who
was close to the quota may exceed it afterwards; nothing of such an owner is removed.
"""

from __future__ import annotations

from alembic import op

revision = "0017"
down_revision = "0016"

# As `workers.catalogue.owners.counted_bytes` counts at this revision: the columns of a row, its JSON, and the rows that belong to it.
ROW_BYTES = 1024
COUNTED = {
    "jobs": f"{ROW_BYTES} + length(CAST(parameters AS text))",
    "bulks": f"{ROW_BYTES} * CAST(total + 1 AS bigint) + length(CAST(request AS text))",
    "psf_contexts": f"{ROW_BYTES} * (pins + 1)",
    "psf_changes": f"{ROW_BYTES}",
    "default_contexts": f"{ROW_BYTES}",
    "parts": f"{ROW_BYTES}",
}


def upgrade() -> None:
    """Add the rows to the counts of all owners."""
    for table, counted in COUNTED.items():
        # An owner who has such rows may have no row in the table of owners yet.
        op.execute(
            f"INSERT INTO owners (owner, bytes) SELECT DISTINCT owner, 0 FROM {table} "
            "WHERE owner NOT IN (SELECT owner FROM owners)"
        )
        op.execute(
            f"UPDATE owners SET bytes = bytes + coalesce((SELECT sum({counted}) "
            f"FROM {table} WHERE {table}.owner = owners.owner), 0)"
        )
