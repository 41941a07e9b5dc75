"""Uploaded images: ``/v1/images``."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, Field

from service.http import downloads as files
from service.http import uploads
from service.http.callers import Reading, Submitting
from service.http.paging import Cursor, Limit, Page, page, position
from service.http.problems import RESPONSES
from service.http.quotas import Allowed
from service.http.state import Shared
from workers.catalogue.tables import ImageRow
from workers.contract.requests import Identity
from workers.intake.uploads import image_row

router = APIRouter(prefix="/v1/images", tags=["images"], responses=RESPONSES)


class ImageView(BaseModel):
    """An uploaded image."""

    id: str = Field(description="SHA-256 of the file")
    created_at: float
    bytes: int
    filename: str | None
    header: dict[str, Any] = Field(description="summary of the FITS header")

    @classmethod
    def of(cls, row: ImageRow) -> ImageView:
        """The description of an image, from its row in the catalogue."""
        return cls(
            id=row.id, created_at=row.created_at, bytes=row.bytes, filename=row.filename, header=row.summary
        )


@router.post(
    "",
    status_code=201,
    summary="Upload a FITS image",
    openapi_extra=uploads.OPENAPI_BODY,
    responses={200: {"model": ImageView, "description": "The same file was already uploaded."}},
)
async def upload_image(request: Request, response: Response, caller: Submitting, state: Shared) -> ImageView:
    """Upload one FITS file. The header is checked at upload. The pixels are read by the jobs that use the image."""
    take = Allowed(state, caller)
    limit = state.settings.max_upload_bytes
    async with uploads.receive(request, state.store, state.limits, limit, take) as upload:
        row = image_row(caller.owner, upload.sha256, upload.bytes, upload.filename, upload.summary)
        row, new = await run_in_threadpool(take.keep, upload.path, upload.sha256, row)
    response.status_code = 201 if new else 200
    response.headers["Location"] = f"/v1/images/{row.id}"
    return ImageView.of(row)


@router.get("", summary="List uploaded images")
def list_images(
    request: Request, caller: Reading, state: Shared, limit: Limit = 50, cursor: Cursor = None
) -> Page[ImageView]:
    """Uploaded images, newest first."""
    rows = state.catalogue.page(ImageRow, owner=caller.owner, limit=limit + 1, after=position(cursor))
    return page(request, rows, limit, ImageView.of)


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
