"""The tables of bulk runs and of their images."""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, BigInteger, Index, String, text
from sqlalchemy.orm import Mapped, mapped_column

from workers.catalogue.tables import Base

MOST_LETTERS = 1024  # longest path of a file
_OPEN = text("phase IN ('ERROR', 'LISTING', 'PAUSED', 'RUNNING')")


class BulkRow(Base):
    """A bulk run: many images that are deconvolved in the same way.

    A transaction that changes the items of the run also changes its counts.
    """

    __tablename__ = "bulks"
    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    owner: Mapped[str] = mapped_column(String(64))
    name: Mapped[str] = mapped_column(String(80))
    phase: Mapped[str] = mapped_column(String(16))
    request: Mapped[dict[str, Any]]  # without the ids of uploaded images; they are items of the run
    request_key: Mapped[str] = mapped_column(String(64))
    psf_id: Mapped[str | None] = mapped_column(String(64))
    context_id: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[float]
    running_since: Mapped[float | None]
    ended_at: Mapped[float | None]
    listed: Mapped[bool]  # whether all files have been listed as items
    lister: Mapped[str | None] = mapped_column(
        String(32)
    )  # token of the lease of the worker that lists files
    # how far the files are listed (``workers.bulk.listing.Place``); null: the listing has not begun, or it has no files
    listed_to: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    total: Mapped[int] = mapped_column(default=0)
    done: Mapped[int] = mapped_column(default=0)
    reused: Mapped[int] = mapped_column(default=0)  # done images whose product existed before
    failed: Mapped[int] = mapped_column(default=0)
    error: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))

    __table_args__ = (
        Index("bulks_listed", "owner", "created_at", "id"),
        Index("bulks_by_phase", "phase"),
        Index("bulks_ended", "owner", "ended_at", "id"),
        # If two identical requests arrive at the same moment, the second insert fails; the request then finds the first run.
        Index(
            "one_open_bulk_a_request",
            "owner",
            "request_key",
            unique=True,
            sqlite_where=_OPEN,
            postgresql_where=_OPEN,
        ),
    )


class BulkItemRow(Base):
    """An image of a bulk run. The worker that processes it holds the lease ``token`` of the job ``job_id``."""

    __tablename__ = "bulk_items"
    bulk_id: Mapped[str] = mapped_column(String(32), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    uploaded: Mapped[bool]
    source: Mapped[str] = mapped_column(String(MOST_LETTERS))  # an upload's id, or a file's path
    state: Mapped[str] = mapped_column(String(16))
    attempts: Mapped[int] = mapped_column(default=0)
    job_id: Mapped[str | None] = mapped_column(String(32))
    token: Mapped[str | None] = mapped_column(String(32))
    taken_at: Mapped[float | None]
    ended_at: Mapped[float | None]
    reused: Mapped[bool] = mapped_column(default=False)
    image_sha256: Mapped[str | None] = mapped_column(String(64))
    psf_id: Mapped[str | None] = mapped_column(String(64))
    product_id: Mapped[str | None] = mapped_column(String(64))
    kept: Mapped[bool] = mapped_column(default=False)  # whether the product is in the service's store
    output: Mapped[str | None] = mapped_column(String(1200))  # the file in the output folder
    sha256: Mapped[str | None] = mapped_column(String(64))
    bytes: Mapped[int | None] = mapped_column(BigInteger)
    score: Mapped[float | None]  # artefact score
    statistics: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    error: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))

    __table_args__ = (
        Index("bulk_items_by_state", "bulk_id", "state", "position"),
        Index("bulk_items_by_score", "bulk_id", "score", "position"),
        Index("bulk_items_by_end", "bulk_id", "ended_at"),
        Index("bulk_items_by_product", "product_id"),
    )
