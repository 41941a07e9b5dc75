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
    wait_for(lambda: len(first.said("id:")) == 1, "an event", timeout_s=10)
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


def test_an_idle_stream_sends_comments(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "ALIVE_EVERY_S", 0.1)
    job_id, lease = live.job()
    following = Following(f"{live.url}/v1/jobs/{job_id}/events")
    wait_for(lambda: len(following.said(": still here")) >= 3, "it says so again and again", timeout_s=10)
    live.catalogue.jobs.complete(lease, "r" * 64)
    following.join(10)
    assert following.said("event:") == ["progress", "end"]


def test_the_number_of_streams_per_caller_is_limited(live: Live) -> None:
    (job_id, lease), (other_id, _) = live.job(), live.job()
    both = [Following(f"{live.url}/v1/jobs/{one}/events") for one in (job_id, other_id)]
    wait_for(lambda: all(one.said("event:") for one in both), "two are open", timeout_s=10)
    refused = httpx.get(f"{live.url}/v1/jobs/{job_id}/events")
    assert refused.status_code == 429 and refused.json()["type"] == "urn:heliopsf:too-many-streams"
    live.catalogue.jobs.complete(lease, "r" * 64)
    both[0].join(10)
    assert httpx.get(f"{live.url}/v1/jobs/{job_id}/events").status_code == 200


def test_a_closed_connection_frees_its_stream(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "ALIVE_EVERY_S", 0.1)
    job_id, _ = live.job()
    with httpx.stream("GET", f"{live.url}/v1/jobs/{job_id}/events") as answer:
        lines = answer.iter_lines()  # let go of, it would close the connection
        next(lines)
        assert live.streams() == 1
    wait_for(lambda: live.streams() == 0, "the place is free", timeout_s=10)


def test_a_job_that_is_destroyed_ends_its_stream(live: Live) -> None:
    job_id, _ = live.job()
    following = Following(f"{live.url}/v1/jobs/{job_id}/events")
    wait_for(lambda: bool(following.said("event:")), "an event", timeout_s=10)
    live.catalogue.uws.destroy(job_id)
    following.join(10)
    assert following.said("event:") == ["progress", "gone"]
    with pytest.raises(ServiceError, match="expected the id of one of your jobs"):
        list(live.client.follow(f"/v1/jobs/{job_id}"))


def test_a_server_that_stops_ends_its_streams(live: Live) -> None:
    job_id, _ = live.job()
    following = Following(f"{live.url}/v1/jobs/{job_id}/events")
    wait_for(lambda: bool(following.said("event:")), "an event", timeout_s=10)
    live.app.state.stopping = True
    following.join(5)
    assert not following.is_alive() and following.said("event:") == ["progress"]


def test_a_bulk_is_followed(live: Live) -> None:
    row = BulkRow(
        id=new_id(), owner=DEFAULT_OWNER, name="", phase=BulkPhase.RUNNING, request={}, request_key="k",
        psf_id="p" * 64, created_at=time.time(), running_since=time.time(), listed=True,
    )  # fmt: skip
    bulk_id = live.catalogue.bulks.create(row, ["a" * 64, "b" * 64])[0].id
    following = Following(f"{live.url}/v1/bulk/{bulk_id}/events")
    wait_for(lambda: bool(following.said("data:")), "an event", timeout_s=10)
    assert '"total":2' in following.said("data:")[0]
    live.client.pause_bulk(bulk_id)
    wait_for(lambda: len(following.said("data:")) == 2, "the next", timeout_s=10)
    assert live.client.wait_for_bulk(bulk_id)["phase"] == "PAUSED", "nobody waits for what does not go on"
    live.client.cancel_bulk(bulk_id)
    following.join(10)
    assert following.said("event:") == ["progress", "progress", "end"]


def test_a_stream_ends_after_its_time_and_can_be_continued(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "LOOK_EVERY_S", 0.02)
    with TestClient(create_app(settings.model_copy(update={"stream_s": 0.2}))) as api:
        catalogue = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]
        job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
        said = api.get(f"/v1/jobs/{job.id}/events").text
        assert said.count("event: progress") == 1 and "event: end" not in said
        known = said.split("id: ")[1].split()[0]
        assert "event:" not in api.get(f"/v1/jobs/{job.id}/events", headers={"Last-Event-ID": known}).text


@pytest.mark.parametrize("how", ["revoked", "expired"])
def test_a_stream_ends_with_its_key(settings: Settings, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    monkeypatch.setattr(events, "LOOK_EVERY_S", 0.02)
    with keyed(settings, stream_s=10.0) as service:  # guards against a hang
        key = service.key("ann")
        identity = key.split("_")[1]
        job, _ = service.catalogue.jobs.submit("psf-build", {}, "k", "ann")
        end = update(KeyRow).where(KeyRow.id == identity)
        end = end.values(revoked_at=1.0) if how == "revoked" else end.values(expires_at=1.0)
        get, looks = service.catalogue.jobs.get, 0

        def look(job_id: str) -> JobRow | None:
            nonlocal looks
            looks += 1
            if looks == 5:  # the stream is open and has sent an event
                service.catalogue._database.change(end)
            return get(job_id)

        monkeypatch.setattr(service.catalogue.jobs, "get", look)
        said = service.api.get(f"/v1/jobs/{job.id}/events", headers=bearer(key))
        assert said.status_code == 200 and looks == 5
        assert said.text.count("event: progress") == 1 and "event: end" not in said.text
        refused = service.api.get(f"/v1/jobs/{job.id}/events", headers=bearer(key))
        assert (refused.status_code, refused.json()["type"]) == (401, f"urn:heliopsf:key-{how}")


def test_an_owner_follows_nothing_of_another_s(settings: Settings) -> None:
    with keyed(settings) as service:
        job, _ = service.catalogue.jobs.submit("psf-build", {}, "k", "ann")
        for identity in (job.id, "0" * 32):
            refused = service.client("bob").get(f"/v1/jobs/{identity}/events")
            assert refused.status_code == 404 and refused.json()["type"] == "urn:heliopsf:no-such-job"
            refused = service.client("bob").get(f"/v1/bulk/{identity}/events")
            assert refused.status_code == 404 and refused.json()["type"] == "urn:heliopsf:no-such-bulk"
