"""Results that were deleted, or whose files were lost or damaged: find the jobs that make them again, and queue these
jobs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from psfcore.errors import DataError
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import (
    ImageRow,
    JobRow,
    ProductRow,
    PsfRow,
    ReportRow,
    SolutionRow,
    TransitRow,
)
from workers.contract.identities import request_identity
from workers.contract.jobs import Phase, Queue
from workers.contract.kinds import KINDS, ResultType
from workers.contract.requests import PsfTables
from workers.files.garbage import Fault, intact_row
from workers.files.store import Store
from workers.lineage import made_by

TABLES: dict[ResultType, type[Any]] = {
    ResultType.PRODUCT: ProductRow,
    ResultType.PSF: PsfRow,
    ResultType.REPORT: ReportRow,
}


def reopened(job: JobRow, catalogue: Catalogue, store: Store) -> bool:
    """Queue a completed job again if its result was deleted or a file of the result is lost; True if it was queued."""
    table = TABLES.get(KINDS[job.kind].result)
    if job.phase != Phase.COMPLETED or table is None or job.result_id is None:
        return False
    row = intact_row(catalogue, store, table, job.result_id, job.owner)
    return row is None and catalogue.jobs.reopen(job.id)


def without_results(jobs: Sequence[JobRow], catalogue: Catalogue) -> frozenset[str]:
    """The ids of the completed jobs in ``jobs`` whose result was deleted. All jobs must have the same owner."""
    gone: set[str] = set()
    for result, table in TABLES.items():
        done = {
            job.id: job.result_id
            for job in jobs
            if job.phase == Phase.COMPLETED and job.result_id and KINDS[job.kind].result == result
        }
        if done:
            known = catalogue.ids_among(table, done.values(), jobs[0].owner)
            gone |= {job_id for job_id, result_id in done.items() if result_id not in known}
    return frozenset(gone)


def repair(fault: Fault, catalogue: Catalogue, store: Store) -> str:
    """Set damaged files aside, and queue the job that makes the result again.

    Returns a text that says what was done, or what somebody has to do.
    """
    row = fault.row
    for digest, state in fault.files:
        if state == "damaged":
            store.set_aside(digest)
    match row:
        case SolutionRow():
            catalogue.quotas.forget_solutions([row])
            return "removed; the next job on the transit makes it again"
        case ImageRow() | TransitRow():
            return f"owner {row.owner} must upload the file again ({row.filename or 'without a name'})"
        case _:
            try:
                return f"job {make_again(row, catalogue, store)} makes it again"
            except DataError as error:
                return f"cannot be made again: {error.message}"


def make_again(row: ProductRow | PsfRow | ReportRow, catalogue: Catalogue, store: Store) -> str:
    """Queue the job that makes a result again; returns the job's id. Call this only if a file of the result is missing.

    For an uploaded PSF, the job makes only the tables and the picture again.

    Raises DataError "not-made-here" for an upload. Raises DataError "parameters-unknown" or "parameters-outdated" if
    the job was deleted and the catalogue does not contain parameters with which this version can repeat it.
    """
    if isinstance(row, PsfRow) and row.origin == "uploaded" and store.size(row.file_sha256) == row.bytes:
        tables = PsfTables(psf_id=row.id)
        key = request_identity("psf-tables")(tables)
        drawing, _ = catalogue.jobs.submit("psf-tables", tables.model_dump(mode="json"), key, row.owner)
        catalogue.jobs.reopen(drawing.id)
        return drawing.id
    job = catalogue.jobs.that_made(row.owner, row.id)
    if job is not None and KINDS[job.kind].result in TABLES and job.work_key == row.id:
        catalogue.jobs.reopen(job.id)
        return job.id
    if isinstance(row, ReportRow):
        raise _unknown(row)
    made = made_by(catalogue, row)
    kind = KINDS[made.kind]
    assert kind.resolved is not None and kind.identity is not None
    try:
        identity = kind.identity(kind.resolved.model_validate(made.parameters))
    except ValidationError:  # the text of the instrument file was only in the PSF's file, which is lost
        raise _unknown(row) from None
    if identity != row.id:
        raise _unknown(row)
    return catalogue.jobs.submit(kind.name, made.parameters, row.id, row.owner, queue=Queue.BULK)[0].id


def _unknown(row: ProductRow | PsfRow | ReportRow) -> DataError:
    return DataError(
        "parameters-unknown",
        f"expected a job that makes {row.id} again; its job was deleted, or needs a file that is lost: submit the "
        "request again",
    )
