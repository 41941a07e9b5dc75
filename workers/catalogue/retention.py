"""Finds what is older than the operator keeps it (setting ``HELIOPSF_KEEP_DAYS``)."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

from sqlalchemy import String, cast, literal, select

from workers.catalogue.bulk_tables import BulkItemRow, BulkRow
from workers.catalogue.database import Queries
from workers.catalogue.tables import ImageRow, JobRow, ProductRow, ReportRow, TransitRow
from workers.contract.bulk import DELETABLE, OPEN, ItemState
from workers.contract.phases import ENDED

TABLES: dict[str, type[Any]] = {
    "image": ImageRow,
    "transit": TransitRow,
    "product": ProductRow,
    "report": ReportRow,
    "job": JobRow,
    "bulk": BulkRow,
}
_UPLOADS = ("image", "transit")
_ID = re.compile(r"[0-9a-f]{64}")


class Retention(Queries):
    """Queries for old rows of all owners."""

    def old(
        self, kind: str, before: float, owner: str, others: Collection[str]
    ) -> list[tuple[str, str, int]]:
        """Owner, id and bytes of the rows of a kind that were made before this time; of jobs and bulk runs, that ended
        before this time. Uploads that a waiting or running job or bulk run uses are left out.

        owner: only the rows of this owner; empty: the rows of all owners except ``others``.
        """
        table = TABLES[kind]
        made_at = table.ended_at if kind in ("job", "bulk") else table.created_at
        size = table.bytes if hasattr(table, "bytes") else literal(0)
        query = select(table.owner, table.id, size).where(made_at < before)
        query = query.where(table.owner == owner) if owner else query.where(table.owner.not_in(others))
        if kind == "bulk":
            query = query.where(BulkRow.phase.in_(sorted(DELETABLE - OPEN)))
        with self._database.reading() as session:
            used: set[str] = set()
            if kind in _UPLOADS:
                jobs = select(cast(JobRow.parameters, String)).where(JobRow.phase.not_in(sorted(ENDED)))
                runs = select(BulkRow.id).where(BulkRow.phase.in_(sorted(OPEN)))
                items = select(BulkItemRow.source).where(
                    BulkItemRow.bulk_id.in_(runs), BulkItemRow.state.in_((ItemState.WAITING, ItemState.TAKEN))
                )
                texts = (text for one in (jobs, items) for text in session.scalars(one))
                used = {identity for text in texts for identity in _ID.findall(text)}
            return [
                (of, identity, size) for of, identity, size in session.execute(query) if identity not in used
            ]
