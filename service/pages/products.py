"""The page of a product: the viewer, what the deconvolution changed, how the product was made, and what can be done with it."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse
from starlette.background import BackgroundTasks

from psfcore.deconvolve.summary import steps_done
from service.api.bulk import LOOK_FROM
from service.api.images import delete_product
from service.api.lineage import get_product_lineage, rerun_product
from service.api.pixels import prepare_image
from service.http import downloads
from service.http.problems import Problem
from service.http.state import Shared, State
from service.pages.forms import address_of
from service.pages.login import PageReading, PageSubmitting
from service.pages.rendering import number, page
from service.pages.sentences import of_problem
from service.views import ProductView
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow, ReportRow
from workers.contract.requests import Identity
from workers.intake.compatibility import DEPRECATED_CODE, deprecation

MOST_RERUNS = 10
router = APIRouter(prefix="/products/{product_id}", include_in_schema=False)


@router.get("")
def product(product_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """The product. If its file or the uploaded image is lost or deleted, the page says so."""
    row = state.row(ProductRow, product_id, caller.owner)
    image = state.catalogue.get(ImageRow, row.image_id, row.owner)
    psf = state.catalogue.get(PsfRow, row.psf_id, row.owner)
    reruns = state.catalogue.page(ReportRow, owner=row.owner, limit=MOST_RERUNS, about_id=row.id)
    lost = _lost(state, row.file_sha256, row.bytes)
    image_lost = None if image is None else _lost(state, image.id, image.bytes)
    deprecated = None if psf is None else deprecation(state.catalogue, psf)
    better = None if deprecated is None else deprecated.redo_with
    answer = page(
        request,
        "product.html",
        product=ProductView.of(row),
        name=(image and image.filename) or row.details["filename"],
        image=image,
        psf=psf,
        lost=lost,
        image_lost=image_lost,
        warnings=_warnings(row.details, without=DEPRECATED_CODE if deprecated else None),
        deprecated=deprecated,
        redo=_again(row, psf_id="" if better is None else better.id),
        changed=_changed(row.details),
        look_at=row.details["changes"]["artefacts"]["score"] >= LOOK_FROM,
        look_from=LOOK_FROM,
        again=_again(row),
        made=_made(row.details),
        lineage=get_product_lineage(product_id, caller, state),
        reruns=[one for one in reruns if one.kind == "rerun"],
    )
    # The viewer of this page asks for both images as soon as its scripts are loaded.
    soon = BackgroundTasks()
    if lost is None:
        soon.add_task(prepare_image, state, row.file_sha256)
    if image is not None and image_lost is None:
        soon.add_task(prepare_image, state, image.id)
    answer.background = soon
    return answer


@router.post("/rerun")
def rerun(product_id: Identity, response: Response, caller: PageSubmitting, state: Shared) -> Response:
    """Make the product again, and go to the job."""
    job = rerun_product(product_id, response, caller, state)
    return RedirectResponse(f"/jobs/{job.id}", 303)


@router.post("/delete")
def delete(product_id: Identity, caller: PageSubmitting, state: Shared) -> Response:
    """Delete the product, and go to the page of its image, or to the first page if the image was deleted."""
    row = state.row(ProductRow, product_id, caller.owner)
    delete_product(product_id, caller, state)
    there = state.catalogue.get(ImageRow, row.image_id, row.owner) is not None
    return RedirectResponse(f"/images/{row.image_id}" if there else "/", 303)


def _lost(state: State, digest: str, size: int) -> str | None:
    """Why a file cannot be shown; None if it can."""
    try:
        downloads.path_of(state.store, digest, size)
    except Problem as problem:
        return of_problem(problem)
    return None


def _warnings(details: dict[str, Any], *, without: str | None) -> list[str]:
    """The warnings of a product. without: the code of a warning that the page shows in another way."""
    return [one["message"] for one in details["warnings"] if one["code"] != without]


def _again(row: ProductRow, *, psf_id: str | None = None) -> str:
    """The page of the image, with the options of the product. psf_id: another PSF; empty: the one that the service chooses."""
    other = {} if psf_id is None else {"psf_id": psf_id, "picked_for": None, "psf_recipe": None}
    return address_of({**row.details["parameters"], **other})


def _changed(details: dict[str, Any]) -> list[tuple[str, str]]:
    """What the deconvolution changed in the image, as far as it was measured."""
    shown = {
        "Total flux": _percent(details["flux_change_pct"]),
        "Brightest 1 % of the pixels": _percent(details["bright_change_pct"]),
        "Darkest 1 % of the pixels": _percent(details["dark_change_pct"]),
        "Noise, compared with the input": _factor(details["noise_amplification"]),
        "Chi-squared per pixel": number(details["chi2_per_pixel"]),
        "Negative pixels": _count(details["negative_pixels"]),
        "Saturated pixels": _count(details["masked_pixels"]["saturated"]),
        "Score of artefacts": number(details["changes"]["artefacts"]["score"]),
    }
    return [(name, text) for name, text in shown.items() if text != "-"]


def _made(details: dict[str, Any]) -> list[tuple[str, str]]:
    """How the product was made."""
    method = details["method"]
    own = [
        f"{name} {value}"
        for name, value in method.items()
        if value is not None and name not in ("name", "algorithm_version", "steps")
    ]
    return [
        ("Method", f"{method['name']}, {steps_done(details)}"),
        *([("Options", ", ".join(own))] if own else []),
        ("Edges", f"{details['edges']}, a band of {details['edge_band_px']} px depends on them"),
        ("Software", details["software_version"]),
    ]


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:+.3g} %"


def _factor(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g} times"


def _count(value: int) -> str:
    return f"{value:,}".replace(",", " ")
