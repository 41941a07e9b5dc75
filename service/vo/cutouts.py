"""Cut-outs of products as FITS: ``/vo/cutout``.

The parameters are those of IVOA SODA 1.0 (17 May 2017), but a position is in pixels or helioprojective, because the Sun moves in the
equatorial coordinates that SODA demands; so the service does not claim to be SODA.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, BinaryIO, Literal

import anyio.to_thread
from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse

from service.http import downloads as files
from service.http.callers import Reading
from service.http.problems import Problem, as_problems
from service.http.quotas import check_disk
from service.http.state import Shared, State
from service.vo.lists import row_named
from service.vo.parameters import Fields, PlainErrors, one, query, refuse
from workers.catalogue.tables import ProductRow

if TYPE_CHECKING:
    from psfcore.fits.viewing.regions import Region
    from service.vo.votables import Service

# This number is part of every ETag. Increase it when a new version of the code gives another answer for the same file.
ANSWERS_VERSION = 1
Frame = Literal["pixel", "helioprojective"]
FRAMES: tuple[Frame, ...] = ("pixel", "helioprojective")
MOST_CORNERS = 100
PIECE_BYTES = 2**20
# The numbers of each shape, as a message shows them.
SHAPES = {
    "circle": "x y radius",
    "box": "x y width height, with x y the centre",
    "polygon": f"x1 y1 x2 y2 x3 y3 ..., with 3 to {MOST_CORNERS} corners",
}
COUNTS = {"circle": (3,), "box": (4,), "polygon": range(6, 2 * MOST_CORNERS + 1, 2)}
FRAME = "pixel (default): px, counted from 0 at the centre of the first pixel; helioprojective: arcsec"
router = APIRouter(prefix="/vo", tags=["VO"], route_class=PlainErrors)


@router.get(
    "/cutout",
    summary="Cut a circle, box or polygon out of a product",
    response_class=Response,
    responses={
        200: {
            "content": {files.FITS_TYPE: {"schema": {"type": "string", "format": "binary"}}},
            "description": "A FITS file with the image and its planes",
        },
        "4XX": {"content": {"text/plain": {}}, "description": "What was expected, what was received, and what to do."},
    },
    openapi_extra=query(
        ID="id of a product, or its name urn:heliopsf:product:...",
        **{name.upper(): numbers for name, numbers in SHAPES.items()},
        FRAME=FRAME,
    ),
)  # fmt: skip
@router.post("/cutout", include_in_schema=False)
async def get_region(request: Request, caller: Reading, state: Shared, fields: Fields) -> Response:
    """The smallest rectangle of whole pixels that contains the region, of the image and of its planes. Give one of CIRCLE, BOX and
    POLYGON."""
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
    headers = files.headers_of(f"{ANSWERS_VERSION} {row.file_sha256} {shape} {numbers} {frame}")
    if (same := files.not_modified(request, headers)) is not None:
        return same
    with as_problems():
        file = await anyio.to_thread.run_sync(
            _written, state, row, shape, numbers, frame, limiter=state.cutouts
        )
    headers["Content-Disposition"] = f'attachment; filename="product-{row.id[:12]}-cutout.fits"'
    headers["Content-Length"] = str(file.seek(0, io.SEEK_END))
    return StreamingResponse(_pieces(file), media_type=files.FITS_TYPE, headers=headers)


def described_cutout(identity: str, base: str) -> Service:
    """The description of this service in a DataLink table. The client takes ID from the column ID of the table."""
    from service.vo.votables import Input, Service

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
        f"{base}{router.prefix}/cutout",
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


def _written(state: State, row: ProductRow, shape: str, numbers: tuple[float, ...], frame: Frame) -> BinaryIO:
    """The cut-out in an open file without a name, which is gone when the file is closed."""
    from psfcore.fits.viewing.regions import write_cutout  # loads the numerical libraries

    check_disk(state)
    path = files.path_of(state.store, row.file_sha256, row.bytes)
    with state.store.temporary() as target:
        file = target.open("w+b")
        try:
            write_cutout(path, _region(shape, numbers, frame), state.limits, file)
        except BaseException:
            file.close()
            raise
    return file


def _pieces(file: BinaryIO) -> Iterator[bytes]:
    with file:
        file.seek(0)
        while piece := file.read(PIECE_BYTES):
            yield piece


def _region(shape: str, numbers: tuple[float, ...], frame: Frame) -> Region:
    from psfcore.fits.viewing.regions import Region

    if shape == "circle":
        return Region.circle(frame, *numbers)
    if shape == "box":
        return Region.box(frame, *numbers)
    return Region.polygon(frame, list(zip(numbers[::2], numbers[1::2], strict=True)))
