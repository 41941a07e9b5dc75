"""Products made with deprecated PSFs: ``/v1/affected``, ``/v1/psfs/{id}/affected``."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, Field

from service.http import paging
from service.http.callers import Reading
from service.http.paging import Cursor, Limit, Page
from service.http.problems import RESPONSES
from service.http.state import Shared
from workers.catalogue.affected import Affected, Place
from workers.catalogue.tables import PsfRow
from workers.contract.requests import Identity

router = APIRouter(tags=["PSFs"], responses=RESPONSES)


class AffectedView(BaseModel):
    """A product, the PSF that made it, and the replacement of this PSF, if there is one."""

    product_id: str
    image_id: str
    created_at: float
    psf_id: str
    psf_version: str = Field(description="version of the PSF when the product was made")
    psf_status: str
    successor: str | None
    redo_with: str | None = Field(
        description="id of the replacement PSF, which is the certified PSF at the end of the chain of successors; null: there is no replacement"
    )

    @classmethod
    def of(cls, one: Affected) -> AffectedView:
        """The description of an affected product and its PSF, from their rows in the catalogue."""
        return cls(
            product_id=one.product.id,
            image_id=one.product.image_id,
            created_at=one.product.created_at,
            psf_id=one.psf.id,
            psf_version=one.product.psf_version,
            psf_status=one.psf.status,
            successor=one.psf.successor_id,
            redo_with=None if one.redo_with is None else one.redo_with.id,
        )


@router.get("/v1/affected", summary="Products made with deprecated PSFs")
def list_affected(
    request: Request,
    caller: Reading,
    state: Shared,
    superseded: Annotated[bool, Query(description="only products whose PSF has a successor")] = False,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Page[AffectedView]:
    """Products whose PSF is deprecated, sorted by PSF; the products of each PSF are listed newest first."""
    at = paging.place(cursor, 3)
    after = None if at is None else Place(at[0], paging.number(at[1]), at[2])
    found = state.catalogue.affected.page(caller.owner, superseded=superseded, limit=limit + 1, after=after)
    return _page(request, found, limit, whole=True)


@router.get("/v1/psfs/{psf_id}/affected", summary="Products made with a PSF")
def list_affected_by_psf(
    psf_id: Identity,
    request: Request,
    caller: Reading,
    state: Shared,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Page[AffectedView]:
    """Products made with this PSF, which may have any status. The newest product is listed first."""
    psf = state.row(PsfRow, psf_id, caller.owner)
    found = state.catalogue.affected.of_psf(psf, limit=limit + 1, after=paging.position(cursor))
    return _page(request, found, limit, whole=False)


def _page(request: Request, found: list[Affected], limit: int, *, whole: bool) -> Page[AffectedView]:
    following = None
    if len(found) > limit:
        last = found[limit - 1]
        place = (repr(last.product.created_at), last.product.id)
        following = paging.following(request, *((last.psf.id, *place) if whole else place))
    return Page(items=[AffectedView.of(one) for one in found[:limit]], next=following)
