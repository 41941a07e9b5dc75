"""Products that were made with a deprecated PSF."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Select, exists, select
from sqlalchemy.orm import Session

from workers.catalogue.database import Queries, newest_first
from workers.catalogue.tables import ProductRow, PsfRow
from workers.versions import PsfStatus

PSFS_AT_A_TIME = 16
MOST_SUCCESSORS = 32


@dataclass(frozen=True)
class AffectedProduct:
    """A product, its PSF, and the certified PSF at the end of the PSF's chain of successors (None if there is none)."""

    product: ProductRow
    psf: PsfRow
    redo_with: PsfRow | None


@dataclass(frozen=True)
class PageEnd:
    """The last product of a page of the list. PSFs are sorted by id; the products of each PSF are sorted newest
    first.
    """

    psf_id: str
    created_at: float
    product_id: str


class AffectedProducts(Queries):
    """Products by the status of their PSF."""

    def of_psf(
        self, psf: PsfRow, *, limit: int, after: tuple[float, str] | None = None
    ) -> list[AffectedProduct]:
        """Products that were made with a PSF, newest first."""
        with self._database.reading() as session:
            return _affected(session, psf, limit, after)

    def replacement(self, psf: PsfRow) -> PsfRow | None:
        """The certified PSF at the end of a PSF's chain of successors; None if there is none."""
        with self._database.reading() as session:
            return _last_successor(session, psf)

    def page(
        self, owner: str, *, superseded: bool, limit: int, after: PageEnd | None = None
    ) -> list[AffectedProduct]:
        """Products that were made with deprecated PSFs.

        The method makes several queries, each of which reads only the rows that it returns. A single query with a join
        would be slower: it would sort all products of a PSF first.

        Parameters
        ----------
        superseded
            Whether to leave out the products of PSFs that have no successor.
        """
        affected: list[AffectedProduct] = []
        with self._database.reading() as session:
            done = ""
            if after is not None:
                psf, done = session.get(PsfRow, (owner, after.psf_id)), after.psf_id
                if psf is not None:
                    affected = _affected(session, psf, limit, (after.created_at, after.product_id))
            while len(affected) < limit:
                psfs = session.scalars(_next_psfs(owner, superseded, done)).all()
                if not psfs:
                    break
                for psf in psfs:
                    affected += _affected(session, psf, limit - len(affected))
                done = psfs[-1].id
        return affected


def _next_psfs(owner: str, superseded: bool, after: str) -> Select[PsfRow]:
    """Deprecated PSFs with which products were made, sorted by id."""
    used = exists().where(ProductRow.owner == PsfRow.owner, ProductRow.psf_id == PsfRow.id)
    query = select(PsfRow).where(
        PsfRow.owner == owner, PsfRow.status == PsfStatus.DEPRECATED, PsfRow.id > after, used
    )
    if superseded:
        query = query.where(PsfRow.successor_id.is_not(None))
    return query.order_by(PsfRow.id).limit(PSFS_AT_A_TIME)


def _affected(
    session: Session, psf: PsfRow, limit: int, after: tuple[float, str] | None = None
) -> list[AffectedProduct]:
    """Products of a PSF, newest first."""
    query = select(ProductRow).where(ProductRow.owner == psf.owner, ProductRow.psf_id == psf.id)
    rows = (
        session.scalars(newest_first(query, (ProductRow.created_at, ProductRow.id), limit, after)).all()
        if limit
        else ()
    )
    redo_with = _last_successor(session, psf) if rows else None
    return [AffectedProduct(row, psf, redo_with) for row in rows]


def _last_successor(session: Session, psf: PsfRow) -> PsfRow | None:
    """The certified PSF at the end of a PSF's chain of successors; None if there is none."""
    at: PsfRow | None = psf
    for _ in range(MOST_SUCCESSORS):
        if at is None or at.successor_id is None:
            break
        at = session.get(PsfRow, (psf.owner, at.successor_id))
    return at if at is not None and at.id != psf.id and at.status == PsfStatus.CERTIFIED else None
