"""Revisions of the catalogue's tables, run by alembic; ``workers.schema`` says when."""
