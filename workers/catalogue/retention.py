"""Finds what is older than the operator keeps it (setting ``HELIOPSF_KEEP_DAYS``)."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

from sqlalchemy import String, cast, literal, select

from workers.catalogue.bulk_tables import BulkItemRow, BulkRow
from workers.catalogue.database import Queries
from workers.catalogue.tables import ImageRow, JobRow, ProductRow, ReportRow, TransitRow
from workers.contract.bulk import BULK_ENDED
from workers.contract.phases import ENDED

UPLOADS: dict[str, type[Any]] = {"image": ImageRow, "transit": TransitRow}
RESULTS: dict[str, type[Any]] = {"product": ProductRow, "report": ReportRow}
_WORK: dict[str, type[Any]] = {"job": JobRow, "bulk": BulkRow}
_ID = re.compile(r"[0-9a-f]{64}")


class Retention(Queries):
    """Queries for old rows of all owners."""

    def old(
        self, kind: str, before: float, owner: str, others: Collection[str]
    ) -> list[tuple[str, str, int]]:
        """Owner, id and bytes of the rows of a kind that were made before this time; of jobs and bulk runs, that ended
        before this time. Uploads that an unfinished job or bulk run uses are left out.

        owner: only the rows of this owner; empty: the rows of all owners except ``others``.
        """
        table = (UPLOADS | RESULTS | _WORK)[kind]
        at, size = (table.ended_at, literal(0)) if kind in _WORK else (table.created_at, table.bytes)
        query = select(table.owner, table.id, size).where(at < before)
        query = query.where(table.owner == owner) if owner else query.where(table.owner.not_in(others))
        jobs = select(cast(JobRow.parameters, String)).where(JobRow.phase.not_in(ENDED))
        runs = select(BulkRow.id).where(BulkRow.phase.not_in(BULK_ENDED))
        items = select(BulkItemRow.source).where(BulkItemRow.bulk_id.in_(runs))
        with self._database.reading() as session:
            texts = (text for one in (jobs, items) if kind in UPLOADS for text in session.scalars(one))
            used = {identity for text in texts for identity in _ID.findall(text)}
            return [
                (of, identity, size) for of, identity, size in session.execute(query) if identity not in used
            ]
