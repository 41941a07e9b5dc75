"""Traces: off and free of cost by default; with the setting, requests and jobs arrive at a collector."""

from __future__ import annotations

import gzip
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from psfcore.errors import MissingExtra
from service.app import create_app
from tests.service.conftest import upload
from tests.workers.jobs import run_job
from workers import traces
from workers.catalogue.catalogue import Catalogue
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings

CLIENT = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"


def settings_of(folder: Path, url: str | None) -> Settings:
    return Settings(
        data_dir=folder / "data", broker_url="filesystem://", allowed_hosts="testserver", traces_url=url
    )


@contextmanager
def collector() -> Iterator[tuple[str, Callable[[], list[dict[str, Any]]]]]:
    """A collector of OTLP on a free port: its address, and the spans that it got."""
    pb = pytest.importorskip("opentelemetry.proto.collector.trace.v1.trace_service_pb2")
    bodies: list[bytes] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            bodies.append(gzip.decompress(body) if self.headers.get("Content-Encoding") == "gzip" else body)
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Write nothing."""

    def spans() -> list[dict[str, Any]]:
        requests = [pb.ExportTraceServiceRequest.FromString(body) for body in bodies]
        return [
            {one.key: getattr(one.value, one.value.WhichOneof("value")) for one in span.attributes}
            | {
                "name": span.name,
                "trace": span.trace_id.hex(),
                "parent": span.parent_span_id.hex(),
                "failed": span.status.message,
                "part": {one.key: one.value.string_value for one in of.resource.attributes}["service.name"],
            }
            for request in requests
            for of in request.resource_spans
            for scope in of.scope_spans
            for span in scope.spans
        ]

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/v1/traces", spans
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_nothing_of_opentelemetry_is_imported_by_default() -> None:
    code = (
        "import sys, workers.run.runner\n"
        "from workers import traces\n"
        "from workers.settings import Settings\n"
        "traces.configure(Settings(), 'server')\n"
        "with traces.of_request({}), traces.of_job('0' * 32, 'deconvolve'): traces.note({'a': 1})\n"
        "print('opentelemetry' in sys.modules)\n"
        # FastAPI itself imports the interface of OpenTelemetry, where it is installed.
        "import service.app\n"
        "traces.configure(Settings(), 'server')\n"
        "print([part for part in ('sdk', 'exporter', 'proto') if f'opentelemetry.{part}' in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines() == ["False", "[]"]


def test_the_setting_without_the_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry", None)
    monkeypatch.delitem(sys.modules, "workers.trace_exporter", raising=False)
    with pytest.raises(MissingExtra, match=r"heliopsf\[traces\]"):
        traces.configure(settings_of(tmp_path, "http://127.0.0.1:9/v1/traces"), "server")


def test_requests_and_jobs_arrive_at_the_collector(tmp_path: Path, image_file: Path, psf_file: Path) -> None:
    with collector() as (url, spans):
        settings = settings_of(tmp_path, url)
        with TestClient(create_app(settings)) as api:
            ids = {"image_id": upload(api, image_file), "psf_id": upload(api, psf_file, "/v1/psfs")}
            few = {"method": {"name": "richardson-lucy", "steps": 1}}
            job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": ids | few}).json()["id"]
            api.get(f"/v1/jobs/{job}", headers={"traceparent": CLIENT, "X-Request-ID": "abc"})
            catalogue = Catalogue(settings.catalogue_url)
            run_job(Runner(settings, catalogue, Store(settings.data_dir)), catalogue, job)
            failing, _ = catalogue.jobs.submit("deconvolve", {"image_id": "x"}, "k", "local")
            run_job(Runner(settings, catalogue, Store(settings.data_dir)), catalogue, failing.id)
            catalogue.close()
        found = spans()
    assert {one["part"] for one in found} == {"heliopsf-server"}
    (asked,) = [one for one in found if one["name"] == "GET /v1/jobs/{job_id}"]
    assert (asked["trace"], asked["parent"]) == tuple(CLIENT.split("-")[1:3])
    assert (asked["http.response.status_code"], asked["heliopsf.request"]) == (200, "abc")
    (done,) = [one for one in found if one["trace"] == job]
    assert (done["name"], done["heliopsf.job"], done["failed"]) == ("job deconvolve", job, "")
    assert done["heliopsf.stage.deconvolving_s"] >= 0
    (failed,) = [one for one in found if one["trace"] == failing.id]
    assert failed["failed"] == failed["heliopsf.error"] == "internal-error"
    with TestClient(create_app(settings_of(tmp_path, "http://127.0.0.1:9/v1/traces"))) as api:
        assert api.get("/healthz").status_code == 200, "a collector that does not answer disturbs nothing"
