"""The operation of the service: ``/healthz`` (is it up?), ``/readyz`` (can it do its work?) and ``/metrics`` for
Prometheus.

Numbers about all processes (jobs, files, workers) are read from the database whenever Prometheus reads the metrics, by
queries that use only indexes. Numbers about this process (its requests) are counted in the process. The numbers of jobs
and files are gauges, because they decrease when a job is destroyed. The time that jobs spent in their stages is a
counter, which never decreases.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TypeVar

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Metric, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.registry import Collector
from pydantic import BaseModel, Field
from sqlalchemy.exc import SQLAlchemyError

from service.http.callers import Administering
from service.http.problems import RESPONSES, Problem, ProblemDocument
from service.http.state import Shared, State, state_of
from workers import checks
from workers.catalogue.census import JobTally
from workers.contract.jobs import Phase, Queue
from workers.contract.kinds import KINDS
from workers.settings import software_version

STOPPED = "the reconciler has not succeeded for 30 s, so jobs are not submitted; read the log of the server"
Labels = TypeVar("Labels", bound=str | tuple[str, ...])  # the value of the label, or those of all labels
router = APIRouter(tags=["operation"])
NOT_READY = {
    "model": ProblemDocument,
    "description": "A part does not answer, or workers take no jobs; `parts` says which part.",
}


class Health(BaseModel):
    """The process and its database answer."""

    status: str
    version: str


class Readiness(BaseModel):
    """All parts that the service needs answer."""

    status: str
    parts: dict[str, str] = Field(
        description="state of the database, of the storage, of the waiting jobs, and of the broker or embedded "
        "worker; `ok`: the part answers, and workers take the jobs"
    )


# These two use no thread of the pool, all of which may wait for a neighbour that hangs.
@router.get("/healthz", summary="Is the service up?", responses=RESPONSES)
async def healthz(request: Request) -> Health:
    """200: process, reconciler and database work. 503: one of them does not work."""
    state = state_of(request)
    answer = await _answers(state, {"answers of the database": lambda: checks.answers(state.catalogue)})
    for fault in faults(answer):
        raise Problem(503, "database-away", fault, headers={"Retry-After": "5"})
    if not state.reconciler.alive:
        raise Problem(503, "reconciler-stopped", STOPPED)
    return Health(status="ok", version=software_version())


@router.get("/readyz", summary="Can the service do its work?", responses={503: NOT_READY})
async def readyz(request: Request) -> Readiness:
    """200: database, storage, and broker (or embedded worker) answer, and workers take the jobs. 503: one of them does
    not; `parts` says which one.
    """
    parts = await states(state_of(request))
    away = faults(parts)
    if away:
        raise Problem(503, "not-ready", "; ".join(away), parts=parts)
    return Readiness(status="ready", parts=parts)


async def states(state: State) -> dict[str, str]:
    """The state of each part that the service needs, by its name: "ok", or what is wrong."""
    parts = await _answers(state, checks.needed(state.settings, state.catalogue, state.store))
    if not state.reconciler.alive:
        parts["reconciler"] = STOPPED
    return parts


async def _answers(state: State, needed: Mapping[str, Callable[[], None]]) -> dict[str, str]:
    """The result of each check. A check that takes longer than ``checks.CHECK_S`` is not waited for."""
    asked = {name: asyncio.wrap_future(state.watch.ask(name, check)) for name, check in needed.items()}
    if asked:
        await asyncio.wait(asked.values(), timeout=checks.CHECK_S)
    late = f"has not ended within {checks.CHECK_S:g} s"
    return {
        name: one.result() if one.done() else f"the check of the {name} {late}" for name, one in asked.items()
    }


def faults(parts: Mapping[str, str]) -> list[str]:
    """What is wrong with the parts that do not answer."""
    return [state for state in parts.values() if state != checks.OK]


@router.get(
    "/metrics",
    summary="Numbers for Prometheus",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
def metrics(request: Request, _caller: Administering, state: Shared) -> Response:
    """Jobs, files and workers of the whole service, and requests to this process."""
    shared = CollectorRegistry()
    shared.register(_Catalogued(state))
    text = generate_latest(shared) + generate_latest(request.app.state.requests.registry)
    return Response(text, headers={"Content-Type": CONTENT_TYPE_LATEST})


class _Catalogued(Collector):
    def __init__(self, state: State) -> None:
        self._state = state

    def describe(self) -> list[Metric]:
        """Return nothing: the metrics are collected only when Prometheus reads them."""
        return []

    def collect(self) -> Iterator[Metric]:
        """The metrics of database, storage and streams. If the database does not answer, its metrics are left out,
        except ``heliopsf_database_up``, which is 0.
        """
        yield InfoMetricFamily("heliopsf", "The service", {"version": software_version()})
        free = checks.free_bytes(self._state.settings.data_dir)
        yield _gauge("storage_free_bytes", "Free space where files are stored", free)
        streams = self._state.streams.total()
        yield _gauge("event_streams", "Streams of events that this process sends now", streams)
        try:
            metrics = [*self._jobs(), *self._stages(), *self._waiting(), *self._files()]
        except SQLAlchemyError:
            metrics = []
        yield _gauge("database_up", "1 if the database answers, else 0", int(bool(metrics)))
        yield from metrics

    def _jobs(self) -> Iterator[Metric]:
        tallies = {(tally.kind, tally.phase): tally for tally in self._state.catalogue.census.tally()}
        kinds = sorted({*KINDS, *(kind for kind, _ in tallies)})
        jobs: dict[tuple[str, str], int] = {}
        attempts, retries, run_s = {}, {}, {}
        for kind in kinds:
            of_kind = {
                phase: tallies.get((kind, phase), JobTally(kind, phase, 0, 0, 0, 0.0)) for phase in Phase
            }
            jobs |= {(kind, str(phase)): tally.jobs for phase, tally in of_kind.items()}
            attempts[kind] = sum(tally.attempts for tally in of_kind.values())
            retries[kind] = sum(tally.retries for tally in of_kind.values())
            run_s[kind] = of_kind[Phase.COMPLETED].run_s
        yield _gauge("jobs", "Jobs", jobs, "kind", "phase")
        yield _gauge("job_attempts", "Number of times that jobs were started", attempts, "kind")
        yield _gauge("job_retries", "Number of times that jobs were started again", retries, "kind")
        description = "Sum over COMPLETED jobs of the time from the last start to the end"
        yield _gauge("job_run_seconds", description, run_s, "kind")

    def _stages(self) -> Iterator[Metric]:
        times = self._state.catalogue.stage_times.all()
        name, labels = "heliopsf_job_stage", ["kind", "stage"]
        seconds = CounterMetricFamily(
            f"{name}_seconds", "Time that ended attempts spent in a stage", labels=labels
        )
        yield _filled(seconds, {stage: spent.seconds for stage, spent in times.items()})
        steps = CounterMetricFamily(
            f"{name}_steps", "Steps that ended attempts reported in a stage", labels=labels
        )
        yield _filled(steps, {stage: spent.steps for stage, spent in times.items()})

    def _waiting(self) -> Iterator[Metric]:
        catalogue, lease_s = self._state.catalogue, self._state.settings.lease_s
        ages = {}
        for queue in Queue:
            oldest = catalogue.census.oldest_queued_at(queue)
            ages[queue] = 0.0 if oldest is None else max(0.0, time.time() - oldest)
        yield _gauge("oldest_queued_seconds", "Waiting time of the oldest queued job", ages, "queue")
        silent = catalogue.census.count_silent(lease_s)
        yield _gauge("jobs_silent", "Jobs whose worker did not report within its lease", silent)
        images = catalogue.bulks.progress.open_images()
        yield _gauge("bulk_images", "Images of bulk runs that have not ended", images, "state")
        ended = catalogue.bulks.progress.ended_images()
        yield _gauge("bulk_images_ended", "Images that all bulk runs have finished", ended, "outcome")
        workers = len(catalogue.census.workers(lease_s))
        yield _gauge("workers", "Worker processes that report", workers)

    def _files(self) -> Iterator[Metric]:
        tallies = self._state.catalogue.census.tally_files()
        files = {(tally.kind, tally.origin): tally.files for tally in tallies}
        sizes = {(tally.kind, tally.origin): tally.bytes for tally in tallies}
        yield _gauge("files", "Stored files", files, "kind", "origin")
        yield _gauge("file_bytes", "Bytes of stored files", sizes, "kind", "origin")


def _gauge(name: str, description: str, values: float | Mapping[Labels, float], *labels: str) -> Metric:
    """A gauge.

    Parameters
    ----------
    values
        The value of the gauge; or its values by the value of the label; or its values by a tuple of the values of all
        labels.
    """
    gauge = GaugeMetricFamily(f"heliopsf_{name}", description, labels=labels)
    return _filled(gauge, values if isinstance(values, Mapping) else {(): values})


def _filled(family: CounterMetricFamily | GaugeMetricFamily, values: Mapping[Labels, float]) -> Metric:
    for key, value in values.items():
        family.add_metric([key] if isinstance(key, str) else key, value)
    return family
