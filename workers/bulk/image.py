"""Deconvolves an image of a bulk run, which is an upload or a file. The product goes into the service, into a folder, or both.

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

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits, first_image_header, optional_text, read_summary
from psfcore.image import Image
from workers.bulk.targets import target_of
from workers.catalogue.bulk_tables import BulkItemRow, BulkRow
from workers.catalogue.tables import ImageRow, ProductRow
from workers.contract.bulk import BulkWork
from workers.contract.identities import product_identity
from workers.contract.requests import Deconvolve
from workers.contract.resolved import ResolvedDeconvolve
from workers.files import archive as archive_files
from workers.files import beneath
from workers.files.full_disk import is_disk_full
from workers.files.store import sha256_of
from workers.intake import estimates
from workers.intake.deprecated import details_now
from workers.intake.requests import resolved_deconvolution
from workers.rows import row_of
from workers.tasks import deconvolve as deconvolve_task
from workers.tasks.context import Context
from workers.tasks.data import product
from workers.tasks.data.product import Made
from workers.tasks.psf_build import requested_psf

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
class _Source:
    """An image of a bulk run: its file and the summary of its header.

    name: the file name of the product is made from this name.
    """

    copy: Path | None  # the copy of an archive file; None for an upload, which is in the store
    path: Path | None  # the path of an archive file; None for an upload
    sha256: str
    summary: dict[str, Any]
    name: str


@dataclass(frozen=True)
class Ready:
    """An image that was read and can be deconvolved. target: the path of the product in the output folder, or None."""

    wanted: ResolvedDeconvolve
    identity: str
    image: Image
    target: Path | None


def read_one(context: Context, bulk: BulkRow, request: BulkWork, taken: BulkItemRow) -> Ready | Outcome:
    """Read an image of a bulk run and choose its PSF. If its product exists already, return this product.

    If another job is making the product now, wait for that job and use its product. Raises DataError for an image
    that cannot be deconvolved, and OSError if the disk is full.
    """
    with _source(context, taken) as source:
        wanted = _resolved(context, bulk, request, source)
        identity = product_identity(wanted)
        target = _target(context, request, source, wanted, identity)
        if target is not None and taken.attempts > 1 and target.parent.is_dir():
            # A killed worker may have left partial copies.
            beneath.remove_partials(target, _output_roots(context))
        before = done_before(context, wanted, request, target)
        if before is None and target is not None:
            assert request.output is not None
            if request.output.layout is not None:
                _check_free(target, identity, context.limits)
            with _write_errors():  # checked before the deconvolution, so that no work is lost if this fails
                beneath.make_folder(target.parent, _output_roots(context))
        if before is None and _waited(context, request, identity):
            before = done_before(context, wanted, request, target)
        if before is not None:
            return before
        needs = wanted.model_dump(mode="json") | {"image_shape": source.summary["shape"]}
        estimates.checked("deconvolve", needs, context.catalogue, context.owner, context.settings)
        # The path is taken only now, because the store's local copy may have been removed during a wait.
        image_file = source.copy or context.store.verified(source.sha256)
        return Ready(wanted, identity, deconvolve_task.load(context, wanted, image_file), target)


def compute_one(context: Context, request: BulkWork, ready: Ready) -> Made:
    """Deconvolve an image that was read. Builds the PSF first if it does not exist. Raises DataError."""
    psf_row = requested_psf(context, ready.wanted)
    return deconvolve_task.make(context, ready.wanted, psf_row, ready.image, preview=request.keeps_products)


def write_one(context: Context, request: BulkWork, ready: Ready, made: Made) -> Outcome:
    """Write a finished deconvolution as a product. Raises DataError "output-not-written", and OSError if the disk is full."""
    with context.store.temporary() as path:
        product.write(made, path)
        if request.keeps_products:
            row = product.keep(made, path)
            return _kept(context, row, ready.target, request, reused=False)
        assert ready.target is not None
        sha256, size_bytes = sha256_of(path), path.stat().st_size
        _put(context, path, ready.target, sha256, request)
    return Outcome(
        image_sha256=ready.wanted.image_id,
        psf_id=ready.wanted.psf_id,
        product_id=made.identity,
        reused=False,
        kept=False,
        output=str(ready.target),
        sha256=sha256,
        bytes=size_bytes,
        score=made.found.artefacts.score,
        statistics=statistics_of(made.details),
    )


def _waited(context: Context, request: BulkWork, identity: str) -> bool:
    """Wait while another job makes this product. Returns whether there was such a job.

    If the service keeps no products of the run, this function returns at once, because no other job makes the same
    file.
    """
    waited = False
    if not request.keeps_products:
        return False
    while context.catalogue.jobs.at_work_on(context.owner, identity):
        waited = True
        context.report("waiting for an equal job", 0, 1)  # raises an exception if the bulk run must stop
        _rest()
    return waited


def _rest() -> None:
    time.sleep(LOOK_AGAIN_S)


@contextmanager
def _source(context: Context, taken: BulkItemRow) -> Iterator[_Source]:
    if taken.uploaded:
        row = row_of(context.catalogue, ImageRow, taken.source, context.owner)
        yield _Source(None, None, row.id, row.summary, row.filename or "image")
        return
    allowed = archive_files.roots(context.settings.bulk_roots)
    path = archive_files.check_under(Path(taken.source), allowed)
    with context.store.temporary() as copy:
        try:
            with beneath.opened(path, allowed) as file:
                sha256 = archive_files.copy_hashed(file, copy, context.settings.max_upload_bytes)
        except OSError as error:
            if is_disk_full(error):  # the copy cannot be written; the same error would occur for every image
                raise
            raise archive_files.unreadable(error) from error
        summary = dataclasses.asdict(read_summary(copy, context.limits))
        yield _Source(copy, path, sha256, summary, path.name)


def _resolved(context: Context, bulk: BulkRow, request: BulkWork, source: _Source) -> ResolvedDeconvolve:
    """The deconvolution with its PSF. The PSF is that of the bulk run, or the PSF that the context of the run pins
    for the image."""
    wanted = Deconvolve(
        image_id=source.sha256,
        psf_id=bulk.psf_id,
        context=bulk.context_id,
        **request.parameters.model_dump(),
    )
    return resolved_deconvolution(wanted, source.summary, context.catalogue, context.owner)


def _target(
    context: Context, request: BulkWork, source: _Source, wanted: ResolvedDeconvolve, identity: str
) -> Path | None:
    """The path of the product's file in the output folder; None if only the service keeps it."""
    if request.output is None:
        return None
    return target_of(
        request.output,
        context.settings,
        name=source.name,
        source=source.path,
        summary=source.summary,
        identity=identity,
        psf_id=wanted.psf_id,
    )


