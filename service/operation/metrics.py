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
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
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
        yield InfoMetricFamily("heliopsf", "The service", {"version": software_version()})
        room = GaugeMetricFamily("heliopsf_storage_free_bytes", "Free space where files are stored")
        room.add_metric([], checks.free_bytes(self._state.settings.data_dir))
        yield room
        streams = GaugeMetricFamily("heliopsf_event_streams", "Streams of events that this process sends now")
        streams.add_metric([], self._state.streams.total())
        yield streams
        up = GaugeMetricFamily("heliopsf_database_up", "1 if the database answers, else 0")
        try:
            found = [*self._jobs(), *self._stages(), *self._waiting(), *self._files()]
        except SQLAlchemyError:
            up.add_metric([], 0)
            yield up
            return
        up.add_metric([], 1)
        yield up
        yield from found

    def _jobs(self) -> Iterator[Metric]:
        tallies = {(tally.kind, tally.phase): tally for tally in self._state.catalogue.census.tally()}
        kinds = sorted({*KINDS, *(kind for kind, _ in tallies)})
        jobs = GaugeMetricFamily("heliopsf_jobs", "Jobs", labels=["kind", "phase"])
        attempts = GaugeMetricFamily(
            "heliopsf_job_attempts", "Number of times that jobs were started", labels=["kind"]
        )
        retries = GaugeMetricFamily(
            "heliopsf_job_retries", "Number of times that jobs were started again", labels=["kind"]
        )
        seconds = GaugeMetricFamily(
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
        seconds = CounterMetricFamily(
            "heliopsf_job_stage_seconds",
            "Time that ended attempts spent in a stage",
            labels=["kind", "stage"],
        )
        steps = CounterMetricFamily(
            "heliopsf_job_stage_steps",
            "Steps that ended attempts reported in a stage",
            labels=["kind", "stage"],
        )
        for (kind, stage), spent in self._state.catalogue.stage_times.all().items():
            seconds.add_metric([kind, stage], spent.seconds)
            steps.add_metric([kind, stage], spent.steps)
        yield from (seconds, steps)

    def _waiting(self) -> Iterator[Metric]:
        catalogue, lease_s = self._state.catalogue, self._state.settings.lease_s
        age = GaugeMetricFamily(
            "heliopsf_oldest_queued_seconds", "Waiting time of the oldest queued job", labels=["queue"]
        )
        for queue in Queue:
            oldest = catalogue.census.oldest_queued_at(queue)
            age.add_metric([queue], 0.0 if oldest is None else max(0.0, time.time() - oldest))
        yield age
        silent = GaugeMetricFamily(
            "heliopsf_jobs_silent", "Jobs whose worker did not report within its lease"
        )
        silent.add_metric([], catalogue.census.count_silent(lease_s))
        yield silent
        images = GaugeMetricFamily(
            "heliopsf_bulk_images", "Images of bulk runs that have not ended", labels=["state"]
        )
        for state, count in catalogue.bulks.progress.open_images().items():
            images.add_metric([state], count)
        yield images
        workers = GaugeMetricFamily("heliopsf_workers", "Worker processes that report")
        workers.add_metric([], len(catalogue.census.workers(lease_s)))
        yield workers

    def _files(self) -> Iterator[Metric]:
        files = GaugeMetricFamily("heliopsf_files", "Stored files", labels=["kind", "origin"])
        size = GaugeMetricFamily("heliopsf_file_bytes", "Bytes of stored files", labels=["kind", "origin"])
        for tally in self._state.catalogue.census.tally_files():
            files.add_metric([tally.kind, tally.origin], tally.files)
            size.add_metric([tally.kind, tally.origin], tally.bytes)
        yield from (files, size)
