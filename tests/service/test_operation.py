"""What an operator sees: request ids, log lines, metrics, readiness."""

from __future__ import annotations

import io
import json
import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import Engine, create_engine, event, text, update
from sqlalchemy.exc import OperationalError

from service.app import create_app
from service.http.state import State
from tests.conftest import write_image
from tests.service.conftest import execute, upload
from tests.whole.stack import Missing, Redis, wait_for
from workers import logs
from workers.bulk.runs import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.census import KeptStageTimes
from workers.catalogue.tables import DEFAULT_OWNER, ImageRow, JobRow
from workers.settings import Settings

Lines = Callable[[], list[dict[str, Any]]]
AWAY = OperationalError("SELECT 1", None, Exception("no route to s3cret.example"))


@pytest.fixture
def lines() -> Iterator[Lines]:
    """All that is logged, as the JSON that it is written as."""
    written = io.StringIO()
    handler = logging.StreamHandler(written)
    handler.setFormatter(logs.JsonFormatter())
    root = logging.getLogger()
    before = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    logging.getLogger("httpx").setLevel(logging.WARNING)  # the client that asks
    yield lambda: [json.loads(line) for line in written.getvalue().splitlines()]
    root.removeHandler(handler)
    root.setLevel(before)


def handles(api: TestClient) -> State:
    """The application's own state."""
    state: State = api.app.state.heliopsf
    return state


def scrape(api: TestClient) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    answer = api.get("/metrics")
    assert answer.status_code == 200 and answer.headers["Content-Type"].startswith("text/plain")
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def sample(name: str, **labels: str) -> tuple[str, frozenset[tuple[str, str]]]:
    return name, frozenset(labels.items())


# Requests and logs ----------------------------------------------------------------------------------


def test_a_request_keeps_its_id_and_gets_one_where_it_has_no_good_one(shared_api: TestClient) -> None:
    def id_of(sent: str | None = None) -> str:
        headers = {} if sent is None else {"X-Request-ID": sent}
        return str(shared_api.get("/v1/jobs", headers=headers).headers["X-Request-ID"])

    assert id_of("from-me.1") == "from-me.1"
    new = [id_of(sent) for sent in (None, None, "two words", "x" * 65, 'a"b', "")]
    assert len(set(new)) == len(new) and all(len(one) == 32 for one in new)