def _check_free(target: Path, identity: str, limits: FitsLimits) -> None:
    """Raise DataError "output-name-taken" if another product has the path that a layout gives to this product."""
    if not target.is_file():
        return
    try:
        there = optional_text(first_image_header(target, limits), "PRODID")
    except DataError:  # a file that is no product; it must not be replaced either
        there = None
    if there != identity:
        raise _taken(target)


def _taken(target: Path) -> DataError:
    return DataError(
        "output-name-taken",
        f"expected a name of its own for each product; got {archive_files.shown(target)}, where another file is: use a layout with "
        "further fields, for example {product}, or another folder",
    )


def done_before(
    context: Context, wanted: ResolvedDeconvolve, request: BulkWork, target: Path | None
) -> Outcome | None:
    """The existing product, copied to the output folder if it is not there yet; None if there is no product."""
    identity = product_identity(wanted)
    if request.keeps_products:
        row = context.made(ProductRow, identity)
        return None if row is None else _kept(context, row, target, request, reused=True)
    earlier = context.catalogue.bulks.progress.done_before(context.owner, identity, str(target))
    if earlier is None or target is None or not target.is_file() or sha256_of(target) != earlier.sha256:
        return None
    assert earlier.sha256 is not None and earlier.bytes is not None and earlier.score is not None
    return Outcome(
        image_sha256=wanted.image_id,
        psf_id=wanted.psf_id,
        product_id=identity,
        reused=True,
        kept=False,
        output=str(target),
        sha256=earlier.sha256,
        bytes=earlier.bytes,
        score=earlier.score,
        statistics={
            name: value for name, value in (earlier.statistics or {}).items() if not name.endswith("seconds")
        },
    )


def _kept(
    context: Context, row: ProductRow, target: Path | None, request: BulkWork, *, reused: bool
) -> Outcome:
    """The outcome for a product that the service keeps."""
    if target is not None and not (
        target.is_file() and target.stat().st_size == row.bytes and sha256_of(target) == row.file_sha256
    ):
        _put(context, context.store.verified(row.file_sha256), target, row.file_sha256, request)
    return Outcome(
        image_sha256=row.image_id,
        psf_id=row.psf_id,
        product_id=row.id,
        reused=reused,
        kept=True,
        output=None if target is None else str(target),
        sha256=row.file_sha256,
        bytes=row.bytes,
        score=float(row.details["changes"]["artefacts"]["score"]),
        statistics=statistics_of(details_now(context.catalogue, row)),
    )


def statistics_of(details: Mapping[str, Any]) -> dict[str, Any]:
    """A summary of the changes and artefacts in the details of a product."""
    found = details["changes"]
    changes = {
        row["kind"]: {"sum_pct": row["sum_pct"], "up_to_pct": row["up_to_pct"]}
        for row in found["structures"]
        if (row["block_px"], row["tail_pct"]) == (BLOCK_PX, TAIL_PCT)
    }
    return {
        "flux_change_pct": details["flux_change_pct"],
        "bright": changes.get("bright"),
        "dark": changes.get("dark"),
        "signs": found["artefacts"]["signs"],
        "negative_pixels": details["negative_pixels"],
        "steps_done": details["steps_done"],
        "stopped_because": details["stopped_because"],
        "warnings": [one["code"] for one in details["warnings"]],
        "has_thumbnail": details.get("thumbnail_sha256") is not None,
    }


def _put(context: Context, source: Path, target: Path, sha256: str, request: BulkWork) -> None:
    """Copy a file to its path in the output folder. A file whose name a layout gives is not replaced by another one.

    Raises DataError "output-not-written", "output-name-taken", and OSError if the disk is full.
    """
    assert request.output is not None
    with _write_errors():
        try:
            replace = request.output.layout is None
            beneath.put(source, target, _output_roots(context), replace=replace)
        except FileExistsError:
            if sha256_of(target) != sha256:
                raise _taken(target) from None


def _output_roots(context: Context) -> tuple[Path, ...]:
    return archive_files.roots(context.settings.bulk_output_roots)


@contextmanager
def _write_errors() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if is_disk_full(error):  # the same error would occur for every image
            raise
        reason = archive_files.reason_of(error)
        raise DataError(
            "output-not-written",
            f"expected an output folder that the service can write to; the system says: {reason}",
        ) from error
