"""The first page, where an image is dropped, and the uploads from it."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from importlib.resources import as_file, files
from pathlib import Path

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse

from psfcore.fits.header import read_summary
from psfcore.instruments.files import instrument_names
from service.api.images import ImageView, upload_image
from service.http.callers import Caller
from service.http.quotas import Allowed
from service.http.state import Shared, State
from service.pages.jobs import job_lines
from service.pages.rendering import page, short
from service.pages.visitors import PageReading, PageSubmitting
from service.views.jobs import JobView
from service.views.products import ProductView
from workers.catalogue.tables import ImageRow, JobRow, ProductRow
from workers.intake.uploads import image_row

SAMPLE = "sample.fits"
LATEST = 6
router = APIRouter(include_in_schema=False)


@router.get("/")
def home(request: Request, caller: PageReading, state: Shared) -> Response:
    """The first page: drop an image; the latest products, images and jobs."""
    catalogue, owner = state.catalogue, caller.owner
    images = catalogue.page(ImageRow, owner=owner, limit=LATEST)
    return page(
        request,
        "home.html",
        known=" and ".join(instrument_names()),
        most_bytes=state.settings.max_upload_bytes,
        products=[product_card(state, row) for row in catalogue.page(ProductRow, owner=owner, limit=LATEST)],
        images=[image_line(row) for row in images],
        jobs=job_lines(
            [JobView.of(row) for row in catalogue.page(JobRow, owner=owner, limit=LATEST)], caller, state
        ),
    )


@router.post("/images")
async def upload(request: Request, response: Response, caller: PageSubmitting, state: Shared) -> Response:
    """Take an image from the form, and go to its page."""
    view = await upload_image(request, response, caller, state)
    return RedirectResponse(f"/images/{view.id}", 303)


@router.post("/images/sample")
async def take_sample(caller: PageSubmitting, state: Shared) -> Response:
    """Add the sample image to the caller's images, and go to its page."""
    row = await run_in_threadpool(_add_sample, state, caller)
    return RedirectResponse(f"/images/{row.id}", 303)


def product_card(state: State, row: ProductRow) -> dict[str, object]:
    """The entry of a product in a list."""
    view = ProductView.of(row)
    image = state.catalogue.get(ImageRow, row.image_id, row.owner)
    thumbnail = row.details.get("thumbnail_sha256")
    return {
        "id": view.id,
        "name": (image and image.filename) or short(view.id),
        "psf_version": view.psf_version,
        "created_at": view.created_at,
        "thumbnail": f"/v1/products/{view.id}/thumbnail" if thumbnail else None,
    }


def image_line(row: ImageRow) -> dict[str, object]:
    """The entry of an image in a list."""
    header = row.summary
    telescope = [str(header[name]) for name in ("telescop", "detector") if header.get(name)]
    if header.get("wavelnth"):
        telescope.append(f"{header['wavelnth']:g} Å")
    return ImageView.of(row).model_dump() | {
        "telescope": " ".join(telescope) or "unknown",
        "observed": header.get("date_obs") or "unknown",
    }


def _add_sample(state: State, caller: Caller) -> ImageRow:
    take = Allowed(state, caller)
    with as_file(files(__package__).joinpath(SAMPLE)) as shipped, tempfile.TemporaryDirectory() as folder:
        take(shipped.stat().st_size)
        copy = Path(shutil.copy(shipped, folder))  # the store moves the file that it gets
        digest = hashlib.sha256(copy.read_bytes()).hexdigest()
        summary = read_summary(copy, state.limits)
        row, _ = take.keep(
            copy, digest, image_row(caller.owner, digest, copy.stat().st_size, SAMPLE, summary)
        )
    return row
