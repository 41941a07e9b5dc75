"""Deconvolves an image of a bulk run, which is an upload or a file. The product goes into the service, into a folder,
or both.

The work has three parts, which a turn runs in three threads for three images at the same time: `read_one`,
`compute_one` and `write_one`.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from psfcore.files import sha256_of
from psfcore.fits.header import read_summary
from psfcore.image import Image
from workers.bulk import outputs
from workers.bulk.runs import resolved_image
from workers.catalogue.tables import BulkItemRow, BulkRow, ImageRow, ProductRow
from workers.contract.bulk import BulkWork
from workers.contract.documents import header_json
from workers.contract.identities import product_identity
from workers.contract.requests import ResolvedDeconvolve
from workers.files import archive as archive_files
from workers.files.store import is_disk_full
from workers.intake import estimates
from workers.intake.compatibility import details_now
from workers.tasks import deconvolve as deconvolve_task
from workers.tasks.catalogue_workspace import CatalogueWorkspace
from workers.tasks.workspace import Result

# The changes of an image are summarised for blocks of 4 × 4 px: the brightest and the darkest 1 % of the blocks.
BLOCK_PX, TAIL_PCT = 4, 1.0
LOOK_AGAIN_S = 0.5


@dataclass(frozen=True)
class Outcome:
    """The result of an image, as the columns of its row."""

    image_sha256: str
    psf_id: str
    product_id: str
    reused: bool
    kept: bool
    output: str | None
    sha256: str
    bytes: int
    score: float
    statistics: dict[str, Any]


@dataclass(frozen=True)
class Destination:
    """The product of an image: the id, the request of the run, and the path in the output folder or None."""

    identity: str
    run: BulkWork
    target: Path | None


@dataclass(frozen=True)
class Ready:
    """An image that was read and can be deconvolved.

    `start_s` is the estimated time of its deconvolution, s, before the measured factor is applied.
    """

    request: ResolvedDeconvolve
    image: Image
    destination: Destination
    start_s: float


def read_one(workspace: CatalogueWorkspace, bulk: BulkRow, item: BulkItemRow) -> Ready | Outcome:
    """Read an image of a bulk run and choose its PSF. If its product exists already, return this product.

    If another job is making the product now, wait for that job and use its product. Raises DataError for an image
    that cannot be deconvolved, and OSError if the disk is full.
    """
    settings, run = workspace.settings, BulkWork.model_validate(bulk.request)
    with _source(workspace, item) as source:
        request = resolved_image(bulk, source.sha256, source.summary, workspace.catalogue)
        identity, target = product_identity(request), None
        if run.output is not None:
            target = outputs.target_of(run.output, settings, source, identity=identity, psf_id=request.psf_id)
            if item.attempts > 1:
                outputs.remove_partials(target, settings)
        destination = Destination(identity, run, target)
        before = done_before(workspace, destination)
        if before is None and run.output is not None and target is not None:
            outputs.prepare(run.output, target, identity, settings, workspace.limits)
        if before is None and run.keeps_products and _waited(workspace, identity):
            before = done_before(workspace, destination)
        if before is not None:
            return before
        needs = request.model_dump(mode="json") | {"image_shape": source.summary["shape"]}
        expected = estimates.checked("deconvolve", needs, workspace.catalogue, workspace.owner, settings)
        # The path is taken only now, because the store's local copy may have been removed during a wait.
        image_file = source.copy or workspace.store.verified(source.sha256)
        image = deconvolve_task.load(workspace, request, image_file)
        return Ready(request, image, destination, expected["start_s"])


def compute_one(workspace: CatalogueWorkspace, ready: Ready) -> Result:
    """Deconvolve an image that was read. Builds the PSF first if it does not exist. Raises DataError."""
    preview = ready.destination.run.keeps_products
    return deconvolve_task.make(workspace, ready.request, lambda: ready.image, preview=preview)


def write_one(workspace: CatalogueWorkspace, ready: Ready, result: Result) -> Outcome:
    """Write a finished deconvolution as a product. Raises DataError "output-not-written", and OSError if the disk is
    full.
    """
    output, target = ready.destination.run.output, ready.destination.target
    if ready.destination.run.keeps_products:
        row = workspace.keep(result)
        assert isinstance(row, ProductRow)
        return _kept(workspace, row, ready.destination, reused=False)
    assert output is not None and target is not None
    with workspace.store.temporary() as path:
        result.files["file"](path)
        sha256, size_bytes = sha256_of(path), path.stat().st_size
        outputs.put(output, path, target, sha256, workspace.settings)
    return Outcome(
        image_sha256=ready.request.image_id,
        psf_id=ready.request.psf_id,
        product_id=result.id,
        reused=False,
        kept=False,
        output=str(target),
        sha256=sha256,
        bytes=size_bytes,
        score=_score(result.details),
        statistics=statistics_of(result.details),
    )


def _waited(workspace: CatalogueWorkspace, identity: str) -> bool:
    """Wait while another job makes this product. Returns whether there was such a job."""
    waited = False
    while workspace.catalogue.jobs.at_work_on(workspace.owner, identity):
        waited = True
        workspace.report("waiting for an equal job", 0, 1)  # raises an exception if the bulk run must stop
        _rest()
    return waited


def _rest() -> None:
    time.sleep(LOOK_AGAIN_S)


@contextmanager
def _source(workspace: CatalogueWorkspace, item: BulkItemRow) -> Iterator[outputs.Source]:
    if item.uploaded:
        row = workspace.row(ImageRow, item.source)
        yield outputs.Source(row.id, row.summary, row.filename or "image")
        return
    allowed = archive_files.roots(workspace.settings.bulk_roots)
    path = archive_files.check_under(Path(item.source), allowed)
    with workspace.store.temporary() as copy:
        try:
            with archive_files.opened(path, allowed) as file:
                sha256 = archive_files.copy_hashed(file, copy, workspace.settings.max_upload_bytes)
        except OSError as error:
            if is_disk_full(error):  # the copy cannot be written; the same error would occur for every image
                raise
            raise archive_files.unreadable(error) from error
        summary = header_json(dataclasses.asdict(read_summary(copy, workspace.limits)))
        yield outputs.Source(sha256, summary, path.name, path, copy)


def done_before(workspace: CatalogueWorkspace, destination: Destination) -> Outcome | None:
    """The existing product, copied to the output folder if it is not there yet; None if there is no product."""
    target = destination.target
    if destination.run.keeps_products:
        row = workspace.made(ProductRow, destination.identity)
        return None if row is None else _kept(workspace, row, destination, reused=True)
    find = workspace.catalogue.bulks.progress.done_before
    earlier = find(workspace.owner, destination.identity, str(target))
    if earlier is None or target is None or not target.is_file() or sha256_of(target) != earlier.sha256:
        return None
    columns = {name: getattr(earlier, name) for name in Outcome.__annotations__}
    statistics = {
        name: value
        for name, value in (earlier.statistics or {}).items()
        if not name.endswith(("seconds", "_s"))
    }
    return Outcome(**columns | {"reused": True, "kept": False, "statistics": statistics})


def _kept(
    workspace: CatalogueWorkspace, row: ProductRow, destination: Destination, *, reused: bool
) -> Outcome:
    """The outcome for a product that the service keeps."""
    output, target = destination.run.output, destination.target
    if output is not None and target is not None:
        there = target.is_file() and target.stat().st_size == row.bytes
        if not there or sha256_of(target) != row.file_sha256:
            file = workspace.store.verified(row.file_sha256)
            outputs.put(output, file, target, row.file_sha256, workspace.settings)
    return Outcome(
        image_sha256=row.image_id,
        psf_id=row.psf_id,
        product_id=row.id,
        reused=reused,
        kept=True,
        output=None if target is None else str(target),
        sha256=row.file_sha256,
        bytes=row.bytes,
        score=_score(row.details),
        statistics=statistics_of(details_now(workspace.catalogue, row)),
    )


def _score(details: Mapping[str, Any]) -> float:
    return float(details["changes"]["artefacts"]["score"])


def statistics_of(details: Mapping[str, Any]) -> dict[str, Any]:
    """A summary of the changes and artefacts in the details of a product."""
    artefacts, structures = details["changes"]["artefacts"], details["changes"]["structures"]
    changes = {
        row["kind"]: {"sum_pct": row["sum_pct"], "up_to_pct": row["up_to_pct"]}
        for row in structures
        if (row["block_px"], row["tail_pct"]) == (BLOCK_PX, TAIL_PCT)
    }
    return {
        "flux_change_pct": details["flux_change_pct"],
        "bright": changes.get("bright"),
        "dark": changes.get("dark"),
        "signs": artefacts["signs"],
        "negative_pixels": details["negative_pixels"],
        "steps_done": details["steps_done"],
        "stopped_because": details["stopped_because"],
        "warnings": [one["code"] for one in details["warnings"]],
        "has_thumbnail": details.get("thumbnail_sha256") is not None,
    }
