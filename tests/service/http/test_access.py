"""Keys and scopes: who is let in, to what, and what a server asks for before it listens."""

from __future__ import annotations

import base64
import hashlib
import json
import logging
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from fastapi.testclient import TestClient
from sqlalchemy import inspect

from service.app import create_app
from service.cli.main import main
from service.client.http import Client, ServiceError
from service.http.access import check_can_serve
from tests.service.conftest import upload
from tests.service.keyed import Keyed, bearer, keyed
from workers.catalogue.access.keys import KeyRefused, Keys, Scope
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import KeyRow
from workers.settings import Settings

OPEN_TO_ALL = {
    *("/healthz", "/readyz", "/docs", "/openapi.json"),
    *(
        "/vo/availability",
        "/vo/capabilities",
        "/vo/tables",
    ),  # clients read them before they know how to log in
}


@pytest.fixture
def service(settings: Settings) -> Iterator[Keyed]:
    with keyed(settings) as running:
        yield running


@pytest.fixture
def keys(tmp_path: Path) -> Iterator[Keys]:
    catalogue = Catalogue(f"sqlite:///{tmp_path / 'c.sqlite'}")
    catalogue.upgrade()
    yield catalogue.keys
    catalogue.close()


def basic(password: str, user: str = "anybody") -> dict[str, str]:
    return {"Authorization": "Basic " + base64.b64encode(f"{user}:{password}".encode()).decode()}


# Keys -----------------------------------------------------------------------------------------------


def test_of_a_key_only_a_hash_is_kept(keys: Keys) -> None:
    made = [keys.make("ann", {Scope.READ}) for _ in range(2)]
    secrets = [key.split("_", 2)[2] for key in made]
    assert all(re.fullmatch(r"hpsf_[0-9a-f]{16}_[\w-]{43}", key) for key in made) and len(set(secrets)) == 2
    for row, secret in zip(keys.all(), secrets, strict=True):
        values = {column.key: getattr(row, column.key) for column in inspect(KeyRow).columns}
        assert secret not in repr(values)
        assert values["secret_sha256"] == hashlib.sha256(secret.encode()).hexdigest()


def test_a_key_that_is_not_good_lets_nobody_in(keys: Keys) -> None:
    good, other = keys.make("ann", {Scope.READ}), keys.make("ann", {Scope.READ})
    assert keys.check(good).owner == "ann"
    late = keys.make("ann", {Scope.READ}, expires_at=time.time() - 1)
    assert keys.revoke(other.split("_")[1]) and not keys.revoke("0" * 16)
    revoked_at = keys.all()[1].revoked_at
    assert keys.revoke(other.split("_")[1]) and keys.all()[1].revoked_at == revoked_at, "once is enough"
    mixed = good[:21] + "_" + other.split("_", 2)[2]
    longer, shorter, no_key = good + "x", good[:-1], ""
    wanted = {late: "key-expired", other: "key-revoked"}
    for key in (
        late,
        other,
        mixed,
        longer,
        shorter,
        no_key,
        good.upper(),
        "hpsf_" + "0" * 16 + "_" + "a" * 43,
    ):
        with pytest.raises(KeyRefused) as refused:
            keys.check(key)
        assert refused.value.code == wanted.get(key, "bad-key")
        assert good.split("_", 2)[2] not in refused.value.message


def test_its_use_is_noted_once_a_minute(keys: Keys) -> None:
    key = keys.make("ann", {Scope.READ})
    assert keys.all()[0].last_used_at is None
    keys.check(key)
    noted = keys.all()[0].last_used_at
    assert noted is not None and abs(noted - time.time()) < 5
    keys.check(key)
    assert keys.all()[0].last_used_at == noted


@pytest.mark.parametrize("owner", ["", "Ann", "a b", "../x", "a" * 65, "-x", "ann\n"])
def test_owners_that_cannot_be(keys: Keys, owner: str) -> None:
    with pytest.raises(ValueError, match="expected an owner"):
        keys.make(owner, {Scope.READ})


# Routes ---------------------------------------------------------------------------------------------


def addresses(api: TestClient) -> list[tuple[str, str]]:
    """Every method and address, with ids filled in that name nothing."""
    found = []
    for path, operations in api.get("/openapi.json").json()["paths"].items():
        found += [(method.upper(), re.sub(r"\{\w+\}", "0" * 32, path)) for method in operations]
    return [one for one in found if one[1] not in OPEN_TO_ALL]


