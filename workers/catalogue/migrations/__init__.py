"""Revisions of the catalogue's tables. ``workers.catalogue.schema`` runs them through alembic."""
