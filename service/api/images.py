"""Uploaded images, ``/v1/images``, and the products of their deconvolutions, ``/v1/products``; and for PSFs and
products their lineage, ``.../lineage`` and ``.../provenance``, and reruns, ``.../rerun``.
"""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field

from service.api.jobs import submit_job
from service.http import files
from service.http.callers import Reading, Submitting
from service.http.gate import in_turn
from service.http.paging import Page, Paging
from service.http.problems import RESPONSES, RouteOptions
from service.http.state import Shared
from service.views import JobView, ProductView, RowView
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow
from workers.contract.kinds import REQUESTS
from workers.contract.requests import Identity, Rerun
from workers.files.garbage import files_of, remove_unnamed
from workers.intake.compatibility import details_now
from workers.lineage import Ancestor, Format, lineage, provenance_text

MEDIA_TYPES: dict[Format, str] = {"json": "application/json", "provn": "text/provenance-notation"}
FILES: dict[Format, str] = {"json": "prov.json", "provn": "provn"}
FORMAT = Query(description="`json`: PROV-JSON; `provn`: PROV-N")
PROV: RouteOptions = {
    "response_class": Response,
    "responses": {
        200: {
            "description": "A PROV document: entities by hash, activities by job, agents by owner and software version",
            "content": {
                MEDIA_TYPES["json"]: {"schema": {"type": "object"}},
                MEDIA_TYPES["provn"]: {"schema": {"type": "string"}},
            },
        }
    },
}
router = APIRouter(prefix="/v1/images", tags=["images"], responses=RESPONSES)
products = APIRouter(prefix="/v1/products", tags=["products"], responses=RESPONSES)
lineages = APIRouter(tags=["lineage"], responses=RESPONSES)


class ImageView(RowView):
    """An uploaded image."""

    id: str = Field(description="SHA-256 of the file")
    created_at: float
    bytes: int
    filename: str | None
    header: dict[str, object] = Field(description="summary of the FITS header")

    @classmethod
    def of(cls, row: ImageRow) -> ImageView:
        """The description of an image, from its row in the catalogue."""
        return cls.of_columns(row, header=row.summary)


@router.post(
    "",
    status_code=201,
    summary="Upload a FITS image",
    openapi_extra=files.OPENAPI_BODY,
    responses={200: {"model": ImageView, "description": "The same file was already uploaded."}},
)
async def upload_image(request: Request, response: Response, caller: Submitting, state: Shared) -> ImageView:
    """Upload one FITS file. The header is checked at upload. The pixels are read by the jobs that use the image."""
    return ImageView.of(await files.add_upload(request, response, caller, state, files.IMAGE))


@router.get("", summary="List uploaded images")
def list_images(paging: Paging, caller: Reading, state: Shared) -> Page[ImageView]:
    """Uploaded images, newest first."""
    return paging.page(state.catalogue.page(ImageRow, owner=caller.owner, **paging.query), ImageView.of)


@router.get("/{image_id}", summary="One uploaded image")
def get_image(image_id: Identity, caller: Reading, state: Shared) -> ImageView:
    """An uploaded image's metadata and a summary of its header."""
    return ImageView.of(state.row(ImageRow, image_id, caller.owner))


