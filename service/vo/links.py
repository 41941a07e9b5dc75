"""The files and services that belong to a product or PSF, as a DataLink table, ``/vo/links``; and cut-outs of products
as FITS, ``/vo/cutout``.

Citation: IVOA DataLink 1.1 (15 December 2023). Each ID gives the rows of its links. If an ID is not known, its only row
says so, and the other IDs are answered. A request without an ID gets an empty table. The table also describes the
cut-out service, so that a client can show a form for it.

The parameters of a cut-out are those of IVOA SODA 1.0 (17 May 2017), but a position is in pixels or helioprojective,
because the Sun moves in the equatorial coordinates that SODA demands; so the service does not claim to be SODA.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.http import files
from service.http.callers import Caller, Reading
from service.http.cutouts import cutout_of
from service.http.files import FITS_TYPE, GZIP_TYPE
from service.http.problems import Problem
from service.http.state import Shared, State
from service.vo.lists import LINKS_STANDARD, LINKS_TYPE, PSF, VOTABLE_ERROR, VotableErrors, did, row_named
from service.vo.parameters import (
    PLAIN_ERRORS,
    VOTABLE,
    Fields,
    PlainErrors,
    base_url,
    format_of,
    one,
    query,
    refuse,
)
from service.vo.votables import LINKS, Input, Service, table_document
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow

if TYPE_CHECKING:
    from psfcore.fits.viewing.regions import Region

MOST_IDS = 200
CUTOUT = "cutout"
PNG, JSON, PROVN = "image/png", "application/json", "text/provenance-notation"
Link = dict[str, object]
# This number is part of every ETag. Increase it when a new version of the code gives another answer for the same file.
ANSWERS_VERSION = 1
Frame = Literal["pixel", "helioprojective"]
FRAMES: tuple[Frame, ...] = ("pixel", "helioprojective")
MOST_CORNERS = 100
# The numbers of each shape, as a message shows them.
SHAPES = {
    "circle": "x y radius",
    "box": "x y width height, with x y the centre",
    "polygon": f"x1 y1 x2 y2 x3 y3 ..., with 3 to {MOST_CORNERS} corners",
}
COUNTS = {"circle": (3,), "box": (4,), "polygon": range(6, 2 * MOST_CORNERS + 1, 2)}
FRAME = "pixel (default): px, counted from 0 at the centre of the first pixel; helioprojective: arcsec"
router = APIRouter(prefix="/vo", tags=["VO"], route_class=VotableErrors)
cutouts = APIRouter(prefix="/vo", tags=["VO"], route_class=PlainErrors)


@router.get(
    "/links",
    summary="DataLink: the files and services of products and PSFs",
    response_class=Response,
    responses={
        200: {"content": {LINKS_TYPE: {}}, "description": "A table of DataLink 1.1"},
        **VOTABLE_ERROR,
    },
    openapi_extra=query(
        ID=f"id of a product or PSF, or its name urn:heliopsf:product:... or urn:heliopsf:psf:...; at most {MOST_IDS}",
        RESPONSEFORMAT="votable, the only format",
    ),
)
@router.post("/links", include_in_schema=False)
def get_links(request: Request, caller: Reading, state: Shared, fields: Fields) -> Response:
    """Product or PSF, previews, input, PSF, provenance and cut-outs, with address, meaning, media type and size."""
    format_of(fields, VOTABLE)
    names = fields.get("id", [])
    if len(names) > MOST_IDS:
        refuse("ID", f"at most {MOST_IDS} of them", f"{len(names)} of them")
    rows = [link for name in names for link in _links(state, caller, name, base_url(request))]
    content = table_document(
        "links",
        LINKS,
        rows,
        infos={"standardID": LINKS_STANDARD},
        services=[described_cutout(CUTOUT, base_url(request))],
    )
    return Response(content, media_type=LINKS_TYPE)


def _links(state: State, caller: Caller, name: str, base: str) -> Iterator[Link]:
    """The links of one ID."""
    row = row_named(state, caller, name)
    if row is None:
        yield _fault(
            name,
            "NotFoundFault: expected the id of one of your products or PSFs: list them at /vo/products or /vo/psfs",
        )
        return
    keys = "true" if state.access.keys else "false"
    links = _of_product(state, row, base) if isinstance(row, ProductRow) else _of_psf(row, base)
    for link in links:
        yield {"ID": name, "link_auth": keys, **link}


def _of_product(state: State, row: ProductRow, base: str) -> Iterator[Link]:
    here, psf = f"{base}/v1/products/{row.id}", f"{base}/v1/psfs/{row.psf_id}"
    details, owner = row.details, row.owner
    yield _link(
        "#this", "file", f"{here}/file", "The deconvolved image with its planes", FITS_TYPE, row.bytes
    )
    yield _link("#preview", "preview", f"{here}/preview", "The image before and after, and the change", PNG)
    if details.get("thumbnail_sha256"):
        yield _link(
            "#preview-image",
            "thumbnail",
            f"{here}/thumbnail",
            "The product, at most 192 px wide and high",
            PNG,
        )
    if details.get("changes_picture_sha256"):
        yield _link("#preview-plot", "changes", f"{here}/changes", "What the deconvolution changed", PNG)
    used = state.catalogue.get(PsfRow, row.psf_id, owner)
    if used is None:
        yield _fault(None, "NotFoundFault: the PSF was deleted", "#calibration", "psf")
    else:
        yield _link(
            "#calibration",
            "psf",
            f"{psf}/file",
            f"The PSF: {used.name} {used.version}",
            FITS_TYPE,
            used.bytes,
        )
        links = f"{base}/vo/links?ID={did(PSF, used.id)}"
        yield _link("#calibration", "psf-links", links, "All files of the PSF", LINKS_TYPE)
    image = state.catalogue.get(ImageRow, row.image_id, owner)
    if image is None:
        message = "NotFoundFault: the service does not keep the input; a bulk run read it from an archive"
        yield _fault(None, message, "#progenitor", "input")
    else:
        kind = GZIP_TYPE if image.summary.get("gzipped") else FITS_TYPE
        yield _link(
            "#progenitor", "input", f"{base}/v1/images/{image.id}/file", "The input image", kind, image.bytes
        )
    yield from _provenance(here)
    yield {
        "service_def": CUTOUT,
        "semantics": "#cutout",
        "description": "Cut a circle, box or polygon out of the product",
        "content_type": FITS_TYPE,
        "local_semantics": "cutout",
    }


def _of_psf(row: PsfRow, base: str) -> Iterator[Link]:
    here = f"{base}/v1/psfs/{row.id}"
    yield _link("#this", "file", f"{here}/file", f"The PSF: {row.name} {row.version}", FITS_TYPE, row.bytes)
    if row.preview_sha256:
        yield _link("#preview", "preview", f"{here}/preview", "The PSF and its curve", PNG)
    if "report_sha256" in row.details:
        yield _link("#auxiliary", "report", f"{here}/report", "The report on the fit", JSON)
    yield from _provenance(here)


def _provenance(here: str) -> Iterator[Link]:
    yield _link(
        "#auxiliary", "provenance", f"{here}/provenance?format=json", "The lineage as W3C PROV-JSON", JSON
    )
    yield _link(
        "#auxiliary", "provenance", f"{here}/provenance?format=provn", "The lineage as W3C PROV-N", PROVN
    )


def _link(
    semantics: str, local: str, address: str, description: str, kind: str, size: int | None = None
) -> Link:
    return {
        "access_url": address,
        "semantics": semantics,
        "description": description,
        "content_type": kind,
        "content_length": size,
        "local_semantics": local,
    }


def _fault(name: str | None, message: str, semantics: str = "#this", local: str | None = None) -> Link:
    """A row that says why there is no link."""
    fault: Link = {"error_message": message, "semantics": semantics, "local_semantics": local}
    return fault if name is None else {"ID": name, **fault}


# --- cut-outs -------------------------------------------------------------------------------------------


@cutouts.get(
    "/cutout",
    summary="Cut a circle, box or polygon out of a product",
    response_class=Response,
    responses={
        200: {
            "content": {files.FITS_TYPE: {"schema": {"type": "string", "format": "binary"}}},
            "description": "A FITS file with the image and its planes",
        },
        **PLAIN_ERRORS,
    },
    openapi_extra=query(
        ID="id of a product, or its name urn:heliopsf:product:...",
        **{name.upper(): numbers for name, numbers in SHAPES.items()},
        FRAME=FRAME,
    ),
)  # fmt: skip
@cutouts.post("/cutout", include_in_schema=False)
async def get_region(request: Request, caller: Reading, state: Shared, fields: Fields) -> Response:
    """The smallest rectangle of whole pixels that contains the region, of the image and of its planes. Give one of
    CIRCLE, BOX and POLYGON.
    """
    names = fields.get("id", [])
    if len(names) != 1:
        refuse("ID", "of one product", f"{len(names)} of them" if names else None)
    shape, numbers, frame = _region_of(fields)
    row = await run_in_threadpool(row_named, state, caller, names[0])
    if not isinstance(row, ProductRow):
        raise Problem(
            404,
            "no-such-product",
            f"expected ID, the id of one of your products; got {names[0][:120]!a}: list your products",
        )

    def write(path: Path, target: BinaryIO) -> None:
        from psfcore.fits.viewing.regions import write_cutout  # loads the numerical libraries

        write_cutout(path, _region(shape, numbers, frame), state.settings.image_limits, target)

    part, filename = f"{ANSWERS_VERSION} {shape} {numbers} {frame}", f"product-{row.id[:12]}-cutout.fits"
    return await cutout_of(request, state, row, part, write, filename=filename)


def described_cutout(identity: str, base: str) -> Service:
    """The description of this service in a DataLink table. The client takes ID from the column ID of the table."""
    inputs = (
        Input("ID", "Product", ucd="meta.id;meta.main", ref="ID"),
        Input("CIRCLE", SHAPES["circle"], datatype="double"),
        Input("BOX", SHAPES["box"], datatype="double"),
        Input("POLYGON", SHAPES["polygon"], datatype="double"),
        Input("FRAME", FRAME, value=FRAMES[0], options=FRAMES),
    )
    return Service(
        identity,
        "Cut-out of a product: give one of CIRCLE, BOX and POLYGON",
        f"{base}/vo/cutout",
        inputs,
        content_type=files.FITS_TYPE,
    )


def _region_of(fields: Mapping[str, list[str]]) -> tuple[str, tuple[float, ...], Frame]:
    """The shape, its numbers and the frame of a request."""
    shapes = [name for name in SHAPES if name in fields]
    if len(shapes) != 1:
        got = " and ".join(name.upper() for name in shapes) if shapes else None
        refuse("CIRCLE, BOX or POLYGON", "exactly one of them", got)
    [shape] = shapes
    text = fields[shape][0]
    try:
        numbers = tuple(map(float, text.split()))
    except ValueError:
        numbers = ()
    if len(numbers) not in COUNTS[shape] or not all(map(math.isfinite, numbers)):
        refuse(shape.upper(), f"finite numbers: {SHAPES[shape]}", text)
    if shape != "polygon" and min(numbers[2:]) <= 0:
        refuse(shape.upper(), f"{SHAPES[shape]}: sizes above 0", text)
    named = one(fields, "frame") or FRAMES[0]
    frame = next((known for known in FRAMES if known == named), None)
    if frame is None:
        refuse("FRAME", " or ".join(FRAMES), named)
    return shape, numbers, frame


def _region(shape: str, numbers: tuple[float, ...], frame: Frame) -> Region:
    from psfcore.fits.viewing.regions import Region

    if shape == "circle":
        return Region.circle(frame, *numbers)
    if shape == "box":
        return Region.box(frame, *numbers)
    return Region.polygon(frame, list(zip(numbers[::2], numbers[1::2], strict=True)))
