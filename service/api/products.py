"""Image products: ``/v1/products``."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from service.http import downloads as files
from service.http.callers import Reading, Submitting
from service.http.paging import Cursor, Limit, Page, page, position
from service.http.problems import RESPONSES, Problem
from service.http.state import Shared
from service.views import ProductView
from workers.catalogue.tables import ProductRow
from workers.contract.requests import Identity
from workers.files.collection import remove_unnamed
from workers.files.intact import files_of
from workers.intake.deprecated import details_now

router = APIRouter(prefix="/v1/products", tags=["products"], responses=RESPONSES)


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
    """Products, newest first. `image_id` and `psf_id` select the products of one image or of one PSF."""
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
    """A product's metadata, with links to its files. If its PSF was deprecated since, `details.warnings` says so."""
    row = state.row(ProductRow, product_id, caller.owner)
    return ProductView.of(row, details_now(state.catalogue, row))


@router.get("/{product_id}/file", summary="The product as FITS", response_class=Response)
def get_product_file(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Download the product; its hash is the ETag."""
    row = state.row(ProductRow, product_id, caller.owner)
    name = row.details["filename"]
    return files.send(request, state.store, row.file_sha256, files.FITS_TYPE, name, size=row.bytes)


@router.get(
    "/{product_id}/preview",
    summary="Picture: the image before and after, and the change",
    response_class=Response,
)
def get_product_preview(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """The picture as PNG."""
    return files.send(
        request,
        state.store,
        state.row(ProductRow, product_id, caller.owner).preview_sha256,
        "image/png",
        None,
    )


@router.get("/{product_id}/thumbnail", summary="Small picture of the product", response_class=Response)
def get_product_thumbnail(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """A PNG of the deconvolved image, row 0 at the bottom, whose longer side has at most 192 px."""
    digest = state.row(ProductRow, product_id, caller.owner).details.get("thumbnail_sha256")
    if digest is None:
        raise Problem(
            404,
            "no-thumbnail",
            "expected a product with a thumbnail; this one was made before products had one: use its preview, or delete the "
            "product and submit the job again",
        )
    return files.send(request, state.store, digest, "image/png", None)


@router.get("/{product_id}/changes", summary="Picture of all changes", response_class=Response)
def get_product_changes(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """A PNG that shows the image before and after, the change, difference, ratio and histogram, if the job had `changes_picture` true."""
    digest = state.row(ProductRow, product_id, caller.owner).details.get("changes_picture_sha256")
    if digest is None:
        raise Problem(
            404,
            "no-changes-picture",
            "expected a product whose job had changes_picture true; this job had it false: submit the job again with "
            "changes_picture true",
        )
    return files.send(request, state.store, digest, "image/png", None)


@router.delete("/{product_id}", status_code=204, summary="Delete a product", response_class=Response)
def delete_product(product_id: Identity, caller: Submitting, state: Shared) -> Response:
    """Remove the product from the catalogue and from your quota. The same request makes it again."""
    row = state.row(ProductRow, product_id, caller.owner)
    state.catalogue.delete_product(product_id, caller.owner)
    # The files are deleted at once. Otherwise an owner who deletes products and submits jobs in turn could exceed the
    # quota.
    remove_unnamed(state.catalogue, state.store, [digest for digest, _ in files_of(row)])
    return Response(status_code=204)
