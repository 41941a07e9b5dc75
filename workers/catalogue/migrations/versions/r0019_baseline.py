"""The tables of version 0.1.0, which upgrades start from. Earlier revisions belonged to development versions."""

from __future__ import annotations

revision = "0019"
down_revision = None


def upgrade() -> None:
    """Do nothing: a database without tables gets the present tables, and is then at the last revision."""
