"""The first page, where an image is dropped; and the page of an image: its header, its PSF, the estimate, and the start
of its deconvolution; and the page of a product: the viewer, what the deconvolution changed, and how the product was
made.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from importlib.resources import as_file, files
from pathlib import Path
from typing import cast

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse, RedirectResponse
from starlette.background import BackgroundTasks

from psfcore.deconvolve.summary import artefact_doubt, region_error, steps_done
from psfcore.fits.header import read_summary
from psfcore.instruments.files import telescope_of, telescopes
from psfcore.instruments.psf_statements import remarks, title
from service.api.images import delete_product, get_product_lineage, rerun_product, upload_image
from service.api.jobs import EstimateView, estimate_job, submit_job
from service.api.pixels import picture_of, prepare_image
from service.http.callers import Caller
from service.http.files import path_of
from service.http.gate import in_turn
from service.http.problems import Problem
from service.http.quotas import Allowed
from service.http.state import Shared, State
from service.pages.forms import (
    Sent,
    SentForm,
    address_of,
    deconvolution,
    image_address,
    shown_options,
    text,
    usual_steps,
)
from service.pages.jobs import job_lines
from service.pages.login import PageReading, PageSubmitting
from service.pages.rendering import counted, duration, page
from service.pages.sentences import of_problem, plain, remarks_of
from service.views import JobView, ProductView
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import ImageRow, JobRow, ProductRow, PsfRow, ReportRow
from workers.contract.requests import Identity
from workers.intake.compatibility import DEPRECATED_CODE, deprecation, suits
from workers.intake.uploads import Upload, image_row
from workers.lineage import Ancestor
from workers.versions import PsfStatus

SAMPLE = "sample.fits"
LATEST = 6
MOST_PSFS = MOST_PRODUCTS = 50
MOST_RERUNS = 10
# Statuses of problems that other options of the form can solve.
OF_OPTIONS = (404, 409, 413, 422)
TO_ALLOW = ("channel-mismatch", "already-deconvolved", "psf-as-image")
SURE = "If you are sure, allow it below."
# Swagger UI loads its icons from data: addresses in its style sheet, and its scripts set styles.
REFERENCE_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src "
    "'self' data:; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'",
    "Referrer-Policy": "no-referrer",
}
START, OPEN, CHECK = "Start", "Open the product", "Check and start"
router = APIRouter(include_in_schema=False)
products = APIRouter(prefix="/products/{product_id}", include_in_schema=False)


@router.get("/")
def home(request: Request, caller: PageReading, state: Shared) -> Response:
    """The first page: drop an image; the latest products, images and jobs."""
    catalogue, owner = state.catalogue, caller.owner
    products = catalogue.page(ProductRow, owner=owner, limit=LATEST)
    return page(
        request,
        "home.html",
        telescopes=telescopes(),
        most_bytes=state.settings.max_upload_bytes,
        products=[(row, catalogue.get(ImageRow, row.image_id, owner)) for row in products],
        images=catalogue.page(ImageRow, owner=owner, limit=LATEST),
        jobs=job_lines(
            [JobView.of(row) for row in catalogue.page(JobRow, owner=owner, limit=LATEST)], caller, state
        ),
    )


@router.get("/docs")
def docs(request: Request) -> Response:
    """The interactive reference of the API, which is open to everybody."""
    return page(request, "docs.html", headers=REFERENCE_HEADERS)


@router.post("/images")
async def upload(request: Request, response: Response, caller: PageSubmitting, state: Shared) -> Response:
    """Take an image from the form, and go to its page."""
    view = await upload_image(request, response, caller, state)
    return RedirectResponse(f"/images/{view.id}", 303)


@router.post("/images/sample")
async def take_sample(caller: PageSubmitting, state: Shared) -> Response:
    """Add the sample image to the caller's images, and go to its page."""
    row = await state.stored.run(caller.owner, _add_sample, state, caller)
    return RedirectResponse(f"/images/{row.id}", 303)


def _add_sample(state: State, caller: Caller) -> ImageRow:
    take = Allowed(state, caller)
    with as_file(files(__package__).joinpath(SAMPLE)) as shipped, tempfile.TemporaryDirectory() as folder:
        take(shipped.stat().st_size)
        copy = Path(shutil.copy(shipped, folder))  # the store moves the file that it gets
        digest = hashlib.sha256(copy.read_bytes()).hexdigest()
        summary = read_summary(copy, state.settings.image_limits)
        upload = Upload(caller.owner, digest, copy.stat().st_size, SAMPLE)
        row, _ = take.keep(copy, digest, image_row(upload, summary))
    return row


