"""The quota is the sum of the bytes of an owner's files, which is read from the rows of the files."""

from __future__ import annotations

from alembic import op

revision = "0020"
down_revision = "0019"


def upgrade() -> None:
    """Remove the kept sum, and let the indexes of the sizes begin with the owner."""
    op.drop_column("owners", "bytes")
    for table in ("images", "transits", "products", "reports"):
        op.drop_index(f"ix_{table}_bytes", table)
    for table in ("images", "transits", "psfs", "products", "reports"):
        op.create_index(f"{table}_summed", table, ["owner", "bytes"])