def test_no_route_answers_without_a_key_or_with_a_bad_one(service: Keyed) -> None:
    expired = service.key("ann", lasts_s=-1)
    revoked = service.key("ann")
    service.catalogue.keys.revoke(revoked.split("_")[1])
    asked = addresses(service.api)
    assert len(asked) > 40
    sent = [
        {},
        bearer("nonsense"),
        basic("nonsense"),
        bearer(expired),
        bearer(revoked),
        {"Authorization": "Digest x"},
    ]
    for method, address in asked:
        for headers in sent:
            answer = service.api.request(method, address, headers=headers)
            assert answer.status_code == 401, (method, address, headers, answer.text)
            assert answer.headers["WWW-Authenticate"].startswith("Bearer"), (method, address)
            assert expired.split("_", 2)[2] not in answer.text


def test_every_route_says_which_scope_it_needs(service: Keyed) -> None:
    description = service.api.get("/openapi.json").json()
    for path, operations in description["paths"].items():
        for method, operation in operations.items():
            scopes = {scope for way in operation.get("security", []) for s in way.values() for scope in s}
            if path in OPEN_TO_ALL:
                assert scopes == set()
                continue
            assert len(scopes) == 1, (method, path)
            if path == "/metrics":
                assert scopes == {"admin"}
            elif method == "get":
                assert scopes == {"read"}, (method, path)
            else:
                assert scopes & {"submit", "certify", "bulk", "admin"}, (method, path)


def test_a_key_without_the_scope_is_refused_and_told_which(service: Keyed) -> None:
    for scope in Scope:
        client = service.client("ann", scope)
        for path, operations in service.api.get("/openapi.json").json()["paths"].items():
            for method, operation in operations.items():
                needed = {s for way in operation.get("security", []) for one in way.values() for s in one}
                if needed and scope not in needed:
                    answer = client.request(method, re.sub(r"\{\w+\}", "0" * 32, path))
                    assert answer.status_code == 403, (scope, method, path, answer.text)
                    if method != "head":  # its answer has no body
                        assert needed.pop() in answer.text


def test_a_key_goes_as_a_bearer_token_or_as_a_password(service: Keyed) -> None:
    key = service.key("ann")
    for headers in (bearer(key), {"Authorization": f"bearer  {key}"}, basic(key), basic(key, user="")):
        assert service.api.get("/v1/jobs", headers=headers).status_code == 200
    broken = {"Authorization": "Basic %%%"}
    assert service.api.get("/v1/jobs", headers=broken).status_code == 401
    assert service.api.get(f"/v1/jobs?key={key}").status_code == 401, "an address is no place for a key"


def test_what_anybody_may_see(service: Keyed) -> None:
    for address in OPEN_TO_ALL - {"/readyz"}:
        assert service.api.get(address).status_code == 200
    assert service.api.get("/readyz").status_code == 503  # there is no worker, and that is said to anybody


def test_metrics_are_the_administrators(service: Keyed) -> None:
    assert service.client("ann").get("/metrics").status_code == 403
    assert service.client("root", Scope.ADMIN).get("/metrics").status_code == 200


def test_no_key_is_in_a_log_or_an_answer(
    service: Keyed, caplog: pytest.LogCaptureFixture, image_file: Path
) -> None:
    caplog.set_level(logging.DEBUG)
    client = service.client("ann")
    secret = str(client.headers["Authorization"]).split("_", 2)[2]
    upload(client, image_file)
    texts = [client.get(a).text for a in ("/v1/images", "/v1/jobs/zzz", "/nowhere", "/uws/jobs")]
    assert secret not in "".join(texts)
    told = [f"{record.getMessage()} {record.__dict__}" for record in caplog.records]
    assert any("ann" in line for line in told), "whose request it was is known"
    assert not [line for line in told if secret in line]


