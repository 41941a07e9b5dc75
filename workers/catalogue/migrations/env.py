"""Alembic's environment. Revisions run on the connection of the caller, and in the transaction of the caller.

The folder ``versions`` has one file per revision, in order. A released revision never changes; if it is wrong, a later
revision corrects it. The first revision changes nothing: the tables of a new database are made from
``workers.catalogue.tables``, and the database then is at the last revision. The later revisions change the tables of
existing databases. They import nothing from ``workers.catalogue.tables``, because those tables change later. New
columns have a default in the database, so that workers of the previous version can continue to work until they are
restarted.
"""

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
