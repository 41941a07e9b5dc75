"""Sends spans to a collector by OTLP over HTTP. Only this module imports OpenTelemetry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from opentelemetry import trace
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.trace import NonRecordingSpan, SpanContext, SpanKind, Status, StatusCode, TraceFlags
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from workers.settings import software_version

W3C = ("traceparent", "tracestate")  # headers of a request
SEND_EVERY_MS = 1000  # a worker process that is ended loses the spans of at most this time


class Sender:
    """Makes spans and sends them to a collector, in another thread. A collector that does not answer delays nothing."""

    def __init__(self, url: str, part: str) -> None:
        resource = Resource.create(
            {"service.name": f"heliopsf-{part}", "service.version": software_version()}
        )
        self._provider = TracerProvider(resource=resource, shutdown_on_exit=False)
        exporter = OTLPSpanExporter(endpoint=url)
        self._provider.add_span_processor(BatchSpanProcessor(exporter, schedule_delay_millis=SEND_EVERY_MS))
        self._tracer = self._provider.get_tracer("heliopsf", software_version())
        self._propagator = TraceContextTextMapPropagator()

    @contextmanager
    def request(self, headers: Mapping[str, str]) -> Iterator[None]:
        """The span of a request. If the headers have a ``traceparent``, it is a child of that span."""
        parent = self._propagator.extract({name: headers[name] for name in W3C if name in headers})
        with self._tracer.start_as_current_span("request", context=parent, kind=SpanKind.SERVER):
            yield

    @contextmanager
    def job(self, job_id: str, kind: str) -> Iterator[None]:
        """The span of one attempt of a job, in the trace whose id is the id of the job."""
        flags = TraceFlags(TraceFlags.SAMPLED)
        root = SpanContext(int(job_id, 16), int(job_id[:16], 16) or 1, is_remote=True, trace_flags=flags)
        parent = trace.set_span_in_context(NonRecordingSpan(root))
        attributes = {"heliopsf.job": job_id, "heliopsf.kind": kind}
        with self._tracer.start_as_current_span(
            f"job {kind}", context=parent, kind=SpanKind.CONSUMER, attributes=attributes
        ):
            yield

    def note(
        self, attributes: Mapping[str, str | int | float | bool], *, name: str | None, failed: str | None
    ) -> None:
        """Add attributes to the current span."""
        span = trace.get_current_span()
        span.set_attributes(dict(attributes))
        if name is not None:
            span.update_name(name)
        if failed is not None:
            span.set_status(Status(StatusCode.ERROR, failed))

    def shutdown(self) -> None:
        """Send the spans that wait."""
        self._provider.shutdown()