@router.get("/{image_id}/file", summary="The uploaded file", response_class=Response)
def get_image_file(image_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Download the file as it was uploaded; its hash is the ETag."""
    row = state.row(ImageRow, image_id, caller.owner)
    gzipped = bool(row.summary.get("gzipped"))
    name = row.filename or f"image-{image_id[:12]}.fits{'.gz' if gzipped else ''}"
    media_type = files.GZIP_TYPE if gzipped else files.FITS_TYPE
    return files.send(request, state.store, image_id, media_type, name, size=row.bytes)


@products.get("", summary="List products")
def list_products(
    paging: Paging,
    caller: Reading,
    state: Shared,
    image_id: Identity | None = None,
    psf_id: Identity | None = None,
) -> Page[ProductView]:
    """Products, newest first. `image_id` and `psf_id` select the products of one image or of one PSF."""
    rows = state.catalogue.page(
        ProductRow, owner=caller.owner, image_id=image_id, psf_id=psf_id, **paging.query
    )
    return paging.page(rows, ProductView.of)


@products.get("/{product_id}", summary="One product")
def get_product(product_id: Identity, caller: Reading, state: Shared) -> ProductView:
    """A product's metadata, with links to its files. If its PSF was deprecated since, `details.warnings` says so."""
    row = state.row(ProductRow, product_id, caller.owner)
    return ProductView.of(row, details_now(state.catalogue, row))


@products.get("/{product_id}/file", summary="The product as FITS", response_class=Response)
def get_product_file(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Download the product; its hash is the ETag."""
    row = state.row(ProductRow, product_id, caller.owner)
    name = row.details["filename"]
    return files.send(request, state.store, row.file_sha256, files.FITS_TYPE, name, size=row.bytes)


@products.get(
    "/{product_id}/preview",
    summary="Picture: the image before and after, and the change",
    response_class=Response,
)
def get_product_preview(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """The picture as PNG."""
    row = state.row(ProductRow, product_id, caller.owner)
    return files.send(request, state.store, row.preview_sha256, "image/png", None)


@products.get("/{product_id}/thumbnail", summary="Small picture of the product", response_class=Response)
def get_product_thumbnail(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """A PNG of the deconvolved image, row 0 at the bottom, whose longer side has at most 192 px."""
    digest = state.row(ProductRow, product_id, caller.owner).details.get("thumbnail_sha256")
    missing = (
        "no-thumbnail",
        "expected a product with a thumbnail; this one was made before products had one: use its preview, or delete "
        "the product and submit the job again",
    )
    return files.send(request, state.store, digest, "image/png", None, missing=missing)


@products.get("/{product_id}/changes", summary="Picture of all changes", response_class=Response)
def get_product_changes(product_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """A PNG that shows the image before and after, the change, difference, ratio and histogram, if the job had
    `changes_picture` true.
    """
    digest = state.row(ProductRow, product_id, caller.owner).details.get("changes_picture_sha256")
    missing = (
        "no-changes-picture",
        "expected a product whose job had changes_picture true; this job had it false: submit the job again with "
        "changes_picture true",
    )
    return files.send(request, state.store, digest, "image/png", None, missing=missing)


@in_turn(
    products.delete("/{product_id}", status_code=204, summary="Delete a product", response_class=Response)
)
def delete_product(product_id: Identity, caller: Submitting, state: Shared) -> Response:
    """Remove the product from the catalogue and from your quota. The same request makes it again."""
    row = state.row(ProductRow, product_id, caller.owner)
    state.catalogue.delete(ProductRow, product_id, caller.owner)
    # The files are deleted at once. Otherwise an owner who deletes products and submits jobs in turn could exceed the
    # quota.
    remove_unnamed(state.catalogue, state.store, [digest for digest, _ in files_of(row)])
    return Response(status_code=204)


# --- lineage --------------------------------------------------------------------------------------------


@lineages.get("/v1/psfs/{psf_id}/lineage", summary="The lineage of a PSF")
def get_psf_lineage(psf_id: Identity, caller: Reading, state: Shared) -> Ancestor:
    """The inputs of the PSF (by hash), its parameters, the versions of software and libraries, and its job. The PSFs
    from which it was made are described in the same way.
    """
    return lineage(state.catalogue, state.row(PsfRow, psf_id, caller.owner))


@lineages.get("/v1/products/{product_id}/lineage", summary="The lineage of a product")
def get_product_lineage(product_id: Identity, caller: Reading, state: Shared) -> Ancestor:
    """The image, the parameters, the versions of software and libraries, and the job of the product; also the lineage
    of its PSF.
    """
    return lineage(state.catalogue, state.row(ProductRow, product_id, caller.owner))


@lineages.get("/v1/psfs/{psf_id}/provenance", summary="The lineage of a PSF as W3C PROV", **PROV)
def get_psf_provenance(
    psf_id: Identity, caller: Reading, state: Shared, format: Annotated[Format, FORMAT] = "json"
) -> Response:
    """The lineage in the terms of W3C PROV and of the IVOA Provenance Data Model."""
    return _provenance(state, state.row(PsfRow, psf_id, caller.owner), "psf", format)


@lineages.get("/v1/products/{product_id}/provenance", summary="The lineage of a product as W3C PROV", **PROV)
def get_product_provenance(
    product_id: Identity, caller: Reading, state: Shared, format: Annotated[Format, FORMAT] = "json"
) -> Response:
    """The lineage in the terms of W3C PROV and of the IVOA Provenance Data Model."""
    return _provenance(state, state.row(ProductRow, product_id, caller.owner), "product", format)


@in_turn(lineages.post("/v1/psfs/{psf_id}/rerun", status_code=202, summary="Make a PSF again and compare"))
def rerun_psf(psf_id: Identity, response: Response, caller: Submitting, state: Shared) -> JobView:
    """Submit a job that makes the PSF again with the same parameters. The result is a report on the differences between
    both PSFs.
    """
    return _rerun("psf", psf_id, response, caller, state)


@in_turn(
    lineages.post(
        "/v1/products/{product_id}/rerun", status_code=202, summary="Make a product again and compare"
    )
)
def rerun_product(product_id: Identity, response: Response, caller: Submitting, state: Shared) -> JobView:
    """Submit a job that makes the product again with the same parameters. The result is a report on the differences
    between both products.
    """
    return _rerun("product", product_id, response, caller, state)


def _rerun(
    of: Literal["product", "psf"], identity: str, response: Response, caller: Submitting, state: Shared
) -> JobView:
    request = REQUESTS["rerun"](kind="rerun", parameters=Rerun(of=of, id=identity))
    return submit_job(request, response, caller, state)


def _provenance(state: Shared, row: ProductRow | PsfRow, of: str, form: Format) -> Response:
    headers = {"Content-Disposition": f'attachment; filename="{of}-{row.id[:12]}.{FILES[form]}"'}
    return Response(
        provenance_text(state.catalogue, row, form), media_type=MEDIA_TYPES[form], headers=headers
    )
