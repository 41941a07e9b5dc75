"""Series of PSFs (called lines in this revision), with status, validity and successors; contexts; reruns.

The line of a PSF is computed from its row. Every existing PSF becomes a draft, because no PSF was certified before. Every
list gets an index.
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"

BATCH = 1000
# Lists, by table and by the columns that filter them.
LISTED = {
    "images": ("",),
    "transits": ("",),
    "psfs": ("", "instrument", "channel", "kind", "line", "line status", "name", "version", "status"),
    "products": ("", "image_id", "psf_id"),
    "reports": ("", "transit_id", "about_id"),
    "jobs": ("", "phase"),
    "psf_contexts": ("",),
}
# Old indexes that do not begin with the owner or do not have the order of a list.
REPLACED = {
    "images": ("created_at",),
    "transits": ("created_at",),
    "psfs": ("created_at", "instrument"),
    "products": ("created_at", "image_id", "psf_id"),
    "reports": ("created_at", "transit_id"),
}
RELEASED = sa.text("status IN ('certified', 'deprecated')")
DEPRECATED = sa.text("status = 'deprecated'")
# The channels of the instruments of earlier versions, for PSFs whose fit did not store a wavelength.
CHANNELS = {"hri_euv": "174", "aia_171": "171"}

_PSFS = sa.table(
    "psfs",
    *(
        sa.column(name)
        for name in ("owner", "id", "instrument", "origin", "channel", "kind", "line", "status")
    ),
    sa.column("details", sa.JSON),
)


def upgrade() -> None:
    """Add the new columns, tables and indexes. Fill in channel, kind, line and status of the existing PSFs."""
    for table, replaced in REPLACED.items():
        for column in replaced:
            op.drop_index(f"ix_{table}_{column}", table)
    _new_columns()
    _new_tables()
    _fill(op.get_bind())
    for table, narrowed in LISTED.items():
        for by in narrowed:
            name = "_".join((table, "listed", *(("by", *by.split()) if by else ())))
            op.create_index(name, table, ["owner", *by.split(), "created_at", "id"])
    op.create_index("psfs_by_validity", "psfs", ["owner", "line", "status", "valid_from"])
    op.create_index(
        "one_psf_a_version",
        "psfs",
        ["owner", "line", "version"],
        unique=True,
        sqlite_where=RELEASED,
        postgresql_where=RELEASED,
    )
    op.create_index(
        "psfs_deprecated", "psfs", ["owner", "id"], sqlite_where=DEPRECATED, postgresql_where=DEPRECATED
    )


def _new_columns() -> None:
    op.add_column("psfs", sa.Column("channel", sa.String))
    op.add_column("psfs", sa.Column("kind", sa.String, nullable=False, server_default="total"))
    op.add_column("psfs", sa.Column("line", sa.String))
    op.add_column("psfs", sa.Column("valid_from", sa.Double))
    op.add_column("psfs", sa.Column("valid_to", sa.Double))
    op.add_column("psfs", sa.Column("successor_id", sa.String(64)))
    with op.batch_alter_table("reports") as reports:  # on SQLite this copies the table
        reports.alter_column("transit_id", existing_type=sa.String(64), nullable=True)
        reports.add_column(sa.Column("about_id", sa.String(64)))


def _new_tables() -> None:
    op.create_table(
        "psf_lines",
        sa.Column("owner", sa.String(64), primary_key=True),
        sa.Column("line", sa.String(128), primary_key=True),
    )
    op.create_table(
        "psf_changes",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("owner", sa.String(64), nullable=False),
        sa.Column("psf_id", sa.String(64), nullable=False),
        sa.Column("at", sa.Double, nullable=False),
        sa.Column("by", sa.String(128), nullable=False),
        sa.Column("status_before", sa.String(16), nullable=False),
        sa.Column("status", sa.String(16), nullable=False),
        sa.Column("version_before", sa.String, nullable=False),
        sa.Column("version", sa.String, nullable=False),
        sa.Column("valid_from", sa.Double),
        sa.Column("valid_to", sa.Double),
        sa.Column("successor_id", sa.String(64)),
        sa.Column("reason", sa.String(400), nullable=False),
        sa.Index("psf_changes_of_a_psf", "owner", "psf_id", "number"),
    )
    op.create_table(
        "psf_contexts",
        sa.Column("owner", sa.String(64), primary_key=True),
        sa.Column("id", sa.String(64), primary_key=True),
        sa.Column("name", sa.String(80), nullable=False),
        sa.Column("created_at", sa.Double, nullable=False),
        sa.Column("created_by", sa.String(128), nullable=False),
        sa.Column("reason", sa.String(400), nullable=False),
        sa.Column("pins", sa.Integer, nullable=False),
        sa.Index("one_context_a_name", "owner", "name", unique=True),
    )
    op.create_table(
        "psf_pins",
        sa.Column("owner", sa.String(64), primary_key=True),
        sa.Column("context_id", sa.String(64), primary_key=True),
        sa.Column("line", sa.String(128), primary_key=True),
        sa.Column("valid_from", sa.Double, primary_key=True),
        sa.Column("valid_to", sa.Double, nullable=False),
        sa.Column("psf_id", sa.String(64), nullable=False),
        sa.Column("version", sa.String, nullable=False),
    )
    op.create_table(
        "default_contexts",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("owner", sa.String(64), nullable=False),
        sa.Column("context_id", sa.String(64)),
        sa.Column("at", sa.Double, nullable=False),
        sa.Column("by", sa.String(128), nullable=False),
        sa.Column("reason", sa.String(400), nullable=False),
        sa.Index("default_contexts_of_an_owner", "owner", "number"),
    )


def _fill(connection: sa.Connection) -> None:
    """Fill in channel, kind, line and status of the existing PSFs. Rows are read in batches, because their details are long."""
    key = sa.tuple_(_PSFS.c.owner, _PSFS.c.id)
    columns = (_PSFS.c.owner, _PSFS.c.id, _PSFS.c.instrument, _PSFS.c.origin, _PSFS.c.details)
    after = ("", "")
    while True:
        query = sa.select(*columns).where(key > sa.tuple_(*after)).order_by(*key.clauses).limit(BATCH)
        rows = connection.execute(query).all()
        if not rows:
            return
        connection.execute(
            sa.update(_PSFS)
            .where(_PSFS.c.owner == sa.bindparam("of"), _PSFS.c.id == sa.bindparam("key"))
            .values({name: sa.bindparam(name) for name in ("channel", "kind", "line", "status")}),
            [_said(*row) for row in rows],
        )
        after = (rows[-1].owner, rows[-1].id)


def _said(
    owner: str, identity: str, instrument: str | None, origin: str, details: dict[str, Any]
) -> dict[str, Any]:
    """The new columns of one PSF: its channel, kind, line and status. `of` and `key` are its owner and id."""
    wavelength = details.get("wavelength_angstrom")
    channel = CHANNELS.get(instrument or "") if wavelength is None else str(round(wavelength))
    parameters = (details.get("provenance") or {}).get("parameters") or {}
    kind = "uploaded" if origin == "uploaded" else parameters.get("component") or "total"
    return {
        "of": owner,
        "key": identity,
        "channel": channel,
        "kind": kind,
        "line": f"{instrument}/{channel or '-'}/{kind}" if instrument else None,
        "status": "draft",
    }
