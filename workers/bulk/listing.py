"""Lists the files that match the patterns of a bulk run, and adds them to the catalogue as its images.

A turn lists files in a thread of its own while it processes the images that are already listed. The transaction that
adds images also stores how far the search has come, so that the next turn continues the search from there.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from psfcore.errors import DataError
from workers.bulk.matching import Place, found_files
from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.bulks import Listed
from workers.catalogue.jobs import Lease
from workers.catalogue.owners import OverQuota
from workers.contract.bulk import BulkWork
from workers.contract.phases import Fault, JobError
from workers.tasks.context import Context

LIST_AT_ONCE = 200
ADD_EVERY_S = (
    0.5  # images are added after this time even if they are fewer, so that the first ones are processed soon
)
NOT_LISTED = "not all files that the patterns match could be listed"  # a reason for Usage.too_many_rows


def work_of(bulk: BulkRow) -> BulkWork:
    """The request of a bulk run, without the ids of uploaded images."""
    return BulkWork.model_validate(bulk.request)


def list_files(
    context: Context, bulk: BulkRow, lease: Lease, added: Callable[[], None], stops: Callable[[], bool]
) -> None:
    """Add the files that the patterns of a bulk run match to its images, from the place where an earlier search ended.

    bulk: the row that ``Bulks.begin_listing`` returned. added: called after images were added. stops: whether the search
    must end now; another turn then continues it. An error that concerns all files stops the run. Images that were added
    before it stay.
    """
    bulks = context.catalogue.bulks
    try:
        if not _add_all(context, bulk, lease, added, stops):
            return
        there = bulks.get(bulk.id)
        if there is not None and there.total == 0:
            raise DataError(
                "no-images",
                "expected files that match the patterns and the header conditions; found no files: check the globs and `where`",
            )
    except DataError as error:
        bulks.stop_with(bulk.id, JobError(fault=Fault.USER, code=error.code, message=error.message))
        return
    except OverQuota as over:
        message = f"{over.usage.too_many_rows(NOT_LISTED)}, then resume the run"
        bulks.stop_with(bulk.id, JobError(fault=Fault.USER, code="quota-exceeded", message=message))
        return
    bulks.end_listing(bulk.id, lease)


def _add_all(
    context: Context, bulk: BulkRow, lease: Lease, added: Callable[[], None], stops: Callable[[], bool]
) -> bool:
    """Search and add images in batches. Returns whether the search came to its end. Raises DataError, OverQuota."""
    bulks, request = context.catalogue.bulks, work_of(bulk)
    place = None if bulk.listed_to is None else Place.of(bulk.listed_to)
    several = place is not None and len(request.files) > 1
    # A path that the catalogue cannot store is not known again: it may then fail twice, once for each pattern.
    known = bulks.progress.sources(bulk.id) if several else frozenset[str]()
    batch: list[Listed] = []
    add_at = time.monotonic() + ADD_EVERY_S

    def add() -> bool:
        nonlocal add_at
        images, add_at = tuple(batch), time.monotonic() + ADD_EVERY_S
        batch.clear()
        if place is None:
            return True
        usage = context.catalogue.owners.limited(context.owner, context.settings.quota_mib)
        if usage is not None and not usage.allows_rows(len(images)):
            raise OverQuota(usage)
        if not bulks.add_listed(bulk.id, lease, images, place.stored()):
            return False
        added()
        return True

    try:
        for step in found_files(request, context.settings, place, known, bulk.total):
            place = step.place
            if step.image is not None:
                batch.append(step.image)
            stop = stops()
            if (stop or len(batch) >= LIST_AT_ONCE or time.monotonic() >= add_at) and not add():
                return False
            if stop:
                return False
    except DataError:
        add()
        raise
    return add()
