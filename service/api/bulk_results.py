"""The results of a bulk run, image by image, as JSON lines or as CSV: ``/v1/bulk/{id}/results``."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, Field

from service.api.bulk import BulkId, find
from service.http.callers import Reading
from service.http.problems import RESPONSES
from service.http.state import Shared
from service.views import RowView
from workers.catalogue.bulk_progress import BATCH, BulkProgress
from workers.catalogue.bulk_tables import BulkItemRow
from workers.contract.bulk import ItemState

router = APIRouter(prefix="/v1/bulk", tags=["bulk"], responses=RESPONSES)
NDJSON, CSV = "application/x-ndjson", "text/csv"


class Change(BaseModel):
    """Change of the intensity in the brightest or the darkest 1 % of the blocks of 4 x 4 pixels.

    sum_pct: change of the summed intensity of these blocks. up_to_pct: percentile 99 of the changes of the bright
    blocks, or percentile 1 of the changes of the dark blocks.
    """

    sum_pct: float
    up_to_pct: float


class Result(RowView):
    """A done image."""

    position: int
    source: str = Field(description="id of the upload, or path of the file")
    image_sha256: str
    psf_id: str
    product_id: str
    file: str | None = Field(
        description="address of the product; null: the service does not keep the product"
    )
    thumbnail: str | None = Field(
        None, description="address of a small picture of the product; null: the service keeps none"
    )
    provenance: str | None = Field(
        None,
        description="address of the product's lineage as W3C PROV; null: the service does not keep the product",
    )
    output: str | None = Field(
        description="path of the product in the output folder; null: the run has no output folder"
    )
    sha256: str = Field(description="SHA-256 of the product's file")
    bytes: int
    reused: bool = Field(
        description="whether the product already existed, so that the image was not deconvolved"
    )
    score: float = Field(description="artefact score; below 1: no signs of artefacts were found")
    flux_change_pct: float
    bright: Change | None
    dark: Change | None
    signs: dict[str, float | None] = Field(
        description="the signs of artefacts, and the measured value of each sign"
    )
    steps_done: int
    stopped_because: str
    negative_pixels: int
    warnings: list[str] = Field(
        default_factory=list,
        description="codes of the product's warnings; the product's details have their texts",
    )
    ended_at: float
    seconds: float | None = Field(description="time that the worker spent on the image; null: unknown")
    kernel_seconds: float | None = Field(
        description="part of `seconds` that was spent on deconvolving and on measuring changes; null: the product already existed"
    )

    @classmethod
    def of(cls, row: BulkItemRow) -> Result:
        """The result of one image of a bulk run, from its row in the catalogue."""
        assert row.statistics is not None
        product, statistics = f"/v1/products/{row.product_id}", row.statistics
        addresses = {
            "file": f"{product}/file" if row.kept else None,
            "provenance": f"{product}/provenance" if row.kept else None,
            "thumbnail": f"{product}/thumbnail" if row.kept and statistics["has_thumbnail"] else None,
        }
        return cls.of_columns(row, **{"seconds": None, "kernel_seconds": None, **statistics, **addresses})

    def flat(self) -> dict[str, Any]:
        """The values of a CSV row."""
        told = self.model_dump(exclude=NESTED) | {"warnings": " ".join(self.warnings)}
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
    summary="Manifest of the done images: checksums, changes and artefacts",
    response_class=Response,
    responses={
        200: {
            "description": "One image per line: position, source, image_sha256, psf_id, product_id, file (address), "
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
        Literal["bulk", "worst"],
        Query(description="`bulk`: order of the run; `worst`: highest artefact score first"),
    ] = "bulk",
    limit: Annotated[
        int | None, Query(ge=1, le=1_000_000, description="number of images; default: all")
    ] = None,
    warning: Annotated[
        str | None,
        Query(max_length=40, description="only images with this warning, by its code, for example `frame`"),
    ] = None,
) -> Response:
    """All images that are done so far, streamed from the database."""
    row = find(state, caller, bulk_id)
    rows = _in_order(state.catalogue.bulks.progress, row.id, order, limit, warning)
    headers = {"Content-Disposition": f'attachment; filename="bulk-{bulk_id[:12]}.{format}"'}
    lines, media_type = (_table(rows), CSV) if format == "csv" else (_json_lines(rows), NDJSON)
    return StreamingResponse(lines, media_type=media_type, headers=headers)


def _in_order(
    progress: BulkProgress, bulk_id: str, order: str, limit: int | None, warning: str | None
) -> Iterator[list[Result]]:
    """Results in batches; each batch is one query. warning: see `get_results`."""
    left = limit
    after, behind = -1, None
    while left is None or left > 0:
        size = BATCH if left is None or warning is not None else min(BATCH, left)
        if order == "worst":
            batch = progress.worst(bulk_id, after=behind, limit=size)
        else:
            batch = progress.items(bulk_id, ItemState.DONE, after=after, limit=size)
        if not batch:
            return
        after = batch[-1].position
        behind = (float(batch[-1].score or 0.0), after)
        results = [Result.of(row) for row in batch]
        results = [one for one in results if warning is None or warning in one.warnings][:left]
        yield results
        left = None if left is None else left - len(results)


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
