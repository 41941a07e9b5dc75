"""Lists the files that match the patterns of a bulk run, and adds them to the catalogue as its images."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

from psfcore.errors import DataError
from workers.bulk.matching import found_files
from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.bulks import Listed
from workers.catalogue.jobs import Lease
from workers.catalogue.owners import OverQuota
from workers.contract.bulk import BulkWork
from workers.contract.phases import Fault, JobError
from workers.tasks.context import Context

LIST_AT_ONCE = 200
NOT_LISTED = "not all files that the patterns match could be listed"  # a reason for Usage.no_room


def work_of(bulk: BulkRow) -> BulkWork:
    """The request of a bulk run, without the ids of uploaded images."""
    return BulkWork.model_validate(bulk.request)


def list_files(context: Context, bulk: BulkRow, lease: Lease) -> bool:
    """Add the files that the patterns of a bulk run match to its images. An error that concerns all files stops the run.

    Returns False if this turn has nothing more to do.
    """
    bulks = context.catalogue.bulks
    if not bulks.begin_listing(bulk.id, lease):
        return False
    try:
        listed = _listed(context, work_of(bulk))
        while batch := list(islice(listed, LIST_AT_ONCE)):
            if not bulks.add_listed(bulk.id, lease, batch, context.settings.quota_mib):
                return False
        there = bulks.get(bulk.id)
        if there is not None and there.total == 0:
            raise DataError(
                "no-images",
                "expected files that match the patterns and the header conditions; found no files: check the globs and `where`",
            )
    except DataError as error:
        bulks.stop_with(bulk.id, JobError(fault=Fault.USER, code=error.code, message=error.message))
        return False
    except OverQuota as over:
        message = f"{over.usage.no_room(NOT_LISTED)}, then resume the run"
        bulks.stop_with(bulk.id, JobError(fault=Fault.USER, code="quota-exceeded", message=message))
        return False
    return bulks.end_listing(bulk.id, lease)


def _listed(context: Context, request: BulkWork) -> Iterator[Listed]:
    def tell(seen: int, looked_at: int) -> None:
        context.report("listing", seen, max(looked_at, seen + 1))

    return found_files(request, context.settings, tell)
