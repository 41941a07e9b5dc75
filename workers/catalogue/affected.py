"""Products that were made with a deprecated PSF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from sqlalchemy import Select, exists, select
from sqlalchemy.orm import Session

from workers.catalogue.database import Queries, newest_first
from workers.catalogue.tables import ProductRow, PsfRow
from workers.versions import PsfStatus

PSFS_AT_A_TIME = 16
MOST_SUCCESSORS = 32


@dataclass(frozen=True)
class Affected:
    """A product, its PSF, and the certified PSF at the end of the PSF's chain of successors (None if there is none)."""

    product: ProductRow
    psf: PsfRow
    redo_with: PsfRow | None


@dataclass(frozen=True)
class PageEnd:
    """The last product of a page of the list. PSFs are sorted by id; the products of each PSF are sorted newest first."""

    psf_id: str
    created_at: float
    product_id: str


class AffectedProducts(Queries):
    """Products by the status of their PSF."""

    def of_psf(self, psf: PsfRow, *, limit: int, after: tuple[float, str] | None = None) -> list[Affected]:
        """Products that were made with a PSF, newest first."""
        with self._database.reading() as session:
            return _affected(session, [psf], session.scalars(_products(psf, limit, after)).all())

    def replacement(self, psf: PsfRow) -> PsfRow | None:
        """The certified PSF at the end of a PSF's chain of successors; None if there is none."""
        with self._database.reading() as session:
            return _last_successor(_with_successors(session, [psf]), psf)

    def page(
        self, owner: str, *, superseded: bool, limit: int, after: PageEnd | None = None
    ) -> list[Affected]:
        """Products that were made with deprecated PSFs. superseded: only PSFs that have a successor.

        The method makes several queries, each of which reads only the rows that it returns. A single query with a join
        would be slower: it would sort all products of a PSF first.
        """
        affected: list[Affected] = []
        with self._database.reading() as session:
            done = ""
            if after is not None:
                psf, done = session.get(PsfRow, (owner, after.psf_id)), after.psf_id
                if psf is not None:
                    rest = _products(psf, limit, (after.created_at, after.product_id))
                    affected += _affected(session, [psf], session.scalars(rest).all())
            while len(affected) < limit:
                psfs = session.scalars(_next_psfs(owner, superseded, done)).all()
                if not psfs:
                    break
                rows = (session.scalars(_products(psf, limit - len(affected))) for psf in psfs)
                affected += _affected(session, psfs, list(chain.from_iterable(rows)))
                done = psfs[-1].id
        return affected[:limit]


def _next_psfs(owner: str, superseded: bool, after: str) -> Select[Any]:
    """Deprecated PSFs with which products were made, sorted by id."""
    used = exists().where(ProductRow.owner == PsfRow.owner, ProductRow.psf_id == PsfRow.id)
    query = select(PsfRow).where(
        PsfRow.owner == owner, PsfRow.status == PsfStatus.DEPRECATED, PsfRow.id > after, used
    )
    if superseded:
        query = query.where(PsfRow.successor_id.is_not(None))
    return query.order_by(PsfRow.id).limit(PSFS_AT_A_TIME)


def _products(psf: PsfRow, limit: int, after: tuple[float, str] | None = None) -> Select[Any]:
    """Products of a PSF, newest first."""
    query = select(ProductRow).where(ProductRow.owner == psf.owner, ProductRow.psf_id == psf.id)
    return newest_first(query, ProductRow, limit, after)


def _affected(session: Session, psfs: Sequence[PsfRow], products: Sequence[ProductRow]) -> list[Affected]:
    """For each product: its PSF, and the certified PSF at the end of the chain of successors of this PSF."""
    known = _with_successors(session, psfs)
    return [Affected(row, known[row.psf_id], _last_successor(known, known[row.psf_id])) for row in products]


def _with_successors(session: Session, psfs: Sequence[PsfRow]) -> dict[str, PsfRow]:
    """These PSFs and all PSFs in their chains of successors, by id. All PSFs must have the same owner."""
    known = {psf.id: psf for psf in psfs}
    for _ in range(MOST_SUCCESSORS):
        further = {psf.successor_id for psf in known.values() if psf.successor_id is not None} - known.keys()
        if not further:
            break
        query = select(PsfRow).where(PsfRow.owner == psfs[0].owner, PsfRow.id.in_(sorted(further)))
        rows = session.scalars(query).all()
        if not rows:
            break
        known |= {row.id: row for row in rows}
    return known


def _last_successor(known: dict[str, PsfRow], psf: PsfRow) -> PsfRow | None:
    """The certified PSF at the end of the PSF's chain of successors; None if there is none."""
    at: PsfRow | None = psf
    for _ in range(MOST_SUCCESSORS):
        if at is None or at.successor_id is None:
            break
        at = known.get(at.successor_id)
    return at if at is not None and at is not psf and at.status == PsfStatus.CERTIFIED else None
