"""Keys over HTTP: who makes, sees and revokes which."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.conftest import SMALL_INSTRUMENT
from tests.service.conftest import refusal
from tests.service.keyed import Keyed, bearer, keyed
from tests.whole.stack import wait_for
from workers.catalogue.access import Scope
from workers.settings import Settings

DAY_S = 86_400


def made(client: TestClient, **body: Any) -> dict[str, Any]:
    answer = client.post("/v1/keys", json={"scopes": ["read"]} | body)
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    return found


def refused(client: TestClient, status: int, code: str, **body: Any) -> None:
    refusal(client.post("/v1/keys", json={"scopes": ["read"]} | body), status, code)


def test_a_key_makes_a_key_that_is_shown_once(service: Keyed) -> None:
    ann = service.client("ann")
    answer = ann.post("/v1/keys", json={"scopes": ["read", "read"], "label": "laptop", "lasts_days": 2})
    assert answer.status_code == 201 and answer.headers["Cache-Control"] == "no-store"
    new = answer.json()
    assert (new["owner"], new["scopes"], new["label"], new["state"]) == ("ann", ["read"], "laptop", "valid")
    assert new["expires_at"] == pytest.approx(time.time() + 2 * DAY_S, abs=60)
    shown = ann.get(answer.headers["Location"]).json()
    assert shown == {name: value for name, value in new.items() if name != "key"} | {
        "last_used_at": shown["last_used_at"]
    }
    listed = ann.get("/v1/keys")
    assert [one["id"] for one in listed.json()["items"]] == [new["id"], new["made_by"]]
    assert new["key"].split("_", 2)[2] not in listed.text
    with_it = service.api.get("/v1/keys", headers=bearer(new["key"]))
    assert with_it.status_code == 200
    assert service.api.post("/v1/keys", json={}, headers=bearer(new["key"])).status_code == 403


def test_a_key_gives_no_more_than_it_has(service: Keyed) -> None:
    ann = service.client("ann", Scope.READ, Scope.SUBMIT)
    for scope in (Scope.ADMIN, Scope.BULK, Scope.CERTIFY):
        refused(ann, 403, "scope-missing", scopes=["read", scope])
    refused(ann, 403, "scope-missing", owner="bob")
    assert ann.post("/v1/keys", json={"scopes": ["read"]}, headers={"X-Owner": "bob"}).status_code == 403
    assert made(ann, owner="ann")["owner"] == "ann"


def test_a_key_does_not_outlive_its_maker(service: Keyed) -> None:
    short = TestClient(service.api.app, headers=bearer(service.key("ann", lasts_s=DAY_S)))
    assert made(short)["expires_at"] == pytest.approx(time.time() + DAY_S, abs=60)
    assert made(short, lasts_days=0.5)["expires_at"] == pytest.approx(time.time() + DAY_S / 2, abs=60)
    refused(short, 403, "outlives-its-maker", lasts_days=2)
    refused(short, 403, "outlives-its-maker", expires_at=time.time() + 2 * DAY_S)
    refused(short, 422, "end-in-the-past", expires_at=time.time() - 1)
    assert made(service.client("ann"))["expires_at"] is None


def test_an_administrator_is_bound_by_none_of_this(service: Keyed) -> None:
    key = service.catalogue.keys.make(
        "root", {Scope.ADMIN, Scope.READ, Scope.SUBMIT}, expires_at=time.time() + DAY_S
    )
    root = TestClient(service.api.app, headers=bearer(key))
    new = made(root, owner="ann", scopes=["bulk"], lasts_days=400)
    assert new["owner"] == "ann" and new["scopes"] == ["bulk"]
    assert {one["owner"] for one in root.get("/v1/keys?owner=*").json()["items"]} == {"ann", "root"}
    assert [one["id"] for one in root.get("/v1/keys?owner=ann").json()["items"]] == [new["id"]]
    assert root.delete(f"/v1/keys/{new['id']}").json()["state"] == "revoked"
    for owner in ("bob", "*"):
        assert service.client("ann").get("/v1/keys", params={"owner": owner}).status_code == 403


def test_wrong_requests_make_nothing(service: Keyed) -> None:
    root = service.client("root", *Scope)
    for body in (
        {"scopes": []},
        {"scopes": ["read"], "lasts_days": 1, "expires_at": 9e9},
        {"scopes": ["read"], "expires_at": 1e300},
        {"scopes": ["read"], "owner": "A B"},
        {"scopes": ["read"], "days": 3},
    ):
        answer = root.post("/v1/keys", json=body)
        assert answer.status_code == 422, (body, answer.text)
    assert len(service.catalogue.keys.all()) == 1


def test_a_key_is_not_revoked_by_one_that_allows_less(service: Keyed) -> None:
    strong, weak = service.client("ann"), service.client("ann", Scope.READ, Scope.SUBMIT)
    both = {row.id: set(row.scopes) for row in service.catalogue.keys.all()}
    strongest = max(both, key=lambda identity: len(both[identity]))
    assert weak.delete(f"/v1/keys/{strongest}").status_code == 403
    assert strong.get("/v1/jobs").status_code == 200


def test_a_stolen_key_goes_with_what_was_made_with_it(service: Keyed) -> None:
    ann = service.client("ann")
    first = made(ann, scopes=["read", "submit"])
    thief = TestClient(service.api.app, headers=bearer(first["key"]))
    second = made(thief)
    assert ann.delete(f"/v1/keys/{first['id']}").json()["state"] == "revoked"
    assert ann.get(f"/v1/keys/{second['id']}").json()["state"] == "valid"
    ann.delete(f"/v1/keys/{first['id']}?and_made=true")
    assert service.api.get("/v1/jobs", headers=bearer(second["key"])).status_code == 401


def test_an_owner_makes_a_bounded_number(service: Keyed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.api.keys.MOST_KEYS", 3)
    ann = service.client("ann")
    ids = [made(ann)["id"] for _ in range(2)]
    refused(ann, 409, "too-many-keys")
    ann.delete(f"/v1/keys/{ids[0]}")
    made(ann)


@pytest.mark.usefixtures("one_minute")
def test_keys_count_as_submissions(settings: Settings) -> None:
    with keyed(settings, submissions_per_minute=2) as service:
        ann = service.client("ann")
        tried = [ann.post("/v1/keys", json={"scopes": ["read"]}).status_code for _ in range(3)]
        assert tried == [201, 201, 429]


def test_an_open_service_uses_no_keys(shared_api: TestClient) -> None:
    one = "/v1/keys/" + 16 * "0"
    for method, address in (("GET", "/v1/keys"), ("POST", "/v1/keys"), ("GET", one), ("DELETE", one)):
        body: dict[str, Any] = {"json": {"scopes": ["read"]}} if method == "POST" else {}
        refusal(shared_api.request(method, address, **body), 409, "keys-not-used")


def test_the_stream_of_a_session_ends_with_it(service: Keyed) -> None:
    psf_job = {"kind": "psf-build", "parameters": {"instrument_file": SMALL_INSTRUMENT, "size": 128}}
    client = TestClient(service.api.app, headers={"Sec-Fetch-Site": "same-origin"})
    client.post("/login", data={"key": service.key("ann")}, follow_redirects=False)
    job_id = client.post("/v1/jobs", json=psf_job).raise_for_status().json()["id"]
    got: list[str] = []

    def follow() -> None:
        got.append(client.get(f"/v1/jobs/{job_id}/events").text)

    thread = threading.Thread(target=follow)
    thread.start()
    streams = service.api.app.state.heliopsf.streams
    wait_for(lambda: streams.total() == 1, "the stream is open", timeout_s=20)
    assert thread.is_alive(), "the job waits, so the stream stays open"
    assert client.post("/logout", follow_redirects=False).status_code == 303
    thread.join(20)
    assert len(got) == 1, "it would last an hour"
    assert streams.total() == 0
