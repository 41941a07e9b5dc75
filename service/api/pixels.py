"""The contents of the files of images and products: pixels, ``.../pixels``, and headers, ``.../header``.

Pixels are raw numbers, so that a viewer can show exact values. The first request for a plane decodes it; later requests
read the decoded plane (``psfcore.fits.viewing``). The first request for pixels loads the numerical libraries.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, BinaryIO, Literal

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse, StreamingResponse

from psfcore.errors import DataError
from psfcore.fits.header import all_cards
from psfcore.fits.viewing.planes import Decoded, Plane, decode_plane
from service.client.answers import HduHeader
from service.http import files
from service.http.callers import Reading
from service.http.problems import RESPONSES, Descriptions, Problem, as_problems
from service.http.quotas import check_disk
from service.http.state import Shared, State
from workers.catalogue.tables import ImageRow, ProductRow
from workers.contract.requests import Identity

# This number is part of every ETag. Increase it when a new version of the code gives another answer for the same file.
ANSWERS_VERSION = 1
MEDIA_TYPE = "application/octet-stream"
IMAGE, QUALITY = "image", "quality"
LARGEST = 2**31 - 1
PICTURE_PX = 640  # longest side of a picture
router = APIRouter(tags=["pixels"], responses=RESPONSES)
headers = APIRouter(tags=["headers"], responses=RESPONSES)


@dataclass(frozen=True)
class Part:
    """The window of an image that a request asks for, in pixels. step: every step-th row and column is sent.

    width, height: None means up to the last column or row.
    """

    x: Annotated[int, Query(ge=0, le=LARGEST, description="first column of the window, counted from 0")] = 0
    y: Annotated[
        int, Query(ge=0, le=LARGEST, description="first row of the window, counted from 0 as in FITS")
    ] = 0
    width: Annotated[
        int | None, Query(ge=1, le=LARGEST, description="number of columns; default: up to the last column")
    ] = None
    height: Annotated[
        int | None, Query(ge=1, le=LARGEST, description="number of rows; default: up to the last row")
    ] = None
    step: Annotated[
        int,
        Query(
            ge=1,
            le=LARGEST,
            description="n: each number of the answer stands for a block of n x n pixels. The number is the mean of "
            "the finite pixels; for `quality`, the bitwise OR. Blocks at the last rows and columns of the window "
            "may be smaller",
        ),
    ] = 1


Window = Annotated[Part, Depends()]
SHAPE = {"type": "string", "pattern": r"^\d+,\d+$"}
DESCRIBED: Descriptions = {
    200: {
        "description": "float32 numbers, little-endian, row after row, row 0 of the window first; NaN: no value",
        "content": {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}},
        "headers": {
            "X-Plane-Shape": {"description": "NY,NX: rows and columns of the whole plane", "schema": SHAPE},
            "X-Pixels-Shape": {"description": "ny,nx: rows and columns of this answer", "schema": SHAPE},
            "X-Pixels-Unit": {
                "description": "unit of the pixels (BUNIT), if the file gives one",
                "schema": {"type": "string"},
            },
        },
    },
}


@router.get(
    "/v1/images/{image_id}/pixels",
    summary="The pixels of an uploaded image",
    response_class=Response,
    responses=DESCRIBED,
)
async def get_image_pixels(
    image_id: Identity,
    request: Request,
    caller: Reading,
    state: Shared,
    part: Window,
    plane: Annotated[Literal["image"], Query(description="an uploaded image has one plane")] = "image",
) -> Response:
    """The pixel values of the file, in DN or DN/s as they are stored (BSCALE and BZERO applied). Saturated pixels are
    not marked.
    """
    await run_in_threadpool(state.row, ImageRow, image_id, caller.owner)
    return await _pixels(request, state, caller.owner, image_id, plane, part)


@router.get(
    "/v1/products/{product_id}/pixels",
    summary="The pixels of a product",
    response_class=Response,
    responses=DESCRIBED,
)
async def get_product_pixels(
    product_id: Identity,
    request: Request,
    caller: Reading,
    state: Shared,
    part: Window,
    plane: Annotated[
        Literal["image", "error", "quality"],
        Query(
            description="the deconvolved image, or its plane ERROR or QUALITY; `error` needs a job with `error_draws`"
        ),
    ] = "image",
) -> Response:
    """The pixel values of a plane of the product. Values of `quality` are whole numbers, as in the file. 404: the
    product does not have this plane.
    """
    row = await run_in_threadpool(state.row, ProductRow, product_id, caller.owner)
    return await _pixels(request, state, caller.owner, row.file_sha256, plane, part)


async def _pixels(
    request: Request, state: Shared, owner: str, digest: str, name: str, part: Part
) -> Response:
    """A part of a plane of a stored file, or 304 if the client already has it."""
    sent = files.headers_of(f"{ANSWERS_VERSION} {digest} pixels {name} {part}")
    if (same := files.not_modified(request, sent)) is not None:
        return same
    with as_problems():
        plane = await _plane(state, owner, digest, name)
        shape, length, pieces = await run_in_threadpool(_cut, plane, part, name == QUALITY)
    sent["X-Plane-Shape"] = "{},{}".format(*plane.shape)
    sent["X-Pixels-Shape"] = "{},{}".format(*shape)
    sent["Content-Length"] = str(length)
    if plane.unit is not None:
        sent["X-Pixels-Unit"] = plane.unit
    return StreamingResponse(pieces, media_type=MEDIA_TYPE, headers=sent)


async def prepare_image(state: State, owner: str, digest: str) -> None:
    """Decode the image of a stored file in advance, so that a later request for its pixels is answered at once.

    If the file cannot be decoded, this function raises no error; the later request gets the error.
    """
    with contextlib.suppress(DataError, Problem):
        await _plane(state, owner, digest, IMAGE)


async def picture_of(
    request: Request, state: State, owner: str, digest: str, core_px: int | None = None
) -> Response:
    """A picture of the image in a stored file as PNG, or 304 if the client already has it.

    Parameters
    ----------
    core_px
        Width of the central part of a PSF of which the picture is made; None: the picture shows the whole image.
    """
    sent = files.headers_of(f"{ANSWERS_VERSION} {digest} picture {core_px}")
    if (same := files.not_modified(request, sent)) is not None:
        return same

    def draw(plane: Plane) -> bytes:
        from psfcore.drawing.thumbnail import core_picture, picture

        return core_picture(plane, core_px) if core_px else picture(plane, PICTURE_PX)

    with as_problems():
        png = await run_in_threadpool(draw, await _plane(state, owner, digest, IMAGE))
    return Response(png, media_type="image/png", headers=sent)


async def _plane(state: State, owner: str, digest: str, name: str) -> Plane:
    """A plane of a stored file, decoded now unless it is still kept."""
    plane = state.planes.kept((digest, name))
    if plane is None:
        plane = await state.pixels.run(owner, _decoded, state, digest, name)
    return plane


def _decoded(state: State, digest: str, name: str) -> Plane:
    def decode(target: BinaryIO) -> Decoded:
        check_disk(state)
        # The checksum of the whole file is verified, because browsers keep the pixels for a long time.
        return decode_plane(files.path_of(state.store, digest), name, state.settings.image_limits, target)

    return state.planes.decoded((digest, name), decode)


def _cut(plane: Plane, part: Part, bits: bool) -> tuple[tuple[int, int], int, Iterator[bytes]]:
    """Shape, number of bytes and bytes of the answer. Raises DataError "window-outside"."""
    from psfcore.fits.viewing.windows import pixels, window_of

    window = window_of(plane.shape, x=part.x, y=part.y, width=part.width, height=part.height, step=part.step)
    return window.shape, window.length, pixels(plane, window, bits=bits)


@headers.get(
    "/v1/images/{image_id}/header", summary="All headers of an uploaded image", response_model=list[HduHeader]
)
async def get_image_header(image_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Every card of every HDU, with COMMENT and HISTORY. A tile-compressed image has the header of the table that holds
    it.
    """
    row = await run_in_threadpool(state.row, ImageRow, image_id, caller.owner)
    return await _headers(request, state, caller.owner, image_id, row.bytes)


@headers.get(
    "/v1/products/{product_id}/header", summary="All headers of a product", response_model=list[HduHeader]
)
async def get_product_header(
    product_id: Identity, request: Request, caller: Reading, state: Shared
) -> Response:
    """Every card of the image and of its planes, with COMMENT and HISTORY."""
    row = await run_in_threadpool(state.row, ProductRow, product_id, caller.owner)
    return await _headers(request, state, caller.owner, row.file_sha256, row.bytes)


async def _headers(request: Request, state: Shared, owner: str, digest: str, size: int) -> Response:
    sent = files.headers_of(f"{ANSWERS_VERSION} {digest} header")
    if (same := files.not_modified(request, sent)) is not None:
        return same

    def read() -> Response:
        listed = all_cards(files.path_of(state.store, digest, size), state.settings.image_limits)
        content = [{"index": one.index, "name": one.name, "cards": one.cards} for one in listed]
        return JSONResponse(content, headers=sent)

    with as_problems():
        return await state.stored.run(owner, read)  # thousands of cards take a second
