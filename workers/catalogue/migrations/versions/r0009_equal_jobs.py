"""The identity of a job's result, in addition to its key.

Of several jobs with the same result, only one executes at any time.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"


def upgrade() -> None:
    """Add the column and its index. The key of an existing job is also the identity of its result."""
    op.add_column("jobs", sa.Column("work_key", sa.String(64), nullable=True))
    jobs = sa.table("jobs", sa.column("work_key"), sa.column("request_key"))
    op.execute(jobs.update().where(jobs.c.request_key != "").values(work_key=jobs.c.request_key))
    executing = sa.text("phase = 'EXECUTING'")
    op.create_index(
        "one_at_work_a_result",
        "jobs",
        ["owner", "work_key"],
        unique=True,
        sqlite_where=executing,
        postgresql_where=executing,
    )
