"""The description of a job."""

from __future__ import annotations

import time
from typing import Any

from pydantic import BaseModel, Field

from workers.catalogue.tables import JobRow
from workers.contract.kinds import KINDS
from workers.contract.phases import JobError, Phase
from workers.contract.queues import Queue


class Progress(BaseModel):
    """Progress of a job."""

    stage: str
    step: int
    steps: int
    time_left_s: float | None = Field(
        description="estimated time until the last of `steps`, s; null: unknown. The estimate uses the speed since the "
        "job began to count these steps"
    )


class Estimate(BaseModel):
    """The time and memory that a job was expected to need when it was accepted."""

    memory_mib: int
    seconds: float


class JobView(BaseModel):
    """A job."""

    id: str
    kind: str
    phase: Phase
    queue: Queue
    created_at: float
    started_at: float | None
    ended_at: float | None
    attempt: int
    cancel_requested: bool
    waiting_before: int | None = Field(
        description="number of waiting jobs that are expected to start before this job: the jobs of more urgent queues, and "
        "jobs of this queue, in which the owners take turns; 1000: 1000 or more; null: the job is not QUEUED. Only the "
        "answers to a submission and to `GET /v1/jobs/{id}` contain this number; in lists and events it is null"
    )
    progress: Progress
    estimate: Estimate | None = Field(
        description="expected time and memory of the job; null: a UWS job that has not been started"
    )
    parameters: dict[str, Any] = Field(
        description="the parameters, with every default and the PSF filled in; for a PENDING job as the client sent them"
    )
    result: str | None = Field(description="address of the result; null until the job is COMPLETED")
    result_deleted: bool = Field(
        False,
        description="whether the result was deleted; the same request makes the result again. Lists and the answers to a "
        "submission and to `GET /v1/jobs/{id}` contain the present value; in events it is always false",
    )
    error: JobError | None

    @classmethod
    def of(cls, row: JobRow, waiting_before: int | None = None, *, result_deleted: bool = False) -> JobView:
        """The description of a job, from its row in the catalogue.

        waiting_before: number of jobs that wait before this job; None if they were not counted.
        """
        return cls(
            id=row.id,
            kind=row.kind,
            phase=Phase(row.phase),
            queue=Queue(row.queue),
            created_at=row.created_at,
            started_at=row.started_at,
            ended_at=row.ended_at,
            attempt=row.attempt,
            cancel_requested=row.cancel_requested,
            waiting_before=waiting_before,
            progress=Progress(stage=row.stage, step=row.step, steps=row.steps, time_left_s=time_left_s(row)),
            estimate=Estimate.model_validate(row.estimate) if row.estimate else None,
            parameters=row.parameters,
            result=f"{KINDS[row.kind].result}/{row.result_id}" if row.result_id else None,
            result_deleted=result_deleted,
            error=JobError.model_validate(row.error) if row.error else None,
        )


def time_left_s(row: JobRow, now: float | None = None) -> float | None:
    """Estimated remaining time of a running job, s; None if unknown.

    The estimate uses the speed since the job began to count its present steps. Earlier work, such as reading the
    images, does not count. now: seconds since 1970; default: this machine's clock.
    """
    now = time.time() if now is None else now
    done = row.step - row.count_step
    if not KINDS[row.kind].counted_whole or row.phase != Phase.EXECUTING or done <= 0 or row.count_at is None:
        return None
    return max(0.0, (now - row.count_at) * (row.steps - row.step) / done)
