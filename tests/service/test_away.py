"""A server whose database hangs or only reads: its answers, its reconciler, ``/healthz`` and ``/readyz``."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import make_url

from service.app import create_app
from service.cli import doctor
from service.http.state import State
from tests.frozen_proxy import proxy_of
from tests.service.conftest import settings_in
from tests.service.serving import running
from tests.whole.stack import Missing, postgres_database, wait_for
from tests.workers.databases import reading_only
from workers import checks
from workers.broker import reconciler
from workers.catalogue import postgres
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER
from workers.settings import Settings

PING_S = 0.3
THREADS = 40  # of a server, for requests
BUILD = {"kind": "psf-build", "parameters": {"instrument": "aia_171"}}


@pytest.fixture
def database_url() -> Iterator[str]:
    try:
        with postgres_database() as url:
            yield url
    except Missing as missing:
        pytest.skip(str(missing))


@contextmanager
def serving(folder: Path, **changes: Any) -> Iterator[tuple[TestClient, State]]:
    settings = settings_in(folder / "data", reconcile_s=0.1).model_copy(update=changes)
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        yield api, api.app.state.heliopsf


def parts(api: TestClient) -> dict[str, str]:
    """What ``/readyz`` says about the parts of the service."""
    answer = api.get("/readyz").json()
    named: dict[str, str] = answer["parts"]
    return named


def test_connections_that_fall_silent_are_told_and_replaced(
    tmp_path: Path, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(postgres.PatientConnection, "silence_s", PING_S)
    monkeypatch.setattr(postgres, "PING_S", PING_S)
    monkeypatch.setattr(postgres, "SILENCE_S", 2 * PING_S)
    monkeypatch.setattr(postgres, "TCP", postgres.TCP | {"connect_timeout": 2})  # s; the shortest of libpq
    monkeypatch.setattr(reconciler, "ALIVE_S", 1.0)
    monkeypatch.setattr(checks, "CHECK_S", 1.0)
    url = make_url(database_url)
    with proxy_of(url.host or "127.0.0.1", url.port or 5432) as proxy:
        here = url.set(host="127.0.0.1", port=proxy.port).render_as_string(hide_password=False)
        with serving(tmp_path, database_url=here) as (api, state):

            def well() -> bool:
                healthy = api.get("/healthz").status_code == 200
                return healthy and parts(api)["database"] == "ok" and state.reconciler.alive

            wait_for(well, "the service answers")
            proxy.freeze()  # new connections work
            job, _ = Catalogue(state.settings.catalogue_url).jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)

            def submitted() -> bool:
                row = state.catalogue.jobs.get(job.id)
                return row is not None and row.submissions > 0

            wait_for(submitted, "the reconciler goes on", 20.0)
            wait_for(well, "the service goes on", 20.0)

            proxy.accepting = False
            proxy.freeze()  # as a server that is stopped
            assert parts(api)["database"] != "ok" and api.get("/healthz").status_code == 503
            wait_for(lambda: "reconciler" in parts(api), "no round succeeds", 20.0)

            proxy.accepting = True
            wait_for(well, "it is over", 20.0)


def test_a_database_that_only_reads(tmp_path: Path, database_url: str) -> None:
    with serving(tmp_path, database_url=database_url) as (api, state):
        with reading_only(state.catalogue):
            answer = api.post("/v1/jobs", json=BUILD)
            assert (answer.status_code, answer.json()["type"]) == (503, "urn:heliopsf:database-away")
            assert answer.headers["Retry-After"] == "5"
            assert "accepts no changes" in parts(api)["database"]
            told = doctor.examine(state.settings)["changes"]
            assert told.state == "broken" and "only reads" in told.found
            assert api.get("/v1/jobs").status_code == 200 and api.get("/healthz").status_code == 200
        assert api.post("/v1/jobs", json=BUILD).status_code == 202 and parts(api)["database"] == "ok"


def test_health_is_answered_although_every_thread_waits(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A check that hangs is not started again, and the other parts are told as they are."""
    monkeypatch.setattr(checks, "CHECK_S", 1.0)
    release, begun = threading.Event(), []

    def hang(*_: object, **__: object) -> list[object]:
        begun.append(1)
        release.wait(30.0)
        return []

    with running(settings) as live, httpx.Client(timeout=30.0) as client, ThreadPoolExecutor(60) as others:
        state = live.app.state.heliopsf
        found = checks.needed(state.settings, state.catalogue, state.store) | {"broker": hang}
        monkeypatch.setattr(checks, "needed", lambda *_: found)
        monkeypatch.setattr(state.catalogue, "page", hang)
        try:
            for _ in range(60):
                others.submit(client.get, f"{live.url}/v1/jobs")
            wait_for(lambda: len(begun) == THREADS, "all threads of the pool wait", 20.0)
            for _ in range(2):
                assert client.get(f"{live.url}/healthz").status_code == 200
                named = client.get(f"{live.url}/readyz").json()["parts"]
                assert "has not ended" in named["broker"] and named["database"] == "ok"
            assert len(begun) == THREADS + 1
        finally:
            release.set()
