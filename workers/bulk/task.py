"""The task ``bulk``: a turn at the images of a bulk, one after the other, until none is left or others wait.

What is done is done: a product that is there, made by whatever asked for it, is not made again. An image that cannot
be deconvolved is put apart with the reason, and stops nothing.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from psfcore.errors import DataError
from workers.bulk.image import Outcome, treat
from workers.catalogue.bulk_tables import MOST_LETTERS, BulkRow
from workers.catalogue.bulks import NOT_UTF_8, TOO_LONG, Listed, Taken
from workers.catalogue.jobs import Lease
from workers.catalogue.stage_times import STARTING
from workers.contract.bulk import BulkPhase, BulkWork, Condition
from workers.contract.phases import Fault, JobError
from workers.files import archive as archive_files
from workers.tasks.context import Context, TurnOver

LIST_AT_ONCE = 200
MOST_IMAGES = 1_000_000
TELL_EVERY_S = 1.0  # how far a turn is, and whether it is to stop: nobody waits for a single image of many
BETWEEN = "between images"  # noting what one became, and taking the next
TURN_S = 60.0  # then the turn of another bulk may come; far below what one attempt of a job may last


def bulk_turn(context: Context, parameters: Mapping[str, Any]) -> str:
    """Do images of a bulk; returns its id. Raises ``TurnOver`` where some are left, and others wait."""
    bulk_id: str = parameters["bulk_id"]
    ends_at = time.monotonic() + TURN_S
    assert context.lease is not None
    while True:
        bulk = context.catalogue.bulks.get(bulk_id)
        if bulk is None:
            return bulk_id
        if bulk.phase == BulkPhase.LISTING:
            if not _list(context, bulk, context.lease):
                return bulk_id
            continue
        if _no_room(context, bulk):
            return bulk_id
        taken = context.catalogue.bulks.take(bulk_id, context.lease, context.settings.max_attempts)
        if taken is None:
            return bulk_id
        _do(context, bulk, taken)
        if time.monotonic() > ends_at or context.others_wait():
            raise TurnOver


def work_of(bulk: BulkRow) -> BulkWork:
    """What was asked for."""
    return BulkWork.model_validate(bulk.request)


def _no_room(context: Context, bulk: BulkRow) -> bool:
    """Whether the owner may keep nothing more; the bulk then stops, to be resumed once there is room."""
    usage = context.catalogue.owners.usage(context.owner, context.settings.quota_mib)
    if not usage.full or not work_of(bulk).keeps_products:
        return False
    message = f"expected room for products: {usage.used_bytes} of {usage.limit_bytes} bytes are used"
    context.catalogue.bulks.stop_with(
        bulk.id, JobError(fault=Fault.USER, code="quota-exceeded", message=message)
    )
    return True


def _do(context: Context, bulk: BulkRow, taken: Taken) -> None:
    """One image, to its end; what concerns the turn gives it back."""
    bulks, done = context.catalogue.bulks, bulk.done + bulk.failed

    told_s = told_at = 0.0

    def report(stage: str, step: int, _steps: int) -> None:
        nonlocal told_s, told_at
        with context.times.step(stage, step):
            began = time.perf_counter()
            if began - told_at >= TELL_EVERY_S:
                context.report("images", done, bulk.total)
                told_at = time.perf_counter()
                told_s += told_at - began

    # What an image becomes is the bulk's; a turn is gone soon.
    of_image = dataclasses.replace(context, report=report, job_id=bulk.id)
    found: list[Outcome] = []
    context.times.begin(STARTING)
    started = time.perf_counter()
    try:
        error = context.guarded(lambda: found.append(treat(of_image, bulk, work_of(bulk), taken)))
    except BaseException:
        bulks.release(taken)
        raise
    finally:
        context.times.begin(BETWEEN)
    if error is not None:
        bulks.fail(taken, error)
        return
    values = vars(found[0])
    statistics = {**values["statistics"], "seconds": round(time.perf_counter() - started, 3)}
    if "kernel_seconds" in statistics:  # saying how far it is is no work on the image
        statistics["kernel_seconds"] = round(statistics["kernel_seconds"] - told_s, 3)
    bulks.finish(taken, **{**values, "statistics": statistics})


# Listing ---------------------------------------------------------------------------------------------


def _list(context: Context, bulk: BulkRow, lease: Lease) -> bool:
    """Make the files that were asked for images of the bulk; what is wrong with all of them stops it.

    False where this turn has nothing more to do.
    """
    bulks = context.catalogue.bulks
    if not bulks.begin_listing(bulk.id, lease):
        return False
    try:
        listed = _listed(context, work_of(bulk))
        while batch := list(islice(listed, LIST_AT_ONCE)):
            if not bulks.add_listed(bulk.id, lease, batch):
                return False
        there = bulks.get(bulk.id)
        if there is not None and there.total == 0:
            raise DataError(
                "no-images", "expected files that the patterns and the headers asked for; got none"
            )
    except DataError as error:
        bulks.stop_with(bulk.id, JobError(fault=Fault.USER, code=error.code, message=error.message))
        return False
    return bulks.end_listing(bulk.id, lease)


def _listed(context: Context, request: BulkWork) -> Iterator[Listed]:
    """Files once each, though several patterns may find them."""
    allowed = archive_files.roots(context.settings.bulk_roots)
    seen: set[Path] = set()
    looked_at, told_at = 0, 0.0

    def tell() -> None:
        nonlocal told_at
        told_at = time.monotonic()
        context.report("listing", len(seen), max(looked_at, len(seen) + 1))

    def tick() -> None:
        """A walk may be long and find nothing: it is to stop as any work is."""
        if time.monotonic() - told_at >= TELL_EVERY_S:
            tell()

    for files in request.files:
        for found in archive_files.find(files.glob, allowed, tick):
            looked_at += 1
            tell()
            if found.path in seen:
                continue
            listed = _looked_at(context, found, files.where)
            if listed is None:
                continue
            seen.add(found.path)
            if len(seen) > MOST_IMAGES:
                raise DataError(
                    "too-many-images", f"expected at most {MOST_IMAGES} images in a bulk; got more"
                )
            yield listed


def _looked_at(context: Context, found: archive_files.Found, where: dict[str, Condition]) -> Listed | None:
    """What was found as an image, and why it cannot be worked on if so; None where another header is asked for."""
    error = None
    try:
        if found.error is not None:
            raise found.error
        if not archive_files.matches(found.path, where, context.limits):
            return None
    except DataError as unreadable:
        error = JobError(fault=Fault.USER, code=unreadable.code, message=unreadable.message)
    except OSError as unreadable:
        error = unreadable_file(unreadable)
    source = archive_files.shown(found.path)
    unkept = _unkept(found.path, source)
    if len(source) > MOST_LETTERS:
        source = source[: MOST_LETTERS - 1] + "…"
    return Listed(source, uploaded=False, error=unkept or error)


def _unkept(path: Path, source: str) -> JobError | None:
    """Why a path cannot be kept as it is, to be read by later; None where it can."""
    if source != str(path):
        code, message = NOT_UTF_8, f"expected a path in UTF-8; got one that ends in {source[-100:]}"
    elif len(source) > MOST_LETTERS:
        code = TOO_LONG
        message = f"expected a path of at most {MOST_LETTERS} characters; got {len(source)} that end in {source[-100:]}"
    else:
        return None
    return JobError(fault=Fault.USER, code=code, message=message)


def unreadable_file(error: OSError) -> JobError:
    """Why a file cannot be read, without its place."""
    reason = archive_files.reason_of(error)
    return JobError(
        fault=Fault.USER, code="unreadable-file", message=f"expected a file that can be read: {reason}"
    )
