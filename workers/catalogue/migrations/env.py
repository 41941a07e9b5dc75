"""Alembic's environment. Revisions run on the connection of the caller, and in the transaction of the caller."""

from __future__ import annotations

from alembic import context

from workers.catalogue.tables import Base

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    transactional_ddl=True,  # also on SQLite, because workers.catalogue.database sends BEGIN itself
)
with context.begin_transaction():
    context.run_migrations()