def test_a_line_says_when_who_what_and_for_which_request(
    api: TestClient, lines: Lines, image_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def line() -> dict[str, Any]:
        return [one for one in lines() if one["logger"] == "service.http.observation"][-1]

    api.get("/v1/jobs/" + 32 * "0", headers={"X-Request-ID": "r1"})
    assert line()["time"].endswith("+00:00") and line()["level"] == "INFO" and line()["request"] == "r1"
    assert (line()["route"], line()["status"]) == ("/v1/jobs/{job_id}", 404)

    api.get("/v1/%0a%7b%22level%22:%22forged%22%7d")
    assert "forged" in line()["message"] and line()["level"] == "INFO", "it stays on its line"

    header = {"Authorization": "Bearer s3cret", "Cookie": "s3cret", "Content-Type": "application/fits"}
    named = {"filename": "s3cret.fits"}
    api.post("/v1/images", params=named, content=image_file.read_bytes(), headers=header)
    written = json.dumps(lines())
    assert "/v1/images" in written and "s3cret" not in written and "SIMPLE" not in written

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("oh")

    monkeypatch.setattr(handles(api).catalogue, "page", fail)
    answer = api.get("/v1/jobs", headers={"X-Request-ID": "r2"})
    assert answer.status_code == 500 and answer.headers["X-Request-ID"] == "r2"
    assert line()["request"] == "r2" and line()["status"] == 500


def test_text_stays_on_its_line_too() -> None:
    record = logging.LogRecord("x", logging.INFO, "", 0, "GET /\nforged \x1b[31m", None, None)
    assert logs.TextFormatter().format(record).count("\n") == 0
    assert "\x1b" not in logs.TextFormatter().format(record)


# Metrics --------------------------------------------------------------------------------------------


def test_jobs_are_counted_wherever_they_were_worked_on(api: TestClient, settings: Settings) -> None:
    elsewhere = Catalogue(settings.catalogue_url)  # as another process would have it
    first, _ = elsewhere.jobs.submit("psf-build", {}, "a", DEFAULT_OWNER)
    second, _ = elsewhere.jobs.submit("psf-build", {}, "b", DEFAULT_OWNER)
    for _ in range(2):
        lease = elsewhere.jobs.claim(first.id, "w")
        assert lease is not None and elsewhere.jobs.requeue(lease)
    lease = elsewhere.jobs.claim(second.id, "w")
    assert lease is not None
    time.sleep(0.05)
    elsewhere.jobs.complete(lease, "r")
    elsewhere.close()
    found = scrape(api)
    assert found[sample("heliopsf_jobs", kind="psf-build", phase="QUEUED")] == 1
    assert found[sample("heliopsf_jobs", kind="psf-build", phase="COMPLETED")] == 1
    assert found[sample("heliopsf_jobs", kind="deconvolve", phase="QUEUED")] == 0
    assert found[sample("heliopsf_job_attempts", kind="psf-build")] == 3
    assert found[sample("heliopsf_job_retries", kind="psf-build")] == 1
    assert 0.05 <= found[sample("heliopsf_job_run_seconds", kind="psf-build")] < 5
    assert 0.05 <= found[sample("heliopsf_oldest_queued_seconds", queue="interactive")] < 60


def test_bytes_and_workers_are_counted(api: TestClient, image_file: Path) -> None:
    size = image_file.stat().st_size
    for _ in range(2):  # sent twice, kept once
        upload(api, image_file)
    found = scrape(api)
    assert found[sample("heliopsf_file_bytes", kind="image", origin="uploaded")] == size
    assert found[sample("heliopsf_files", kind="image", origin="uploaded")] == 1
    assert found[sample("heliopsf_http_received_bytes_total", route="/v1/images")] == 2 * size

    census = handles(api).catalogue.census
    assert found[sample("heliopsf_workers")] == 0
    for host in ("host:1", "host:1", "host:2"):
        census.announce(host, time.time(), "1")
    census.take_leave("host:2")
    found = scrape(api)
    assert found[sample("heliopsf_workers")] == 1 and found[sample("heliopsf_jobs_silent")] == 0


def test_requests_are_counted_by_route_and_never_by_path(api: TestClient) -> None:
    for number in range(3):
        api.get(f"/v1/jobs/{number:032x}")
        api.get(f"/nowhere/{number}")
        api.request(f"WORD{number}", "/v1/jobs")
    found = scrape(api)
    asked = {key: value for key, value in found.items() if key[0] == "heliopsf_http_requests_total"}
    route = "/v1/jobs/{job_id}"
    assert asked[sample("heliopsf_http_requests_total", route=route, method="GET", status="404")] == 3
    assert asked[sample("heliopsf_http_requests_total", route="none", method="GET", status="404")] == 3
    assert sum(value for (_, labels), value in asked.items() if ("method", "other") in labels) == 3
    assert len(asked) == 3
    bucket = sample("heliopsf_http_request_seconds_bucket", route=route, method="GET", le="+Inf")
    assert found[bucket] == 3


def test_a_scrape_reads_indexes_alone(api: TestClient, settings: Settings) -> None:
    asked: list[tuple[str, Any]] = []

    def note(_c: Any, _cursor: Any, statement: str, parameters: Any, *_: Any) -> None:
        asked.append((statement, parameters))

    event.listen(Engine, "before_cursor_execute", note)
    scrape(api)
    event.remove(Engine, "before_cursor_execute", note)
    queries = [one for one in asked if one[0].lstrip().startswith("SELECT") and "FROM " in one[0]]
    tables = {"jobs", "images", "transits", "psfs", "products", "reports"}
    seen = set()
    with create_engine(settings.catalogue_url).connect() as connection:
        for statement, parameters in queries:
            plan = connection.exec_driver_sql("EXPLAIN QUERY PLAN " + statement, parameters).all()
            for step in (str(row[-1]) for row in plan):
                table = step.split()[1] if step.split()[0] in ("SCAN", "SEARCH") else ""
                if table in tables:
                    seen.add(table)
                    assert "COVERING INDEX" in step or step.startswith("SEARCH"), (statement, step)
    assert seen == tables


def test_metrics_say_that_the_database_is_away(api: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    assert scrape(api)[sample("heliopsf_database_up")] == 1

    def away() -> None:
        raise AWAY

    monkeypatch.setattr(handles(api).catalogue.census, "tally", away)
    found = scrape(api)
    assert found[sample("heliopsf_database_up")] == 0
    assert not any(name == "heliopsf_jobs" for name, _ in found)


# Readiness ------------------------------------------------------------------------------------------


def test_ready_once_the_embedded_worker_is_there(api: TestClient) -> None:
    answer = api.get("/readyz")
    assert answer.status_code == 503 and answer.headers["Content-Type"] == "application/problem+json"
    parts = answer.json()["parts"]
    assert parts["database"] == parts["storage"] == "ok" and "no worker" in parts["worker"]
    assert api.get("/healthz").status_code == 200
    handles(api).catalogue.census.announce("host:1", time.time(), "1")
    assert api.get("/readyz").json() == {
        "status": "ready",
        "parts": {"database": "ok", "storage": "ok", "jobs": "ok", "worker": "ok"},
    }
    silent = text("UPDATE workers SET heartbeat_at = heartbeat_at - 3000")
    execute(handles(api).catalogue, silent)  # a worker that was killed falls silent
    assert api.get("/readyz").status_code == 503


def test_not_ready_where_files_cannot_be_written_or_the_database_is_away(
    api: TestClient, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings.data_dir.rename(settings.data_dir.with_name("gone"))
    parts = api.get("/readyz").json()["parts"]
    settings.data_dir.with_name("gone").rename(settings.data_dir)
    assert "cannot be written" in parts["storage"]

    def away() -> None:
        raise AWAY

    monkeypatch.setattr(handles(api).catalogue, "clock", away)
    answer = api.get("/readyz")
    assert answer.status_code == 503 and "does not answer" in answer.json()["parts"]["database"]
    assert "s3cret" not in answer.text


def test_ready_with_a_broker_that_answers(settings: Settings, tmp_path: Path) -> None:
    try:
        redis = Redis(tmp_path)
    except Missing as missing:
        pytest.skip(str(missing))
    url = redis.url.replace("redis://", "redis://:s3cret@")
    with redis, TestClient(create_app(settings.model_copy(update={"broker_url": redis.url}))) as api:
        parts = api.get("/readyz").json()["parts"]
        assert parts == {"database": "ok", "storage": "ok", "jobs": "ok", "broker": "ok"}
    with TestClient(create_app(settings.model_copy(update={"broker_url": url}))) as api:
        answer = api.get("/readyz")
        assert answer.status_code == 503 and "does not answer" in answer.json()["parts"]["broker"]
        assert "s3cret" not in answer.text


def test_not_ready_if_a_job_waits_for_workers_that_do_nothing(api: TestClient) -> None:
    catalogue = handles(api).catalogue
    waiting, _ = catalogue.jobs.submit("psf-build", {}, "waits", DEFAULT_OWNER)
    other, _ = catalogue.jobs.submit("psf-build", {}, "other", DEFAULT_OWNER)

    def jobs(started_ago_s: float, queued_ago_s: float, submissions: int, worked_ago_s: float) -> str:
        """The part "jobs", if the worker started, the job was queued and another job ended so long ago."""
        now = time.time()
        catalogue.census.announce("host:1", now - started_ago_s, "1")
        of = update(JobRow)
        execute(
            catalogue,
            of.where(JobRow.id == waiting.id).values(
                created_at=now - queued_ago_s, submitted_at=now, submissions=submissions
            ),
        )
        ended = {"phase": "COMPLETED", "submitted_at": now, "heartbeat_at": now - worked_ago_s}
        execute(catalogue, of.where(JobRow.id == other.id).values(**ended))
        part: str = api.get("/readyz").json()["parts"]["jobs"]
        return part

    assert jobs(500, 500, 3, 60) == "ok", "the worker was busy"
    assert jobs(60, 500, 3, 500) == "ok", "the worker has just started"
    assert jobs(500, 60, 3, 500) == "ok", "the job is new"
    assert jobs(500, 500, 1, 500) == "ok", "a draft that was queued now, or a job that runs again"
    assert "jobs wait (1)" in jobs(500, 500, 3, 500)
    assert api.get("/readyz").status_code == 503
    execute(catalogue, text("DELETE FROM workers"))
    parts = api.get("/readyz").json()["parts"]
    assert parts["jobs"] == "ok" and "no worker" in parts["worker"]


def test_a_server_says_what_it_would_delete_and_deletes_it_when_told(
    settings: Settings, lines: Lines, image_file: Path
) -> None:
    with TestClient(create_app(settings)) as api:
        image = upload(api, image_file)
        execute(handles(api).catalogue, update(ImageRow).values(created_at=0.0))
    for dry_run, done, status in ((True, "would delete", 200), (False, "deleted", 404)):
        keeping = settings.model_copy(update={"keep_days": "image=30", "keep_dry_run": dry_run})
        with TestClient(create_app(keeping)) as api:

            def told(done: str = done) -> bool:
                return any(one.get("kind") == "image" and done in one["message"] for one in lines())

            wait_for(told, "the server says what it does")
            assert api.get(f"/v1/images/{image}").status_code == status


FEW = {"method": {"name": "richardson-lucy", "steps": 3}}


def test_images_of_a_bulk_are_counted_and_written_once_a_turn(
    api: TestClient,
    settings: Settings,
    catalogue: Catalogue,
    tmp_path: Path,
    psf_file: Path,
    run_jobs: Callable[[], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    images = []
    for number in range(3):
        write_image(tmp_path / f"{number}.fits", seed=number)
        images.append(upload(api, tmp_path / f"{number}.fits"))
    written: list[str] = []
    add = KeptStageTimes.add

    def counted(kept: KeptStageTimes, kind: str, spent: Any) -> None:
        written.append(kind)
        add(kept, kind, spent)

    monkeypatch.setattr(KeptStageTimes, "add", counted)
    bulk = {"images": images, "psf_id": upload(api, psf_file, "/v1/psfs"), "parameters": FEW}
    assert api.post("/v1/bulk", json=bulk).status_code == 202
    keep_turns(catalogue, settings)
    run_jobs()
    assert written == ["bulk"]
    found = scrape(api)
    steps = {
        dict(labels)["stage"]: value
        for (name, labels), value in found.items()
        if name == "heliopsf_job_stage_steps_total" and ("kind", "bulk") in labels
    }
    assert steps["deconvolving"] == 9 and set(steps) >= {"reading", "saving", "between images"}
    assert "images" not in steps
    ended = {
        of: found[sample("heliopsf_bulk_images_ended", outcome=of)]
        for of in ("deconvolved", "reused", "failed")
    }
    assert ended == {"deconvolved": 3, "reused": 0, "failed": 0}
    took_s = [took_s for _, took_s in catalogue.bulks.progress.image_times(9)]
    assert len(took_s) == 3 and all(0 < one < 60 for one in took_s), "estimates learn from them"
