"""Image products: ``/v1/products``."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, Field

from service.http import downloads as files
from service.http.callers import Caller, Reading
from service.http.paging import Cursor, Limit, Page, page, position
from service.http.problems import RESPONSES, Problem
from service.http.state import Shared
from workers.catalogue.tables import ProductRow
from workers.contract.requests import Identity

router = APIRouter(prefix="/v1/products", tags=["products"], responses=RESPONSES)


class ProductView(BaseModel):
    """A deconvolved image."""

    id: str = Field(description="identity: the hash of input, PSF, method, parameters, algorithm version")
    created_at: float
    kind: str
    image_id: str
    psf_id: str
    psf_version: str
    bytes: int
    sha256: str = Field(description="SHA-256 of the file")
    details: dict[str, Any] = Field(description="method, versions, what changed in the image")
    file: str = Field(description="address of the FITS file")
    preview: str = Field(description="address of the picture: before, after, change")
    effects: str | None = Field(description="address of the picture of all effects, where it was asked for")

    @classmethod
    def of(cls, row: ProductRow) -> ProductView:
        """The view of a row."""
        here = f"/v1/products/{row.id}"
        return cls(
            id=row.id,
            created_at=row.created_at,
            kind=row.kind,
            image_id=row.image_id,
            psf_id=row.psf_id,
            psf_version=row.psf_version,
            bytes=row.bytes,
            sha256=row.file_sha256,
            details=row.details,
            file=f"{here}/file",
            preview=f"{here}/preview",
            effects=f"{here}/effects" if row.details.get("effects_picture_sha256") else None,
        )


@router.get("", summary="List products")
def list_products(
    request: Request,
    caller: Reading,
    state: Shared,
    image_id: Identity | None = None,
    psf_id: Identity | None = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Page[ProductView]:
    """Products, newest first; of one image or of one PSF where asked."""
    rows = state.catalogue.page(
        ProductRow,
        owner=caller.owner,
        limit=limit + 1,
        after=position(cursor),
        image_id=image_id,
        psf_id=psf_id,
    )
    return page(request, rows, limit, ProductView.of)


@router.get("/{product_id}", summary="One product")
def get_product(product_id: Identity, caller: Reading, state: Shared) -> ProductView:
    """What is known of a product."""
    return ProductView.of(_find(state, caller, product_id))


@router.get("/{product_id}/file", summary="The product as FITS", response_class=Response)
def get_product_file(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Download the product; its hash is the ETag."""
    row = _find(state, caller, product_id)
    return files.send(
        request, state.store, row.file_sha256, files.FITS_TYPE, f"heliopsf-{product_id[:12]}.fits"
    )


@router.get(
    "/{product_id}/preview", summary="Before, after and the change, as a picture", response_class=Response
)
def get_product_preview(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """The picture as PNG."""
    return files.send(
        request, state.store, _find(state, caller, product_id).preview_sha256, "image/png", None
    )


@router.get("/{product_id}/effects", summary="What changed, as a picture", response_class=Response)
def get_product_effects(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Before, after, change, difference, ratio and histogram as PNG, where the job was asked for it."""
    digest = _find(state, caller, product_id).details.get("effects_picture_sha256")
    if digest is None:
        raise Problem(
            404,
            "no-effects-picture",
            "expected a product made with changes_picture true; this one was made with false",
        )
    return files.send(request, state.store, digest, "image/png", None)


def _find(state: Shared, caller: Caller, product_id: str) -> ProductRow:
    """The product's row; ``Problem`` 404 where there is none."""
    row = state.catalogue.get(ProductRow, product_id, caller.owner)
    if row is None:
        raise Problem(404, "no-such-product", f"there is no product with id {product_id}")
    return row
