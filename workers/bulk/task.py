"""The task ``bulk``: one turn of a bulk run. A turn deconvolves images one after the other.

A turn ends when no image is left, or when other jobs wait. A product that already exists is not made again, even if
another job made it. An image that cannot be deconvolved is recorded as failed, with the reason; the run continues.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

from workers.bulk.image import Outcome, deconvolve_one
from workers.bulk.listing import TELL_EVERY_S, list_files, work_of
from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.bulks import Taken
from workers.contract.bulk import BulkPhase
from workers.contract.phases import Fault, JobError
from workers.tasks.context import Context, TurnOver
from workers.tasks.stage_timer import STARTING

BETWEEN = "between images"  # the stage between two images: record the result of one, take the next
TURN_S = (
    60.0  # a turn ends after this time, so that other bulk runs get turns; an attempt may take much longer
)


def bulk_turn(context: Context, parameters: Mapping[str, Any]) -> str:
    """Deconvolve images of a bulk run; returns the id of the run. Raises ``TurnOver`` if images are left but the turn must end."""
    bulk_id: str = parameters["bulk_id"]
    ends_at = time.monotonic() + TURN_S
    assert context.lease is not None
    while True:
        bulk = context.catalogue.bulks.get(bulk_id)
        if bulk is None:
            return bulk_id
        if bulk.phase == BulkPhase.LISTING:
            if not list_files(context, bulk, context.lease):
                return bulk_id
            continue
        if _stopped_for_quota(context, bulk):
            return bulk_id
        taken = context.catalogue.bulks.take(bulk_id, context.lease, context.settings.max_attempts)
        if taken is None:
            return bulk_id
        _do(context, bulk, taken)
        if time.monotonic() > ends_at or context.others_wait():
            raise TurnOver


def _stopped_for_quota(context: Context, bulk: BulkRow) -> bool:
    """Stop the bulk run if its owner's quota is used up. Returns whether it was stopped. The run can be resumed when there is room."""
    usage = context.catalogue.owners.usage(context.owner, context.settings.quota_mib)
    if not usage.full or not work_of(bulk).keeps_products:
        return False
    message = (
        f"expected room for more products; {usage.used_bytes} of {usage.limit_bytes} bytes of the quota are used: delete "
        "products or other bulk runs that you no longer need (`heliopsf product delete`, `heliopsf bulk delete`), or ask "
        "the operator for a larger quota; then resume the run"
    )
    context.catalogue.bulks.stop_with(
        bulk.id, JobError(fault=Fault.USER, code="quota-exceeded", message=message)
    )
    return True


def _do(context: Context, bulk: BulkRow, taken: Taken) -> None:
    """Deconvolve one image and record its result.

    If the whole turn must stop, the image is released for another turn.
    """
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

    # Products name the bulk run as their job, because the job of a turn is soon deleted.
    of_image = dataclasses.replace(context, report=report, job_id=bulk.id)
    found: list[Outcome] = []
    context.times.begin(STARTING)
    started = time.perf_counter()
    try:
        error = context.guarded(lambda: found.append(deconvolve_one(of_image, bulk, work_of(bulk), taken)))
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
    if "kernel_seconds" in statistics:  # without the time that was spent on reports of progress
        statistics["kernel_seconds"] = round(statistics["kernel_seconds"] - told_s, 3)
    bulks.finish(taken, **{**values, "statistics": statistics})
