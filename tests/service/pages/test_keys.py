"""The page of keys, by plain forms."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from tests.service.keyed import Keyed, bearer, keyed
from tests.service.pages.test_login import OWN_PAGE, browser
from workers.catalogue.access import Scope
from workers.settings import Settings


@pytest.fixture
def service(settings: Settings) -> Iterator[Keyed]:
    with keyed(settings) as running:
        yield running


def test_a_key_is_made_shown_once_and_revoked(service: Keyed) -> None:
    client = browser(service, service.key("ann"))
    data = {"scopes": ["read", "submit"], "label": "cluster <1>", "lasts_days": "30", "owner": "ann"}
    answer = client.post("/keys", data=data, headers=OWN_PAGE)
    assert answer.status_code == 201 and answer.headers["Cache-Control"] == "no-store"
    (key,) = re.findall(r">(hpsf_[^<]+)</textarea>", answer.text)
    assert "cluster &lt;1&gt;" in answer.text and "cluster <1>" not in answer.text
    assert service.api.get("/v1/jobs", headers=bearer(key)).status_code == 200
    listed = client.get("/keys").text
    identity = key.split("_")[1]
    assert identity in listed and key.split("_", 2)[2] not in listed and "your login" in listed
    revoked = client.post(f"/keys/{identity}/revoke", headers=OWN_PAGE)
    assert revoked.status_code == 303 and revoked.headers["location"] == "/keys"
    assert service.api.get("/v1/jobs", headers=bearer(key)).status_code == 401


def test_revoking_the_key_of_the_login_ends_the_login(service: Keyed) -> None:
    key = service.key("ann")
    client = browser(service, key)
    made = client.post("/keys", data={"scopes": "read"}, headers=OWN_PAGE)
    (other,) = re.findall(r">(hpsf_[^<]+)</textarea>", made.text)
    data = {"and_made": "true"}
    client.post(f"/keys/{key.split('_')[1]}/revoke", data=data, headers=OWN_PAGE)
    assert client.get("/keys").headers["location"].startswith("/login")
    assert service.api.get("/v1/jobs", headers=bearer(other)).status_code == 401


def test_what_cannot_be_made_is_told_on_a_page(subtests: pytest.Subtests, service: Keyed) -> None:
    client = browser(service, service.key("ann"))
    for data, told in (
        ({}, "at least one scope"),
        ({"scopes": "everything"}, "at least one scope"),
        ({"scopes": "read", "lasts_days": "-1"}, "a lifetime"),
        ({"scopes": "read", "lasts_days": "soon"}, "a lifetime"),
        ({"scopes": "read", "owner": "A B"}, "an owner"),
        ({"scopes": "admin"}, "scopes of your own key"),
        ({"scopes": "read", "owner": "bob"}, "your own name"),
    ):
        with subtests.test(str((data, told))):
            answer = client.post("/keys", data=data, headers=OWN_PAGE)
            assert answer.status_code in (403, 422) and told in answer.text
            assert answer.headers["content-type"].startswith("text/html")
            assert len(service.catalogue.keys.all()) == 1


def test_a_reader_sees_keys_and_can_change_none(service: Keyed) -> None:
    page = browser(service, service.key("ann", Scope.READ)).get("/keys")
    assert page.status_code == 200 and 'action="/keys"' not in page.text and "/revoke" not in page.text


def test_an_administrator_sees_and_makes_keys_of_others(service: Keyed) -> None:
    service.key("ann")
    client = browser(service, service.key("root", *Scope))
    everybody = client.get("/keys?owner=*").text
    assert "<td>ann</td>" in everybody and "<td>root</td>" in everybody
    made = client.post("/keys", data={"scopes": "bulk", "owner": "ann"}, headers=OWN_PAGE)
    assert made.status_code == 201 and "Keys of ann" in made.text
    owned = {row.owner: row.scopes for row in service.catalogue.keys.page("ann", limit=1)}
    assert owned == {"ann": ["bulk"]}
    assert browser(service, service.key("bob")).get("/keys?owner=ann").status_code == 403


def test_an_open_service_uses_no_keys(settings: Settings) -> None:
    with TestClient(create_app(settings)) as api:
        assert "keys are not used" in api.get("/keys").text
        assert api.post("/keys", data={"scopes": "read"}).status_code == 409
