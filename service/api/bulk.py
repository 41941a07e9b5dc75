"""Bulk runs, many images deconvolved in the same way: ``/v1/bulk``; and their results, image by image, as JSON lines or
as CSV.
"""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict, Field

from psfcore.deconvolve.summary import LOOK_FROM
from service.http.callers import Bulk, Caller, KeyFirst, Reading
from service.http.paging import Page, Paging, place, position
from service.http.problems import RESPONSES, Problem, as_problems, problem
from service.http.quotas import check_room
from service.http.state import Shared
from service.views import RowView
from workers.bulk.dry_run import BulkEstimate, dry_run
from workers.bulk.runs import begin, cancel_turns
from workers.catalogue.bulk_progress import BATCH, BulkProgress
from workers.catalogue.tables import BulkItemRow, BulkRow
from workers.contract.bulk import STOPPED, BulkPhase, BulkRequest, ItemState
from workers.contract.jobs import JobError
from workers.lookup import no_such

log = logging.getLogger(__name__)
router = APIRouter(prefix="/v1/bulk", tags=["bulk"], responses=RESPONSES, route_class=KeyFirst)
BulkId = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
SAMPLE, MOST_SAMPLED = 200, 10_000  # images that an estimate examines
NDJSON, CSV = "application/x-ndjson", "text/csv"


class Counts(BaseModel):
    """Numbers of images by state."""

    total: int = Field(description="images listed so far; more are added while `listed` is false")
    waiting: int
    at_work: int
    done: int
    reused: int = Field(
        description="done images whose product already existed, so that they were not deconvolved"
    )
    failed: int
    to_look_at: int = Field(
        description=f"done images that a person should inspect: artefact score {LOOK_FROM:g} or more"
    )


class BulkView(RowView):
    """A bulk run."""

    id: str
    name: str
    phase: BulkPhase
    created_at: float
    ended_at: float | None
    psf_id: str | None = Field(
        description="id of the PSF of all images; null: the context pins a PSF for each image"
    )
    context_id: str | None
    request: dict[str, object] = Field(description="the request, without the ids of uploaded images")
    listed: bool = Field(
        description="whether all files are listed; false: the numbers of images and of waiting images are too small"
    )
    images: Counts
    images_an_hour: float | None = Field(description="speed in the last hour; null: unknown")
    time_left_s: float | None = Field(
        description="estimated time left; null: unknown, for example while files are listed, or the run is not running"
    )
    error: JobError | None = Field(description="the error that stopped the run; null: no error stopped it")
    results: str = Field(description="address of the manifest of the done images")
    failures: str = Field(description="address of the failed images, with reasons")
    events: str = Field(description="address at which progress is sent as server-sent events")

    @classmethod
    def of(cls, row: BulkRow, state: Shared) -> BulkView:
        """The description of a bulk run, from its row in the catalogue."""
        progress = state.catalogue.bulks.progress
        pace, here = progress.pace(row), f"/v1/bulk/{row.id}"
        left = row.total - row.done - row.failed
        rate = None if row.phase in STOPPED else pace.images_an_hour
        counts = Counts(
            total=row.total,
            waiting=max(0, left - pace.taken),
            at_work=pace.taken,
            done=row.done,
            reused=row.reused,
            failed=row.failed,
            to_look_at=progress.to_look_at(row.id, LOOK_FROM),
        )
        return cls.of_columns(
            row,
            images=counts,
            images_an_hour=rate,
            time_left_s=left * 3600.0 / rate if rate and row.phase == BulkPhase.RUNNING else None,
            results=f"{here}/results",
            failures=f"{here}/failures",
            events=f"{here}/events",
        )


class BulkLine(BaseModel):
    """A bulk run in a list."""

    model_config = ConfigDict(from_attributes=True)
    id: str
    name: str
    phase: BulkPhase
    created_at: float
    ended_at: float | None
    listed: bool = Field(description="whether all files are listed; false: `total` is too small")
    total: int
    done: int
    failed: int


