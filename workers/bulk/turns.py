"""Turns of bulk: jobs in the queue ``bulk`` in which a worker does one image after the other.

A bulk has as many turns as there are worker processes, and never more than images left. They are jobs like all
others, so that what is known of these holds: one worker has a turn, a lost one is queued again, a worker that stops
hands it back. After each image a turn lets jobs of other kinds go first, after a minute turns of other bulks; it is
gone once there is nothing left for it.
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
from workers.settings import Settings

KIND = "bulk"
MOST_TURNS = 1000
log = logging.getLogger(__name__)


def keep_turns(catalogue: Catalogue, settings: Settings) -> None:
    """Give every bulk that goes on the turns that it needs; forget those that ended."""
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
    """Stop the turns of a bulk, each within a step of what it does."""
    for turn in catalogue.jobs.of_kind(KIND):
        if turn.parameters["bulk_id"] == bulk_id:
            catalogue.jobs.cancel(turn.id)


def _wanted(bulk: BulkRow, processes: int) -> int:
    if bulk.phase == BulkPhase.LISTING:
        return 1
    return min(bulk.total - bulk.done - bulk.failed, max(1, processes), MOST_TURNS)


def _forget(catalogue: Catalogue, turn: JobRow) -> None:
    """An ended turn has nothing to say, unless it failed for a reason that the next one would meet too."""
    error = JobError.model_validate(turn.error) if turn.error else None
    if error is not None and error.fault != Fault.TRANSIENT and error.code != "worker-lost":
        bulk_id = turn.parameters["bulk_id"]
        if catalogue.bulks.stop_with(bulk_id, error):
            log.error("bulk %s: stopped: %s", bulk_id, error.message)
    catalogue.uws.destroy(turn.id)
