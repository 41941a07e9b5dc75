"""Observes every request: gives it an id, logs it, and counts it in the metrics."""

from __future__ import annotations

import logging
import time

from fastapi import FastAPI
from prometheus_client import CollectorRegistry, Counter, Histogram
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from workers import logs, traces

log = logging.getLogger(__name__)
REQUEST_ID = "X-Request-ID"
# All other methods share one label, and all paths without a route share one label. This limits the number of labels.
METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}
NOWHERE = "none"
ROUTINE = {"/healthz", "/readyz", "/metrics"}
BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 120.0)


class RequestMetrics:
    """Counts the requests of this process by route, method and status. The counts are not stored in the database."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._answered = Counter(
            "heliopsf_http_requests",
            "Requests answered by this process",
            ["route", "method", "status"],
            registry=self.registry,
        )
        self._seconds = Histogram(
            "heliopsf_http_request_seconds",
            "Time from the header of a request to the end of its answer",
            ["route", "method"],
            buckets=BUCKETS_S,
            registry=self.registry,
        )
        self._received = Counter(
            "heliopsf_http_received_bytes",
            "Bytes of request bodies received by this process",
            ["route"],
            registry=self.registry,
        )

    def count(self, route: str, method: str, status: int, seconds: float, received: int) -> None:
        """Count an answered request."""
        self._answered.labels(route, method, str(status)).inc()
        self._seconds.labels(route, method).observe(seconds)
        if received:
            self._received.labels(route).inc(received)


def install(app: FastAPI) -> RequestMetrics:
    """Observe every request of the application."""
    metrics = RequestMetrics()
    app.add_middleware(_Observed, metrics=metrics)
    return metrics


class _Observed:
    def __init__(self, app: ASGIApp, metrics: RequestMetrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        with traces.of_request(Headers(scope=scope)):
            await self._observe(scope, receive, send)

    async def _observe(self, scope: Scope, receive: Receive, send: Send) -> None:
        request_id = logs.request_id(Headers(scope=scope).get(REQUEST_ID))
        # Each request has its own context. The id stays bound, so that the server's log of a failure contains it too.
        logs.bind(request=request_id)
        started = time.perf_counter()
        status, received = 500, 0  # the status is 500 if an exception occurs before an answer begins

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            return message

        async def noted(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)[REQUEST_ID] = request_id
            await send(message)

        try:
            await self._app(scope, counted, noted)
        finally:
            seconds = time.perf_counter() - started
            route = getattr(scope.get("route"), "path", NOWHERE)
            method = scope["method"] if scope["method"] in METHODS else "other"
            # The caller, if known: the owner, and the id of the key, or the address. The key itself is never logged.
            found = scope.get("state", {}).get("caller")
            caller = {} if found is None else {"owner": found.owner, "caller": found.name}
            self._metrics.count(route, method, status, seconds, received)
            # The request in its span, in the words of the semantic conventions of OpenTelemetry.
            attributes: dict[str, traces.Attribute] = {
                "http.request.method": method,
                "http.route": route,
                "http.response.status_code": status,
                "heliopsf.request": request_id,
                **{f"heliopsf.{name}": value for name, value in caller.items()},
            }
            failed = f"status {status}" if status >= 500 else None
            traces.note(attributes, name=f"{method} {route}", failed=failed)
            level = logging.DEBUG if route in ROUTINE and status < 500 else logging.INFO
            fields = {"route": route, "status": status, "seconds": round(seconds, 4), **caller}
            # The path does not contain the query.
            log.log(level, "%s %s %d", method, scope["path"], status, extra={"fields": fields})