class Failed(BaseModel):
    """An image that could not be deconvolved."""

    model_config = ConfigDict(from_attributes=True)
    position: int
    source: str = Field(description="id of the upload, or path of the file")
    attempts: int
    ended_at: float | None
    error: JobError


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
    score: float = Field(
        description="artefact score; below 1: each sign of artefacts is below the level of its alarm"
    )
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
        description="part of `seconds` that was spent on deconvolving and on measuring changes; null: the product "
        "already existed"
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

    def flat(self) -> dict[str, object]:
        """The values of a CSV row."""
        row = self.model_dump(exclude=NESTED) | {"warnings": " ".join(self.warnings)}
        for kind in CHANGES:
            change: Change | None = getattr(self, kind)
            row[f"{kind}_sum_pct"] = None if change is None else change.sum_pct
            row[f"{kind}_up_to_pct"] = None if change is None else change.up_to_pct
        return row


CHANGES = ("bright", "dark")
NESTED = {*CHANGES, "signs"}
COLUMNS = [name for name in Result.model_fields if name not in NESTED] + [
    f"{kind}_{what}" for kind in CHANGES for what in Change.model_fields
]


@router.post("/estimate", summary="Estimate a bulk run without starting it")
def estimate_bulk(
    body: BulkRequest,
    caller: Bulk,
    state: Shared,
    sample: Annotated[
        int, Query(ge=1, le=MOST_SAMPLED, description="largest number of images that are examined")
    ] = SAMPLE,
) -> BulkEstimate:
    """Count the images of a bulk run, examine a sample of them, and estimate the run. Nothing is started or stored.

    The request and its errors are the same as for `POST /v1/bulk`. The pixels are not read. Therefore the run may also
    refuse images whose pixels cannot be used.
    """
    with as_problems():
        return dry_run(body, state.catalogue, caller.owner, state.settings, sample=sample)


@router.post(
    "",
    status_code=202,
    summary="Start a bulk run",
    responses={
        200: {
            "model": BulkView,
            "description": "A bulk run of an identical request is open; the answer is that run.",
        }
    },
)
def submit_bulk(body: BulkRequest, response: Response, caller: Bulk, state: Shared) -> BulkView:
    """Deconvolve many images in the same way. Workers list the files, and deconvolve images as soon as they are listed.
    All other jobs run first.

    The PSF, or the context that pins a PSF for each image, is fixed when the run starts. An existing product is not
    made again.
    """
    if body.keeps_products:
        check_room(state, caller.owner)
    with as_problems():
        row, new = begin(body, state.catalogue, caller.owner, state.settings)
    if new:
        log.info("bulk run %s: submitted, %d uploads", row.id, row.total, extra={"fields": {"bulk": row.id}})
        state.reconciler.wake()
    response.status_code = 202 if new else 200
    response.headers["Location"] = f"/v1/bulk/{row.id}"
    return BulkView.of(row, state)


@router.get("", summary="List bulk runs")
def list_bulks(
    paging: Paging, caller: Reading, state: Shared, phase: BulkPhase | None = None
) -> Page[BulkLine]:
    """Bulk runs, newest first."""
    rows = state.catalogue.page(BulkRow, owner=caller.owner, phase=phase, **paging.query)
    return paging.page(rows, BulkLine.model_validate)


@router.get("/{bulk_id}", summary="One bulk run: progress, speed and time left")
def get_bulk(bulk_id: BulkId, caller: Reading, state: Shared) -> BulkView:
    """The bulk run as it is now."""
    return BulkView.of(find(state, caller, bulk_id), state)


@router.get("/{bulk_id}/failures", summary="Failed images, with reasons")
def list_failures(bulk_id: BulkId, paging: Paging, caller: Reading, state: Shared) -> Page[Failed]:
    """The failed images, in the order of the run."""
    row = find(state, caller, bulk_id)
    (after,) = place(paging.cursor, position) or (-1,)
    items = state.catalogue.bulks.progress.items(
        row.id, ItemState.FAILED, after=after, limit=paging.limit + 1
    )
    return paging.page(items, Failed.model_validate, lambda item: (str(item.position),))


