"""Revisions of the catalogue's tables, run by alembic; ``workers.catalogue.schema`` says when."""
