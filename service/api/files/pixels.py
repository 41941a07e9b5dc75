"""Pixels of images and products, ``.../pixels``: raw numbers, so that a viewer can show exact values.

The first request for a plane decodes it; later requests read the decoded plane (``psfcore.fits.viewing``). The first
request for pixels loads the numerical libraries.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, BinaryIO, Literal

import anyio.to_thread
from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse

from psfcore.errors import DataError
from psfcore.fits.viewing.planes import Decoded, Plane, decode_plane
from service.http import downloads as files
from service.http.callers import Reading
from service.http.problems import RESPONSES, Problem, problem
from service.http.quotas import check_disk
from service.http.state import Shared, State
from workers.catalogue.tables import ImageRow, ProductRow
from workers.contract.requests import Identity

# This number is part of every ETag. Increase it when a new version of the code gives another answer for the same file.
ANSWERS_VERSION = 1
MEDIA_TYPE = "application/octet-stream"
IMAGE, QUALITY = "image", "quality"
LARGEST = 2**31 - 1
router = APIRouter(tags=["pixels"], responses=RESPONSES)


@dataclass(frozen=True)
class Part:
    """The window of an image that a request asks for, in pixels. step: every step-th row and column is sent.

    width, height: None means up to the last column or row.
    """

    x: int
    y: int
    width: int | None
    height: int | None
    step: int


def _part(
    x: Annotated[int, Query(ge=0, le=LARGEST, description="first column of the window, counted from 0")] = 0,
    y: Annotated[
        int, Query(ge=0, le=LARGEST, description="first row of the window, counted from 0 as in FITS")
    ] = 0,
    width: Annotated[
        int | None, Query(ge=1, le=LARGEST, description="number of columns; default: up to the last column")
    ] = None,
    height: Annotated[
        int | None, Query(ge=1, le=LARGEST, description="number of rows; default: up to the last row")
    ] = None,
    step: Annotated[
        int,
        Query(
            ge=1,
            le=LARGEST,
            description="n: each number of the answer stands for a block of n x n pixels. The number is the mean of the finite "
            "pixels; for `quality`, the bitwise OR. Blocks at the last rows and columns of the window may be smaller",
        ),
    ] = 1,
) -> Part:
    return Part(x, y, width, height, step)


Asked = Annotated[Part, Depends(_part)]
SHAPE = {"type": "string", "pattern": r"^\d+,\d+$"}
DESCRIBED: dict[int | str, dict[str, Any]] = {
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
    asked: Asked,
    plane: Annotated[Literal["image"], Query(description="an uploaded image has one plane")] = "image",
) -> Response:
    """The pixel values of the file, in DN or DN/s as they are stored (BSCALE and BZERO applied). Saturated pixels are not marked."""
    await run_in_threadpool(state.row, ImageRow, image_id, caller.owner)
    return await _pixels(request, state, image_id, plane, asked)


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
    asked: Asked,
    plane: Annotated[
        Literal["image", "error", "quality"],
        Query(
            description="the deconvolved image, or its plane ERROR or QUALITY; `error` needs a job with `error_draws`"
        ),
    ] = "image",
) -> Response:
    """The pixel values of a plane of the product. Values of `quality` are whole numbers, as in the file. 404: the product does not
    have this plane."""
    row = await run_in_threadpool(state.row, ProductRow, product_id, caller.owner)
    return await _pixels(request, state, row.file_sha256, plane, asked)


async def _pixels(request: Request, state: Shared, digest: str, name: str, asked: Part) -> Response:
    """A part of a plane of a stored file, or 304 if the client already has it."""
    tag = hashlib.sha256(f"{ANSWERS_VERSION} {digest} pixels {name} {asked}".encode()).hexdigest()
    headers = {"ETag": f'"{tag}"', "Cache-Control": files.KEPT}
    if files.known(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    plane = state.planes.kept((digest, name))
    try:
        if plane is None:
            plane = await anyio.to_thread.run_sync(_decoded, state, digest, name, limiter=state.decoding)
        shape, length, pieces = await run_in_threadpool(_cut, plane, asked, name == QUALITY)
    except DataError as error:
        raise problem(error) from error
    headers["X-Plane-Shape"] = "{},{}".format(*plane.shape)
    headers["X-Pixels-Shape"] = "{},{}".format(*shape)
    headers["Content-Length"] = str(length)
    if plane.unit is not None:
        headers["X-Pixels-Unit"] = plane.unit
    return StreamingResponse(pieces, media_type=MEDIA_TYPE, headers=headers)


async def prepare_image(state: State, digest: str) -> None:
    """Decode the image of a stored file in advance, so that a later request for its pixels is answered at once.

    If the file cannot be decoded, this function raises no error; the later request gets the error.
    """
    if state.planes.kept((digest, IMAGE)) is None:
        with contextlib.suppress(DataError, Problem):
            await anyio.to_thread.run_sync(_decoded, state, digest, IMAGE, limiter=state.decoding)


def _decoded(state: State, digest: str, name: str) -> Plane:
    def decode(target: BinaryIO) -> Decoded:
        check_disk(state)
        # The checksum of the whole file is verified, because browsers keep the pixels for a long time.
        return decode_plane(files.found(state.store, digest), name, state.limits, target)

    return state.planes.decoded((digest, name), decode)


def _cut(plane: Plane, asked: Part, bits: bool) -> tuple[tuple[int, int], int, Iterator[bytes]]:
    """Shape, number of bytes and bytes of the answer. Raises DataError "window-outside"."""
    from psfcore.fits.viewing.windows import pixels, window_of

    window = window_of(
        plane.shape, x=asked.x, y=asked.y, width=asked.width, height=asked.height, step=asked.step
    )
    return window.shape, window.length, pixels(plane, window, bits=bits)