@router.post("/{bulk_id}/pause", summary="Pause a bulk run")
def pause_bulk(bulk_id: BulkId, caller: Bulk, state: Shared) -> BulkView:
    """Pause a run: workers finish the images that they have started, and start no others."""
    row = find(state, caller, bulk_id)
    _done(state.catalogue.bulks.pause(row.id), row, "LISTING or RUNNING")
    return get_bulk(bulk_id, caller, state)


@router.post("/{bulk_id}/resume", summary="Resume a bulk run")
def resume_bulk(bulk_id: BulkId, caller: Bulk, state: Shared) -> BulkView:
    """Resume a paused or failed bulk run."""
    row = find(state, caller, bulk_id)
    _done(state.catalogue.bulks.resume(row.id), row, "PAUSED or ERROR")
    state.reconciler.wake()
    return get_bulk(bulk_id, caller, state)


@router.post("/{bulk_id}/cancel", summary="Cancel a bulk run")
def cancel_bulk(bulk_id: BulkId, caller: Bulk, state: Shared) -> BulkView:
    """End the run. Workers stop at the next step of their images. Finished products are kept."""
    row = find(state, caller, bulk_id)
    _done(state.catalogue.bulks.cancel(row.id), row, "LISTING, RUNNING, PAUSED or ERROR")
    cancel_turns(state.catalogue, row.id)
    return get_bulk(bulk_id, caller, state)


@router.post("/{bulk_id}/retry", summary="Retry failed images")
def retry_bulk(bulk_id: BulkId, caller: Bulk, state: Shared) -> BulkView:
    """Queue the failed images again. Images that are already done are not processed again.

    The answer is 409 if this run has ended and another bulk run of an identical request is open. The message names that
    run.
    """
    row = find(state, caller, bulk_id)
    with as_problems():
        changed = state.catalogue.bulks.retry(row.id)
    _done(changed is not None, row, "other than CANCELLED", ": start a new one")
    state.reconciler.wake()
    return get_bulk(bulk_id, caller, state)


@router.delete("/{bulk_id}", status_code=204, summary="Delete a bulk run", response_class=Response)
def delete_bulk(bulk_id: BulkId, caller: Bulk, state: Shared) -> Response:
    """Remove the run from the catalogue and from your quota. Its products and the files in its output folder stay.

    The manifest and the reasons of failures are deleted with the run. The answer is 409 if the run is LISTING or
    RUNNING: cancel the run first. If the service stops during the deletion, a cancelled run with fewer images may
    remain: delete this run again. If a product is only in the output folder, a later run makes the product again,
    because only the deleted run knew its file.
    """
    row = find(state, caller, bulk_id)
    if not state.catalogue.bulks.delete(row.id):
        there = find(state, caller, bulk_id)  # if another request deleted it meanwhile, the answer is 404
        _done(False, there, "PAUSED, ERROR, COMPLETED or CANCELLED", ": cancel it first")
    cancel_turns(state.catalogue, row.id)
    return Response(status_code=204)


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
    json_lines = ("".join(f"{one.model_dump_json()}\n" for one in batch) for batch in rows)
    lines, media_type = (_table(rows), CSV) if format == "csv" else (json_lines, NDJSON)
    return StreamingResponse(lines, media_type=media_type, headers=headers)


def _in_order(
    progress: BulkProgress, bulk_id: str, order: str, limit: int | None, warning: str | None
) -> Iterator[list[Result]]:
    """Results of a bulk run in batches; each batch is one query. If ``warning`` is the code of a warning, only results
    with this warning.
    """
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


def _table(batches: Iterator[list[Result]]) -> Iterator[str]:
    yield _rows([COLUMNS])
    for batch in batches:
        yield _rows([list(result.flat().values()) for result in batch])


def _rows(rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def find(state: Shared, caller: Caller, bulk_id: str) -> BulkRow:
    """The row of a bulk run of the caller. Raises ``Problem`` 404."""
    row = state.catalogue.bulks.get(bulk_id)
    if row is None or row.owner != caller.owner:
        raise problem(no_such("bulk", bulk_id))
    return row


def _done(changed: bool, row: BulkRow, expected: str, advice: str = "") -> None:
    if not changed:
        raise Problem(
            409,
            "wrong-phase",
            f"expected a bulk run in phase {expected}; this bulk run is in phase {row.phase}{advice}",
        )
