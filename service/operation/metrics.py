"""Metrics for Prometheus: ``/metrics``.

Numbers about all processes (jobs, files, workers) are read from the database whenever Prometheus reads the
metrics, by queries that use only indexes. Numbers about this process (its requests) are counted in the process. The numbers
of jobs and files are gauges, because they decrease when a job is destroyed. The time that jobs spent in their stages is a
counter, which never decreases.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Metric, generate_latest
from prometheus_client.core import CounterMetricFamily, InfoMetricFamily
from prometheus_client.core import GaugeMetricFamily as Gauge
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError

from service.http.callers import Administering
from service.http.state import Shared, State
from workers import checks
from workers.catalogue.census import JobTally
from workers.contract.kinds import KINDS
from workers.contract.phases import Phase
from workers.contract.queues import Queue
from workers.settings import software_version

router = APIRouter(tags=["operation"])


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
        except ``heliopsf_database_up``, which is 0."""
        state = self._state
        free_bytes, streams = checks.free_bytes(state.settings.data_dir), state.streams.total()
        yield InfoMetricFamily("heliopsf", "The service", {"version": software_version()})
        yield Gauge("heliopsf_storage_free_bytes", "Free space where files are stored", free_bytes)
        yield Gauge("heliopsf_event_streams", "Streams of events that this process sends now", streams)
        try:
            families = [*self._jobs(), *self._stages(), *self._waiting(), *self._files()]
        except SQLAlchemyError:
            families = None
        yield Gauge("heliopsf_database_up", "1 if the database answers, else 0", families is not None)
        yield from families or ()

    def _jobs(self) -> Iterator[Metric]:
        tallies = {(tally.kind, tally.phase): tally for tally in self._state.catalogue.census.tally()}
        kinds = sorted({*KINDS, *(kind for kind, _ in tallies)})
        jobs = Gauge("heliopsf_jobs", "Jobs", labels=["kind", "phase"])
        attempts = Gauge("heliopsf_job_attempts", "Number of times that jobs were started", labels=["kind"])
        retries = Gauge(
            "heliopsf_job_retries", "Number of times that jobs were started again", labels=["kind"]
        )
        seconds = Gauge(
            "heliopsf_job_run_seconds",
            "Sum over COMPLETED jobs of the time from the last start to the end",
            labels=["kind"],
        )
        for kind in kinds:
            of_kind = {
                phase: tallies.get((kind, phase), JobTally(kind, phase, 0, 0, 0, 0.0)) for phase in Phase
            }
            for phase, tally in of_kind.items():
                jobs.add_metric([kind, phase], tally.jobs)
            attempts.add_metric([kind], sum(tally.attempts for tally in of_kind.values()))
            retries.add_metric([kind], sum(tally.retries for tally in of_kind.values()))
            seconds.add_metric([kind], of_kind[Phase.COMPLETED].run_s)
        yield from (jobs, attempts, retries, seconds)

    def _stages(self) -> Iterator[Metric]:
        labels = ["kind", "stage"]
        seconds = CounterMetricFamily(
            "heliopsf_job_stage_seconds", "Time that ended attempts spent in a stage", labels=labels
        )
        steps = CounterMetricFamily(
            "heliopsf_job_stage_steps", "Steps that ended attempts reported in a stage", labels=labels
        )
        for key, spent in self._state.catalogue.stage_times.all().items():
            seconds.add_metric(key, spent.seconds)
            steps.add_metric(key, spent.steps)
        yield from (seconds, steps)

    def _waiting(self) -> Iterator[Metric]:
        catalogue, lease_s = self._state.catalogue, self._state.settings.lease_s
        age = Gauge(
            "heliopsf_oldest_queued_seconds", "Waiting time of the oldest queued job", labels=["queue"]
        )
        for queue in Queue:
            oldest = catalogue.census.oldest_queued_at(queue)
            age.add_metric([queue], 0.0 if oldest is None else max(0.0, time.time() - oldest))
        images = Gauge("heliopsf_bulk_images", "Images of bulk runs that have not ended", labels=["state"])
        for state, count in catalogue.bulks.progress.open_images().items():
            images.add_metric([state], count)
        silent, workers = catalogue.census.count_silent(lease_s), catalogue.census.workers(lease_s)
        yield from (age, images)
        yield Gauge("heliopsf_jobs_silent", "Jobs whose worker did not report within its lease", silent)
        yield Gauge("heliopsf_workers", "Worker processes that report", len(workers))

    def _files(self) -> Iterator[Metric]:
        files = Gauge("heliopsf_files", "Stored files", labels=["kind", "origin"])
        size = Gauge("heliopsf_file_bytes", "Bytes of stored files", labels=["kind", "origin"])
        for tally in self._state.catalogue.census.tally_files():
            files.add_metric([tally.kind, tally.origin], tally.files)
            size.add_metric([tally.kind, tally.origin], tally.bytes)
        yield from (files, size)
