"""Alembic's environment: revisions run on the connection, and in the transaction, of who asks for them."""

from __future__ import annotations

from alembic import context

from workers.catalogue.tables import Base

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    transactional_ddl=True,  # SQLite's is too, where BEGIN is said as workers.catalogue.database says it
)
with context.begin_transaction():
    context.run_migrations()
