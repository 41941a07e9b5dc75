"""The page of an uploaded image: its header, the PSF that it will get, the estimate, and the start of its deconvolution."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse

from service.api.estimates import estimate_job
from service.api.jobs import submit_job
from service.api.products import ProductView
from service.http.callers import Caller
from service.http.problems import Problem
from service.http.state import Shared, State
from service.pages.images import image_line
from service.pages.parts import methods
from service.pages.parts.forms import Sent, text, wanted_job
from service.pages.rendering import page
from service.pages.visitors import PageReading, PageSubmitting
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import ImageRow, ProductRow
from workers.contract.kinds import JobRequest
from workers.contract.requests import Identity

MOST_PSFS = MOST_PRODUCTS = 50
router = APIRouter(prefix="/images/{image_id}", include_in_schema=False)


@router.get("")
def image(image_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """The image, its PSF and the estimate for the options in the query."""
    row = _find(state, caller, image_id)
    asked = request.query_params
    estimate, problem = None, None
    try:
        estimate = estimate_job(_wanted(image_id, asked), caller, state)
    except Problem as refused:
        problem = refused
    psfs = state.catalogue.psfs.page(PsfFilter(), caller.owner, limit=MOST_PSFS)
    products = state.catalogue.page(ProductRow, owner=caller.owner, limit=MOST_PRODUCTS, image_id=image_id)
    return page(
        request,
        "image.html",
        image=row,
        facts=_facts(row),
        estimate=estimate,
        problem=problem,
        psfs=psfs,
        products=[ProductView.of(product) for product in products],
        methods=methods.choices(),
        asked=_shown(asked),
    )


@router.post("/start")
async def start(
    image_id: Identity, request: Request, response: Response, caller: PageSubmitting, state: Shared
) -> Response:
    """Start the deconvolution with the options of the form, and go to its job or to the product that exists already."""
    form = await request.form()
    job = await run_in_threadpool(lambda: submit_job(_wanted(image_id, form), response, caller, state))
    return RedirectResponse(f"/jobs/{job.id}", 303)


def _wanted(image_id: str, asked: Sent) -> JobRequest:
    """The request for a job from the options of a form. Raises ``Problem`` 422 for a wrong option."""
    parameters = {
        "image_id": image_id,
        "psf_id": text(asked, "psf_id") or None,
        "method": methods.chosen(asked),
        "error_draws": text(asked, "error_draws") or 0,
        "other_channel": bool(text(asked, "other_channel")),
        "again": bool(text(asked, "again")),
    }
    return wanted_job("deconvolve", parameters)


def _shown(asked: Sent) -> dict[str, Any]:
    """The options as the form shows them again."""
    names = ("psf_id", "method", "steps", "error_draws", "other_channel", "again")
    shown = {name: text(asked, name) for name in names}
    return shown | {"error_draws": shown["error_draws"] or "0", "changed": any(shown.values())}


def _facts(row: ImageRow) -> list[tuple[str, str]]:
    """What the header says of the image."""
    header, line = row.summary, image_line(row)
    ny, nx = header["shape"]
    scale = header.get("cdelt1")
    facts = {
        "Telescope": str(line["telescope"]),
        "Observed": str(line["observed"]),
        "Size": f"{nx} x {ny} px",
        "Pixel scale": f"{abs(scale):.4g} arcsec" if scale else "not in the header",
        "Exposure": f"{header['exposure_s']:g} s" if header.get("exposure_s") else "not in the header",
        "Unit": header.get("unit") or "not in the header (BUNIT)",
        "Id": row.id,
    }
    return list(facts.items())


def _find(state: State, caller: Caller, image_id: str) -> ImageRow:
    row = state.catalogue.get(ImageRow, image_id, caller.owner)
    if row is None:
        raise Problem(404, "no-such-image", f"expected the id of one of your images; got {image_id}")
    return row
