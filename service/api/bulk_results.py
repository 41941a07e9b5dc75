"""What a bulk has done, image by image: ``/v1/bulk/{id}/results``, as lines of JSON or as a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, Field

from service.api.bulk import BulkId, find
from service.http.callers import Reading
from service.http.problems import RESPONSES
from service.http.state import Shared
from workers.catalogue.bulk_progress import BulkProgress
from workers.catalogue.bulk_tables import BulkItemRow
from workers.contract.bulk import ItemState

router = APIRouter(prefix="/v1/bulk", tags=["bulk"], responses=RESPONSES)
NDJSON, CSV = "application/x-ndjson", "text/csv"


class Change(BaseModel):
    """Change of the brightest or darkest 1 % of blocks of 4 x 4 pixels."""

    sum_pct: float
    up_to_pct: float


class Result(BaseModel):
    """An image that is done."""

    position: int
    source: str = Field(description="the upload's id, or the file's path")
    image_sha256: str
    psf_id: str
    product_id: str
    file: str | None = Field(description="address of the product; null where the service does not keep it")
    output: str | None = Field(description="path of the product in the output folder")
    sha256: str = Field(description="of the product's file")
    bytes: int
    reused: bool = Field(description="whether it was there already")
    score: float = Field(description="of the artefact check: below 1 nothing was found")
    flux_change_pct: float
    bright: Change | None
    dark: Change | None
    signs: dict[str, float | None] = Field(description="of artefacts, each")
    steps_done: int
    stopped_because: str
    negative_pixels: int
    ended_at: float
    seconds: float | None = Field(description="that the worker had it")
    kernel_seconds: float | None = Field(
        description="of it, deconvolving and looking at what that did; null where it was there already"
    )

    @classmethod
    def of(cls, row: BulkItemRow) -> Result:
        """The line of a row."""
        assert row.statistics is not None
        told: dict[str, Any] = {"seconds": None, "kernel_seconds": None, **row.statistics}
        own = {name: getattr(row, name) for name in cls.model_fields if hasattr(row, name)}
        file = f"/v1/products/{row.product_id}/file" if row.kept else None
        return cls.model_validate({**told, **own, "file": file})

    def flat(self) -> dict[str, Any]:
        """As a row of a table."""
        told = self.model_dump(exclude=NESTED)
        for kind in CHANGES:
            change: Change | None = getattr(self, kind)
            told[f"{kind}_sum_pct"] = None if change is None else change.sum_pct
            told[f"{kind}_up_to_pct"] = None if change is None else change.up_to_pct
        return told


CHANGES = ("bright", "dark")
NESTED = {*CHANGES, "signs"}
COLUMNS = [name for name in Result.model_fields if name not in NESTED] + [
    f"{kind}_{what}" for kind in CHANGES for what in Change.model_fields
]


@router.get(
    "/{bulk_id}/results",
    summary="The manifest of what is done: checksums, change and artefacts of each image",
    response_class=Response,
    responses={
        200: {
            "description": "One image a line: position, source, image_sha256, psf_id, product_id, file (address), "
            "output (path), sha256, bytes, reused, score, flux_change_pct, bright, dark, signs, and more.",
            "content": {NDJSON: {"schema": {"type": "string"}}, CSV: {"schema": {"type": "string"}}},
        }
    },
)
def get_results(
    bulk_id: BulkId,
    caller: Reading,
    state: Shared,
    format: Literal["ndjson", "csv"] = "ndjson",
    order: Annotated[
        Literal["bulk", "worst"], Query(description="as the bulk's images are, or the most doubtful first")
    ] = "bulk",
    limit: Annotated[int | None, Query(ge=1, le=1_000_000, description="lines; none: all")] = None,
) -> Response:
    """All images that are done so far, as they come out of the database: there may be very many."""
    row = find(state, caller, bulk_id)
    rows = _in_order(state.catalogue.bulks.progress, row.id, order, limit)
    headers = {"Content-Disposition": f'attachment; filename="bulk-{bulk_id[:12]}.{format}"'}
    lines, media_type = (_table(rows), CSV) if format == "csv" else (_json_lines(rows), NDJSON)
    return StreamingResponse(lines, media_type=media_type, headers=headers)


def _in_order(progress: BulkProgress, bulk_id: str, order: str, limit: int | None) -> Iterator[list[Result]]:
    """Results, a batch at a time; each batch is a look into the database of its own."""
    left = limit
    after, behind = -1, None
    while left is None or left > 0:
        if order == "worst":
            batch = progress.worst(bulk_id, after=behind)
        else:
            batch = progress.items(bulk_id, ItemState.DONE, after=after)
        if not batch:
            return
        after = batch[-1].position
        behind = (float(batch[-1].score or 0.0), after)
        yield [Result.of(row) for row in islice(batch, left)]
        left = None if left is None else left - len(batch)


def _json_lines(batches: Iterator[list[Result]]) -> Iterator[str]:
    for batch in batches:
        yield "".join(f"{result.model_dump_json()}\n" for result in batch)


def _table(batches: Iterator[list[Result]]) -> Iterator[str]:
    yield _rows([COLUMNS])
    for batch in batches:
        yield _rows([list(result.flat().values()) for result in batch])


def _rows(rows: Sequence[Sequence[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
