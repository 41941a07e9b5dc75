"""Progress as server-sent events from a running server."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import update

from service.api import events
from service.app import create_app
from service.client.http import ServiceError
from tests.service.api.live import Following, Live, running
from tests.service.conftest import execute, refusal
from tests.service.keyed import bearer, keyed
from tests.whole.stack import wait_for
from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.bulks import new_id
from workers.catalogue.tables import DEFAULT_OWNER, JobRow, KeyRow
from workers.contract.bulk import BulkPhase
from workers.settings import Settings


@pytest.fixture
def live(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> Iterator[Live]:
    monkeypatch.setattr(events, "LOOK_EVERY_S", 0.05)
    with running(settings.model_copy(update={"streams_per_caller": 2})) as server:
        yield server


def test_a_job_is_followed_to_its_end(live: Live) -> None:
    job_id, lease = live.job()
    seen: list[dict[str, Any]] = []

    def follow() -> None:
        seen.extend(live.client.follow(f"/v1/jobs/{job_id}"))

    following = threading.Thread(target=follow)
    following.start()
    wait_for(lambda: len(seen) == 1, "the first event", timeout_s=10)
    live.catalogue.jobs.progress(lease, "building", 1, 2)
    wait_for(lambda: len(seen) == 2, "the second", timeout_s=10)
    time.sleep(0.3)
    assert len(seen) == 2, "nothing is said where nothing has changed"
    live.catalogue.jobs.complete(lease, "r" * 64)
    following.join(10)
    assert [event["phase"] for event in seen] == ["EXECUTING", "EXECUTING", "COMPLETED"]
    assert seen[1]["progress"]["stage"] == "building" and seen[2]["result"].endswith("r" * 64)
    # The result that this job names was never made; only the answer about one job looks whether it is there.
    assert {**seen[2], "result_deleted": True} == live.client.job(job_id)
    assert live.streams() == 0


def test_a_reconnected_client_gets_what_changed_meanwhile(live: Live) -> None:
    job_id, lease = live.job()
    first = Following(f"{live.url}/v1/jobs/{job_id}/events")
    first.await_lines("id:", 1)
    assert first.type.startswith("text/event-stream") and first.said("retry:") == ["2000"]
    knows = {"Last-Event-ID": first.said("id:")[0]}
    second = Following(f"{live.url}/v1/jobs/{job_id}/events", **knows)
    time.sleep(0.4)
    assert second.said("event:") == [], "it knows what there is to know"
    live.catalogue.jobs.complete(lease, "r" * 64)
    second.join(10), first.join(10)
    assert second.said("event:") == ["end"] and first.said("event:") == ["progress", "end"]
    again = httpx.get(f"{live.url}/v1/jobs/{job_id}/events", headers=knows)
    assert again.status_code == 200 and "event: end" in again.text
    ended = {"Last-Event-ID": second.said("id:")[0]}
    assert httpx.get(f"{live.url}/v1/jobs/{job_id}/events", headers=ended).status_code == 204


def test_an_idle_stream_sends_comments_and_a_closed_connection_frees_its_stream(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "ALIVE_EVERY_S", 0.1)
    (job_id, lease), (other_id, _) = live.job(), live.job()
    following = Following(f"{live.url}/v1/jobs/{job_id}/events")
    following.await_lines(": still here", 3)
    with httpx.stream("GET", f"{live.url}/v1/jobs/{other_id}/events") as answer:
        lines = answer.iter_lines()  # let go of, it would close the connection
        next(lines)
        assert live.streams() == 2
        with httpx.stream("GET", f"{live.url}/v1/jobs/{job_id}/events") as answer:
            assert answer.status_code == 429  # the body of an accepted stream would never end
            answer.read()
            refusal(answer, 429, "too-many-streams")
    wait_for(lambda: live.streams() == 1, "the place is free", timeout_s=10)
    live.catalogue.jobs.complete(lease, "r" * 64)
    following.join(10)
    assert following.said("event:") == ["progress", "end"]


def test_a_job_that_is_destroyed_and_a_server_that_stops_end_their_streams(live: Live) -> None:
    (job_id, _), (other_id, _) = live.job(), live.job()
    both = [Following(f"{live.url}/v1/jobs/{one}/events") for one in (job_id, other_id)]
    for one in both:
        one.await_lines("event:", 1)
    live.catalogue.uws.destroy(job_id)
    both[0].join(10)
    assert both[0].said("event:") == ["progress", "gone"]
    with pytest.raises(ServiceError, match="expected the id of one of your jobs"):
        list(live.client.follow(f"/v1/jobs/{job_id}"))
    live.app.state.stopping = True
    both[1].join(10)
    assert not both[1].is_alive() and both[1].said("event:") == ["progress"]


def test_a_bulk_is_followed(live: Live) -> None:
    row = BulkRow(
        id=new_id(), owner=DEFAULT_OWNER, name="", phase=BulkPhase.RUNNING, request={}, request_key="k",
        psf_id="p" * 64, created_at=time.time(), running_since=time.time(), listed=True,
    )  # fmt: skip
    bulk_id = live.catalogue.bulks.create(row, ["a" * 64, "b" * 64])[0].id
    following = Following(f"{live.url}/v1/bulk/{bulk_id}/events")
    following.await_lines("data:", 1)
    assert '"total":2' in following.said("data:")[0]
    live.client.pause_bulk(bulk_id)
    following.await_lines("data:", 2)
    assert live.client.wait_for_bulk(bulk_id)["phase"] == "PAUSED", "nobody waits for what does not go on"
    live.client.cancel_bulk(bulk_id)
    following.join(10)
    assert following.said("event:") == ["progress", "progress", "end"]


def test_a_stream_ends_after_its_time_and_can_be_continued(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "LOOK_EVERY_S", 0.02)
    with TestClient(create_app(settings.model_copy(update={"stream_s": 0.2}))) as api:
        catalogue = api.app.state.heliopsf.catalogue
        job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
        said = api.get(f"/v1/jobs/{job.id}/events").text
        assert said.count("event: progress") == 1 and "event: end" not in said
        known = said.split("id: ")[1].split()[0]
        assert "event:" not in api.get(f"/v1/jobs/{job.id}/events", headers={"Last-Event-ID": known}).text


def test_a_stream_ends_with_its_key(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "LOOK_EVERY_S", 0.02)
    with keyed(settings, stream_s=10.0) as service:  # guards against a hang
        for how, change in (("revoked", {"revoked_at": 1.0}), ("expired", {"expires_at": 1.0})):
            key = service.key("ann")
            job, _ = service.catalogue.jobs.submit("psf-build", {}, how, "ann")
            end = update(KeyRow).where(KeyRow.id == key.split("_")[1]).values(**change)
            get, looks = service.catalogue.jobs.get, []

            def look(job_id: str, get: Any = get, looks: list[str] = looks, end: Any = end) -> JobRow | None:
                looks.append(job_id)
                if len(looks) == 5:  # the stream is open and has sent an event
                    execute(service.catalogue, end)
                row: JobRow | None = get(job_id)
                return row

            with monkeypatch.context() as patched:
                patched.setattr(service.catalogue.jobs, "get", look)
                said = service.api.get(f"/v1/jobs/{job.id}/events", headers=bearer(key))
            assert said.status_code == 200 and len(looks) == 5
            assert said.text.count("event: progress") == 1 and "event: end" not in said.text
            refused = service.api.get(f"/v1/jobs/{job.id}/events", headers=bearer(key))
            refusal(refused, 401, f"key-{how}")
