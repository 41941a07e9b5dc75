"""All headers of images and products, ``.../header``."""

from __future__ import annotations

import hashlib

import anyio.to_thread
from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field

from psfcore.errors import DataError
from psfcore.fits.header import all_cards
from service.http import downloads as files
from service.http.callers import Reading
from service.http.problems import RESPONSES, problem
from service.http.state import Shared
from workers.catalogue.tables import ImageRow, ProductRow
from workers.contract.requests import Identity

# This number is part of every ETag. Increase it when a new version of the code gives another answer for the same file.
ANSWERS_VERSION = 1
router = APIRouter(tags=["headers"], responses=RESPONSES)


class HduHeader(BaseModel):
    """The header of one HDU of a FITS file."""

    index: int = Field(description="number of the HDU, counted from 0")
    name: str = Field(description="EXTNAME; empty: the HDU has no name")
    cards: list[tuple[str, str | int | float | bool | None, str]] = Field(
        description="keyword, value and comment of each card, in the order of the file; value null: the card has no value"
    )


@router.get(
    "/v1/images/{image_id}/header", summary="All headers of an uploaded image", response_model=list[HduHeader]
)
async def get_image_header(image_id: Identity, request: Request, caller: Reading, state: Shared) -> Response:
    """Every card of every HDU, with COMMENT and HISTORY. A tile-compressed image has the header of the table that holds it."""
    row = await run_in_threadpool(state.row, ImageRow, image_id, caller.owner)
    return await _headers(request, state, image_id, row.bytes)


@router.get(
    "/v1/products/{product_id}/header", summary="All headers of a product", response_model=list[HduHeader]
)
async def get_product_header(
    product_id: Identity, request: Request, caller: Reading, state: Shared
) -> Response:
    """Every card of the image and of its planes, with COMMENT and HISTORY."""
    row = await run_in_threadpool(state.row, ProductRow, product_id, caller.owner)
    return await _headers(request, state, row.file_sha256, row.bytes)


async def _headers(request: Request, state: Shared, digest: str, size: int) -> Response:
    tag = hashlib.sha256(f"{ANSWERS_VERSION} {digest} header".encode()).hexdigest()
    headers = {"ETag": f'"{tag}"', "Cache-Control": files.KEPT}
    if files.known(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    try:
        # Reading thousands of cards takes a second. The limiter bounds how many requests read cards or pixels at once.
        return await anyio.to_thread.run_sync(_answer, state, digest, size, headers, limiter=state.decoding)
    except DataError as error:
        raise problem(error) from error


def _answer(state: Shared, digest: str, size: int, headers: dict[str, str]) -> Response:
    listed = all_cards(files.found(state.store, digest, size), state.limits)
    return JSONResponse(
        [{"index": one.index, "name": one.name, "cards": one.cards} for one in listed], headers=headers
    )
