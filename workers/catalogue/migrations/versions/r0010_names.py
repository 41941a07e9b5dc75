"""New names: series of PSFs (was line), the job kind report (was evaluate), changes of an image (was effects).

This revision renames columns and tables, so workers of the previous version must be stopped before it runs. The keys of
bulk runs are hashes of their requests; they are computed again. All other hashes stay.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"

BATCH = 1000
OLD_PICTURE, NEW_PICTURE = "effects_picture", "changes_picture"
OLD_KIND, NEW_KIND = "evaluate", "report"
# Indexes whose names contain the name of a column. Other indexes need no change: the database renames their columns.
RENAMED_INDEXES = {
    "psfs_listed_by_line": ("psfs_listed_by_series", ["owner", "series", "created_at", "id"]),
    "psfs_listed_by_line_status": (
        "psfs_listed_by_series_status",
        ["owner", "series", "status", "created_at", "id"],
    ),
}

_PRODUCTS = sa.table("products", sa.column("owner"), sa.column("id"), sa.column("details", sa.JSON))
_JOBS = sa.table("jobs", sa.column("id"), sa.column("kind"), sa.column("parameters", sa.JSON))
_BULKS = sa.table("bulks", sa.column("id"), sa.column("request", sa.JSON), sa.column("request_key"))
_ITEMS = sa.table(
    "bulk_items", sa.column("bulk_id"), sa.column("position"), sa.column("uploaded"), sa.column("source")
)


def upgrade() -> None:
    """Rename tables, columns and indexes, and then the names that occur in the rows."""
    op.rename_table("psf_lines", "psf_series")
    # In a new database, the name of a primary key contains the name of its table.
    if op.get_bind().dialect.name == "postgresql":
        op.execute("ALTER INDEX psf_lines_pkey RENAME TO psf_series_pkey")
    for table in ("psfs", "psf_pins", "psf_series"):
        op.execute(f"ALTER TABLE {table} RENAME COLUMN line TO series")
    for old, (new, columns) in RENAMED_INDEXES.items():
        op.drop_index(old, "psfs")
        op.create_index(new, "psfs", columns)
    for name in ("jobs", "reports", "stage_times"):
        rows = sa.table(name, sa.column("kind"))
        op.execute(rows.update().where(rows.c.kind == OLD_KIND).values(kind=NEW_KIND))
    connection = op.get_bind()
    _rename_in_products(connection)
    _rename_in_jobs(connection)
    _rename_in_bulk_runs(connection)


def _rename_in_products(connection: sa.Connection) -> None:
    found = _PRODUCTS.c
    rename = sa.update(_PRODUCTS).where(found.owner == sa.bindparam("of"), found.id == sa.bindparam("key"))
    for rows in _batches(connection, [found.owner, found.id], found.details):
        changed = [
            {"of": owner, "key": identity, "new": _renamed_details(details)}
            for owner, identity, details in rows
        ]
        connection.execute(rename.values(details=sa.bindparam("new")), changed)


def _rename_in_jobs(connection: sa.Connection) -> None:
    """Rename the picture in the parameters of jobs. The parameters of a rerun contain those of the repeated request."""
    found = _JOBS.c
    rename = sa.update(_JOBS).where(found.id == sa.bindparam("key"))
    for rows in _batches(connection, [found.id], found.parameters):
        changed = [
            {"key": identity, "new": renamed}
            for identity, parameters in rows
            if (renamed := _renamed_parameters(parameters)) != parameters
        ]
        if changed:
            connection.execute(rename.values(parameters=sa.bindparam("new")), changed)


def _rename_in_bulk_runs(connection: sa.Connection) -> None:
    found = _BULKS.c
    rename = sa.update(_BULKS).where(found.id == sa.bindparam("key"))
    for rows in _batches(connection, [found.id], found.request):
        changed = []
        for identity, request in rows:
            renamed = _renamed_parameters(request)
            key = _key(renamed, _uploads(connection, identity))
            changed.append({"key": identity, "new": renamed, "new_key": key})
        connection.execute(
            rename.values(request=sa.bindparam("new"), request_key=sa.bindparam("new_key")), changed
        )


def _batches(
    connection: sa.Connection, key: list[sa.ColumnClause[Any]], content: sa.ColumnClause[Any]
) -> Iterator[list[Any]]:
    """All rows of a table, sorted by primary key, in batches, because the JSON of a row is long."""
    place = sa.tuple_(*key)
    after = ("",) * len(key)
    while True:
        query = sa.select(*key, content).where(place > sa.tuple_(*after)).order_by(*key).limit(BATCH)
        rows = list(connection.execute(query))
        if not rows:
            return
        yield rows
        after = tuple(rows[-1][: len(key)])


def _renamed_details(details: dict[str, Any]) -> dict[str, Any]:
    names = {"effects": "changes", f"{OLD_PICTURE}_sha256": f"{NEW_PICTURE}_sha256"}
    return _renamed_parameters({names.get(name, name): value for name, value in details.items()})


def _renamed_parameters(parameters: dict[str, Any]) -> dict[str, Any]:
    """The parameters with the new name of the picture, also in the parameters that they contain."""
    renamed = {NEW_PICTURE if name == OLD_PICTURE else name: value for name, value in parameters.items()}
    if isinstance(renamed.get("parameters"), dict):
        renamed["parameters"] = _renamed_parameters(renamed["parameters"])
    return renamed


def _uploads(connection: sa.Connection, bulk_id: str) -> list[str]:
    items = _ITEMS.c
    query = sa.select(items.source).where(items.bulk_id == bulk_id, items.uploaded == sa.true())
    return list(connection.scalars(query.order_by(items.position)))


def _key(request: dict[str, Any], images: list[str]) -> str:
    """The key of a bulk run's request, as ``workers.bulk.intake`` computes it."""
    content = {**request, "name": None, "images": images}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
