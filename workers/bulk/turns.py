"""Turns of bulk runs: jobs in the queue ``bulk`` in which a worker deconvolves one image after the other.

A bulk run has as many turns as there are worker processes, but never more turns than images that are left. Turns are
ordinary jobs: one worker runs each turn, a lost turn is queued again, and a worker that stops hands its turn back.
After each image, a turn ends if jobs of other kinds wait. After a minute it ends in any case, so that turns of other
bulk runs can follow. When the run has no work left, its turns are deleted.
"""

from __future__ import annotations

import logging

from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import JobRow
from workers.contract.bulk import BulkPhase
from workers.contract.identities import canonical_hash
from workers.contract.phases import Fault, JobError, Phase
from workers.contract.queues import Queue
from workers.files.store import STORAGE_FULL
from workers.settings import Settings

KIND = "bulk"
MOST_TURNS = 1000
log = logging.getLogger(__name__)


def keep_turns(catalogue: Catalogue, settings: Settings) -> None:
    """Queue the turns that every active bulk run needs; delete the turns that ended."""
    turns = catalogue.jobs.of_kind(KIND)
    for turn in turns:
        if Phase(turn.phase).ended:
            _forget(catalogue, turn)
    live = {(turn.owner, turn.request_key) for turn in turns if not Phase(turn.phase).ended}
    processes = len(catalogue.census.workers(settings.lease_s))
    for bulk in catalogue.bulks.at_work():
        for number in range(_wanted(bulk, processes)):
            parameters = {"bulk_id": bulk.id, "turn": number}
            key = canonical_hash({"kind": KIND, **parameters})
            if (bulk.owner, key) not in live:
                catalogue.jobs.submit(KIND, parameters, key, bulk.owner, queue=Queue.BULK)


def cancel_turns(catalogue: Catalogue, bulk_id: str) -> None:
    """Cancel the turns of a bulk run. Each turn stops at its next report of progress."""
    for turn in catalogue.jobs.of_kind(KIND):
        if turn.parameters["bulk_id"] == bulk_id:
            catalogue.jobs.cancel(turn.id)


def _wanted(bulk: BulkRow, processes: int) -> int:
    left = bulk.total - bulk.done - bulk.failed
    if bulk.phase == BulkPhase.LISTING:
        left = max(1, left)  # one turn lists files, even if it has no image to process meanwhile
    return min(left, max(1, processes), MOST_TURNS)


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
