"""Revisions of the catalogue's tables. ``workers.catalogue.schema`` runs them with Alembic."""
