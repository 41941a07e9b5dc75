"""Bulk runs: made from requests, and kept at work by turns.

A turn is a job in the queue ``bulk`` in which a worker deconvolves one image of a run after the other. A run has as
many turns as there are worker processes, but never more turns than images that are left. Turns are ordinary jobs: one
worker runs each turn, a lost turn is queued again, and a worker that stops hands its turn back. After each image, a
turn ends if jobs of other kinds wait. After a minute it ends in any case, so that turns of other bulk runs can follow.
When the run has no work left, its turns are deleted.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path

from psfcore.errors import DataError
from psfcore.fits.header import HeaderJson
from workers.catalogue.bulks import new_id
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import BulkRow, ImageRow, JobRow, PsfRow
from workers.contract.bulk import BulkPhase, BulkRequest, BulkWork
from workers.contract.identities import canonical_hash
from workers.contract.jobs import ENDED, Fault, JobError, Queue
from workers.contract.requests import Deconvolve, ResolvedDeconvolve
from workers.files import archive as archive_files
from workers.files.store import STORAGE_FULL
from workers.intake.requests import resolved_deconvolution
from workers.lookup import no_such, row_of
from workers.settings import Settings

KIND = "bulk"
MOST_TURNS = 1000
log = logging.getLogger(__name__)


def begin(request: BulkRequest, catalogue: Catalogue, owner: str, settings: Settings) -> tuple[BulkRow, bool]:
    """A new bulk run, or the open bulk run of an identical request. Also returns whether it is new.

    Raises the errors of ``new_run``.
    """
    return catalogue.bulks.create(*new_run(request, catalogue, owner, settings))


def new_run(
    request: BulkRequest, catalogue: Catalogue, owner: str, settings: Settings
) -> tuple[BulkRow, list[str]]:
    """The row of a run, which is not in the catalogue yet, and the ids of its uploaded images.

    The row has the id of the PSF or of the context, so a later change of a name does not change the run. Raises
    ``DataError``: "no-such-psf", "no-such-context", "no-such-image", "bad-path", "path-not-allowed".
    """
    context_id = None
    if request.psf_id is not None:
        row_of(catalogue, PsfRow, request.psf_id, owner)
    else:
        assert request.context is not None
        context_id = catalogue.contexts.named(request.context, owner).id
    images = list(dict.fromkeys(request.images))
    there = catalogue.ids_among(ImageRow, images, owner)
    missing = next((one for one in images if one not in there), None)
    if missing is not None:
        raise no_such("image", missing)
    _check_places(request, settings)
    stored = request.model_dump(mode="json", exclude={"images", "context"}) | {"context": context_id}
    now = time.time()
    row = BulkRow(
        id=new_id(),
        owner=owner,
        name=request.name,
        phase=BulkPhase.LISTING if request.files else BulkPhase.RUNNING,
        request=stored,
        # Requests that differ only in their names have the same key.
        request_key=canonical_hash({**stored, "name": None, "images": images}),
        psf_id=request.psf_id,
        context_id=context_id,
        created_at=now,
        running_since=now,
        listed=not request.files,
    )
    return row, images


def resolved_image(
    bulk: BulkRow, image_id: str, summary: HeaderJson, catalogue: Catalogue
) -> ResolvedDeconvolve:
    """The deconvolution of an image of a run. Its PSF is that of the run, or the one that the run's context pins for
    it.
    """
    parameters = BulkWork.model_validate(bulk.request).parameters.model_dump()
    request = Deconvolve(image_id=image_id, psf_id=bulk.psf_id, context=bulk.context_id, **parameters)
    return resolved_deconvolution(request, summary, catalogue, bulk.owner)


def _check_places(request: BulkRequest, settings: Settings) -> None:
    """Raise DataError "bad-path" or "path-not-allowed" if a pattern or the output folder cannot be used."""
    allowed = archive_files.roots(settings.bulk_roots)
    for files in request.files:
        archive_files.check_glob(files.glob, allowed)
    if request.output is None:
        return
    folder = Path(request.output.folder)
    if not folder.is_absolute() or ".." in folder.parts:
        raise DataError(
            "bad-path", f"output: expected an absolute path without '..'; got {ascii(str(folder))[:200]}"
        )
    archive_files.check_under(folder, archive_files.roots(settings.bulk_output_roots), "an output folder")


def keep_turns(catalogue: Catalogue, settings: Settings) -> None:
    """Queue the turns that every active bulk run needs; delete the turns that ended."""
    turns = catalogue.jobs.of_kind(KIND)
    for turn in turns:
        if turn.phase in ENDED:
            _forget(catalogue, turn)
    live = {(turn.owner, turn.request_key) for turn in turns if turn.phase not in ENDED}
    processes = len(catalogue.census.workers(settings.lease_s))
    for bulk in catalogue.bulks.at_work():
        left = bulk.total - bulk.done - bulk.failed
        if bulk.phase == BulkPhase.LISTING:
            left = max(1, left)  # one turn lists files, even if it has no image to process meanwhile
        for number in range(min(left, max(1, processes), MOST_TURNS)):
            parameters = {"bulk_id": bulk.id, "turn": number}
            key = canonical_hash({"kind": KIND, **parameters})
            if (bulk.owner, key) not in live:
                catalogue.jobs.submit(KIND, parameters, key, bulk.owner, queue=Queue.BULK)


def cancel_turns(catalogue: Catalogue, bulk_id: str) -> None:
    """Cancel the turns of a bulk run. Each turn stops at its next report of progress."""
    for turn in catalogue.jobs.of_kind(KIND):
        if turn.parameters["bulk_id"] == bulk_id:
            catalogue.jobs.cancel(turn.id)


def _forget(catalogue: Catalogue, turn: JobRow) -> None:
    """Delete an ended turn. If it failed with an error that the next turn would also meet, stop the bulk run.

    For example, if the disk is full, every turn would deconvolve an image in vain until somebody makes room.
    """
    error = JobError.model_validate(turn.error) if turn.error else None
    stops = error is not None and (error.fault != Fault.TRANSIENT or error.code == STORAGE_FULL)
    if error is not None and stops and error.code != "worker-lost":
        bulk_id = turn.parameters["bulk_id"]
        if catalogue.bulks.stop_with(bulk_id, error):
            log.error("bulk run %s: stopped: %s", bulk_id, error.message)
    catalogue.uws.destroy(turn.id)