# --- an image ---------------------------------------------------------------------------------------------


@router.get("/images/{image_id}/picture")
async def picture(image_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """A picture of the image as it was uploaded."""
    await run_in_threadpool(state.row, ImageRow, image_id, caller.owner)
    return await picture_of(request, state, caller.owner, image_id)


@in_turn(router.get("/images/{image_id}"))
def image(image_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """The image, its PSF and the estimate for the options in the query."""
    row = state.row(ImageRow, image_id, caller.owner)
    asked = request.query_params
    checked = _checked(image_id, asked, caller, state)
    psfs, others = _psfs(text(asked, "psf_id"), row, caller, state)
    products = state.catalogue.page(ProductRow, owner=caller.owner, limit=MOST_PRODUCTS, image_id=image_id)
    return page(
        request,
        "image.html",
        image=row,
        checked=checked,
        psfs=psfs,
        others=others,
        unknown=checked["code"] == "no-psf-for-instrument",
        products=products,
        methods=usual_steps(),
        asked=shown_options(asked),
    )


@in_turn(router.get("/images/{image_id}/check"))
def check(image_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """The check of the options in the query, for the script of the page."""
    state.row(ImageRow, image_id, caller.owner)
    return JSONResponse(_checked(image_id, request.query_params, caller, state))


@in_turn(router.post("/images/{image_id}/start"))
def start(
    image_id: Identity, response: Response, caller: PageSubmitting, state: Shared, form: SentForm
) -> Response:
    """Start the deconvolution with the options of the form, and go to its job.

    If the options are refused, the page of the image is shown again, with these options and the reason.
    """
    try:
        job = submit_job(deconvolution(image_id, form), response, caller, state)
    except Problem as problem:
        if problem.status not in OF_OPTIONS:
            raise
        return RedirectResponse(image_address(image_id, form), 303)
    return RedirectResponse(f"/jobs/{job.id}", 303)


def _psfs(chosen: str, image: ImageRow, caller: Caller, state: State) -> tuple[list[PsfRow], list[PsfRow]]:
    """The PSFs that the form offers, the newest and the chosen one: those that suit the image, and the others."""
    found = list(state.catalogue.psfs.page(PsfFilter(), caller.owner, limit=MOST_PSFS))
    if chosen and chosen not in [psf.id for psf in found]:
        row = state.catalogue.get(PsfRow, chosen, caller.owner)
        found += [] if row is None else [row]
    fit = [psf for psf in found if suits(psf, image.summary)]
    return fit, [psf for psf in found if psf not in fit]


def _checked(image_id: str, asked: Sent, caller: Caller, state: State) -> dict[str, object]:
    """The check of the options. good: whether the job can start. lines: sentences, the most important first. button:
    its text. code: of the problem; empty if there is none.
    """
    try:
        found = estimate_job(deconvolution(image_id, asked), caller, state)
    except Problem as problem:
        if problem.status not in OF_OPTIONS:
            raise
        advice = (SURE,) if problem.code in TO_ALLOW else ()
        ways = [
            plain(one["known"])
            for one in cast("Sequence[Mapping[str, str]]", problem.more.get("ways", ()))
            if "known" in one
        ]
        lines = [of_problem(problem), *ways, *advice]
        return {"good": False, "lines": lines, "button": CHECK, "code": problem.code}
    button = OPEN if found.existing else START
    return {"good": True, "lines": _lines(found, caller.owner, state), "button": button, "code": ""}


def _lines(found: EstimateView, owner: str, state: State) -> list[str]:
    assert found.psf is not None
    psf = found.psf
    row = state.catalogue.get(PsfRow, psf.id, owner)
    why = psf.why.replace("The request names this PSF.", "You chose this PSF.")
    built = found.parameters.get("psf_recipe") is not None
    named = title(psf.name, psf.version, psf.status)
    lines = [f"{named}, built for {telescope_of(psf.name)}." if built else f"{named}. {why}"]
    # A PSF that is not there yet is built from a shipped instrument file or interpolated; both are drafts.
    lines += (
        [plain(one) for one in remarks(psf.name, psf.name, {}, PsfStatus.DRAFT)]
        if row is None
        else remarks_of(row)
    )
    if found.existing:
        return [*lines, "This product exists already."]
    waiting = ""
    if found.waiting_before:
        waiting = f", after {counted(found.waiting_before, 'other job')}"
    seconds = found.estimate.seconds
    time = duration(seconds).capitalize() if seconds < 1 else f"About {duration(seconds)}"
    return [*lines, f"{time} and {found.estimate.memory_mib} MiB{waiting}."]


# --- a product ------------------------------------------------------------------------------------------


@in_turn(products.get(""))
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
    published = row.details["psf"].get("published", [])
    held = state.catalogue.psfs.page(PsfFilter(name=published[0]), row.owner, limit=1) if published else []
    answer = page(
        request,
        "product.html",
        product=ProductView.of(row),
        name=(image and image.filename) or row.details["filename"],
        image=image,
        psf=psf,
        lost=lost,
        image_lost=image_lost,
        warnings=[
            one["message"]
            for one in row.details["warnings"]
            if not deprecated or one["code"] != DEPRECATED_CODE
        ],
        deprecated=deprecated,
        published=published,
        redo_published=_again(row, psf_id=held[0].id) if held else None,
        redo=_again(row, psf_id="" if better is None else better.id),
        artefact_doubt=artefact_doubt(row.details),
        again=_again(row),
        steps=steps_done(row.details),
        lineage=get_product_lineage(product_id, caller, state),
        reruns=[one for one in reruns if one.kind == "rerun"],
    )
    # The viewer of this page asks for both images as soon as its scripts are loaded.
    soon = BackgroundTasks()
    if lost is None:
        soon.add_task(prepare_image, state, row.owner, row.file_sha256)
    if image is not None and image_lost is None:
        soon.add_task(prepare_image, state, image.owner, image.id)
    answer.background = soon
    return answer


@in_turn(products.get("/print"))
def report(product_id: Identity, request: Request, caller: PageReading, state: Shared) -> Response:
    """The product on one sheet A4: image, PSF and its sources, method, what was masked and what changed."""
    row = state.row(ProductRow, product_id, caller.owner)
    image = state.catalogue.get(ImageRow, row.image_id, row.owner)
    psf = state.catalogue.get(PsfRow, row.psf_id, row.owner)
    parents = get_product_lineage(product_id, caller, state).parents
    return page(
        request,
        "print.html",
        product=ProductView.of(row),
        name=(image and image.filename) or row.details["filename"],
        image=image,
        deprecated=None if psf is None else deprecation(state.catalogue, psf),
        sources=[source for parent in parents if parent.type == "psf" for source in _ancestors(parent)],
        steps=steps_done(row.details),
        artefact_doubt=artefact_doubt(row.details),
        region_error=region_error,
    )


def _ancestors(thing: Ancestor) -> list[Ancestor]:
    """Everything that a thing was made from, each once, the nearest first."""
    found: dict[str, Ancestor] = {}
    for parent in thing.parents:
        found |= {one.id: one for one in (parent, *_ancestors(parent)) if one.id not in found}
    return list(found.values())


@in_turn(products.post("/rerun"))
def rerun(product_id: Identity, response: Response, caller: PageSubmitting, state: Shared) -> Response:
    """Make the product again, and go to the job."""
    job = rerun_product(product_id, response, caller, state)
    return RedirectResponse(f"/jobs/{job.id}", 303)


@in_turn(products.post("/delete"))
def delete(product_id: Identity, caller: PageSubmitting, state: Shared) -> Response:
    """Delete the product, and go to the page of its image, or to the first page if the image was deleted."""
    row = state.row(ProductRow, product_id, caller.owner)
    delete_product(product_id, caller, state)
    there = state.catalogue.get(ImageRow, row.image_id, row.owner) is not None
    return RedirectResponse(f"/images/{row.image_id}" if there else "/", 303)


def _lost(state: State, digest: str, size: int) -> str | None:
    """Why a file cannot be shown; None if it can."""
    try:
        path_of(state.store, digest, size)
    except Problem as problem:
        return of_problem(problem)
    return None


def _again(row: ProductRow, *, psf_id: str | None = None) -> str:
    """The page of the image, with the options of the product.

    Parameters
    ----------
    psf_id
        The id of another PSF; empty: the PSF that the service chooses; None: the PSF of the product.
    """
    other = {} if psf_id is None else {"psf_id": psf_id, "picked_for": None, "psf_recipe": None}
    return address_of({**row.details["parameters"], **other})