# Who may serve --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bound_to", "access", "keys_asked_for"),
    [
        ("127.0.0.1", None, False),
        ("127.0.0.2", None, False),
        ("::1", None, False),
        ("localhost", None, False),
        ("0.0.0.0", None, True),
        ("::", None, True),
        ("192.0.2.7", None, True),
        ("example.org", None, True),
        ("localhost.example.org", None, True),
        ("127.0.0.1", "keys", True),
        ("0.0.0.0", "open", False),
    ],
)
def test_open_only_where_this_machine_alone_asks(
    settings: Settings, bound_to: str, access: str | None, keys_asked_for: bool
) -> None:
    with TestClient(create_app(settings.model_copy(update={"access": access}), bound_to)) as api:
        assert api.get("/v1/jobs").status_code == (401 if keys_asked_for else 200)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    for name in ("ACCESS", "KEY", "DATABASE_URL", "BROKER_URL"):
        monkeypatch.delenv(f"HELIOPSF_{name}", raising=False)

    def command(*arguments: str) -> Result:
        return CliRunner().invoke(main, [*arguments, "--data", str(tmp_path / "data")])

    return command


def test_a_service_that_others_reach_does_not_start_without_a_key(run) -> None:  # type: ignore[no-untyped-def]
    refused = run("serve", "--host", "0.0.0.0", "--port", "0")
    assert refused.exit_code == 1 and "Traceback" not in refused.output
    assert "heliopsf key create --owner NAME" in refused.output and "127.0.0.1" in refused.output


def test_it_starts_with_one_or_where_the_operator_decided(settings: Settings) -> None:
    settings.data_dir.mkdir()
    catalogue = Catalogue(settings.catalogue_url)
    catalogue.upgrade()
    for access in ("keys", "open"):
        check_can_serve(settings.model_copy(update={"access": access}), "0.0.0.0", catalogue)
    catalogue.keys.make("ann", {Scope.READ})
    check_can_serve(settings, "0.0.0.0", catalogue)
    catalogue.close()


def test_keys_are_made_listed_and_revoked_by_command(run, service: Keyed) -> None:  # type: ignore[no-untyped-def]
    """In the folder of the running service, which takes notice at once."""
    made = run(
        "key", "create", "--owner", "ann", "--scope", "read", "--expires", "30d", "--label", "for tests"
    )
    assert made.exit_code == 0, made.output
    key = made.stdout.strip()
    assert service.api.get("/v1/jobs", headers=bearer(key)).status_code == 200
    assert service.api.post("/v1/jobs", headers=bearer(key)).status_code == 403
    (row,) = json.loads(run("key", "list", "--json").stdout)
    assert (row["owner"], row["scopes"], row["state"], row["label"]) == ("ann", ["read"], "good", "for tests")
    assert abs(row["expires_at"] - time.time() - 30 * 86_400) < 60
    listed = run("key", "list").stdout
    assert row["id"] in listed and key.split("_", 2)[2] not in listed + json.dumps(row)
    assert run("key", "revoke", row["id"]).exit_code == 0
    assert service.api.get("/v1/jobs", headers=bearer(key)).status_code == 401
    assert "revoked" in run("key", "list").stdout
    unknown = run("key", "revoke", "0" * 16)
    assert unknown.exit_code == 1 and "no key" in unknown.output
    for wrong in (
        ("--owner", "A B"),
        ("--owner", "a", "--expires", "soon"),
        ("--owner", "a", "--scope", "all"),
    ):
        assert run("key", "create", *wrong).exit_code == 2


def test_client_and_commands_take_a_key_and_never_show_it(
    service: Keyed, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = service.key("ann")
    transport = service.api._transport
    with Client("http://testserver", key=key, transport=transport) as client:
        assert list(client.psfs()) == []
    monkeypatch.setenv("HELIOPSF_KEY", f" {key}\n")
    with Client("http://testserver", transport=transport) as client:
        assert list(client.psfs()) == []
    monkeypatch.delenv("HELIOPSF_KEY")
    with Client("http://testserver", transport=transport) as client, pytest.raises(ServiceError) as refused:
        list(client.psfs())
    assert (refused.value.status, refused.value.code) == (401, "no-key")
    with pytest.raises(ServiceError) as malformed:
        Client("http://testserver", key="hpsf_s3cret\nX-Owner: bob")
    assert "s3cret" not in str(malformed.value)
    seen: list[str | None] = []
    monkeypatch.setattr(
        "service.client.http.Client.__init__", lambda self, server, key=None, **_: seen.append(key) or 1 / 0
    )
    CliRunner().invoke(main, ["psf", "list", "--key", key])
    monkeypatch.setenv("HELIOPSF_KEY", "from-the-environment")
    CliRunner().invoke(main, ["psf", "cutout", "0" * 64, "--size", "2", "-o", "x.fits"])
    assert seen == [key, "from-the-environment"]
