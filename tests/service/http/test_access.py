"""Keys and scopes: who is let in, to what, and what a server asks for before it listens."""

from __future__ import annotations

import base64
import hashlib
import json
import logging
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from sqlalchemy import inspect

from service.cli.main import main
from service.client.http import Client, ServiceError
from service.http.state import Access, check_can_serve
from tests.service.conftest import upload
from tests.service.keyed import Keyed, bearer
from workers.catalogue.access import KeyRefused, Keys, Scope
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import KeyRow
from workers.settings import Settings

OPEN_TO_ALL = {"/healthz", "/readyz", "/docs", "/openapi.json"}
# Clients read these before they know how to log in.
OPEN_TO_ALL |= {"/vo/availability", "/vo/capabilities", "/vo/tables"}


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
    assert keys.all()[0].last_used_at is None
    assert keys.check(good).owner == "ann"
    used_at = keys.all()[0].last_used_at
    assert used_at is not None and abs(used_at - time.time()) < 5
    keys.check(good)
    assert keys.all()[0].last_used_at == used_at, "its use is noted once a minute"
    late = keys.make("ann", {Scope.READ}, expires_at=time.time() - 1)
    assert keys.revoke(other.split("_")[1]) and not keys.revoke("0" * 16)
    revoked_at = keys.all()[1].revoked_at
    assert keys.revoke(other.split("_")[1]) and keys.all()[1].revoked_at == revoked_at, "once is enough"
    mixed = good[:21] + "_" + other.split("_", 2)[2]
    codes = {late: "key-expired", other: "key-revoked"}
    unknown = "hpsf_" + "0" * 16 + "_" + "a" * 43
    for key in (late, other, mixed, good + "x", good[:-1], "", good.upper(), unknown):
        with pytest.raises(KeyRefused) as refused:
            keys.check(key)
        assert refused.value.code == codes.get(key, "bad-key")
        assert good.split("_", 2)[2] not in refused.value.message
    for owner in ("", "Ann", "a b", "../x", "a" * 65, "-x", "ann\n"):
        with pytest.raises(ValueError, match="expected an owner"):
            keys.make(owner, {Scope.READ})


# Routes ---------------------------------------------------------------------------------------------


def test_each_route_wants_a_key_of_the_right_scope(shared_service: Keyed) -> None:
    """Every method and address of the description, asked with ids that name nothing: without a key, with an expired
    key, and with a key of each single scope that is not the one it needs."""
    api = shared_service.api
    expired = shared_service.key("ann", lasts_s=-1)
    keys = {scope: bearer(shared_service.key("ann", scope)) for scope in Scope}
    operations = 0
    for path, methods in api.get("/openapi.json").json()["paths"].items():
        address = re.sub(r"\{\w+\}", "0" * 32, path)
        for method, operation in methods.items():
            here = (method, path)
            scopes = {scope for way in operation.get("security", []) for one in way.values() for scope in one}
            if path in OPEN_TO_ALL:
                assert scopes == set(), here
                assert api.get(path).status_code == (503 if path == "/readyz" else 200), (
                    "no worker: told to anybody"
                )
                continue
            operations += 1
            (scope,) = scopes
            if path == "/metrics":
                assert scope == "admin"
            else:
                writing = {"submit", "certify", "bulk", "admin"}
                assert scope in ({"read"} if method == "get" else writing), here
            for headers in ({}, bearer(expired)):
                answer = api.request(method, address, headers=headers)
                assert answer.status_code == 401, (here, answer.text)
                assert answer.headers["WWW-Authenticate"].startswith("Bearer"), here
                assert expired.split("_", 2)[2] not in answer.text, here
            for other in set(Scope) - {scope}:
                answer = api.request(method, address, headers=keys[other])
                assert answer.status_code == 403, (other, here, answer.text)
                assert method == "head" or scope in answer.text, here  # its answer has no body
    assert operations > 40
    assert api.get("/metrics", headers=keys[Scope.ADMIN]).status_code == 200


def test_a_key_goes_as_a_bearer_token_or_as_a_password(shared_service: Keyed) -> None:
    api, key, revoked = shared_service.api, shared_service.key("ann"), shared_service.key("ann")
    shared_service.catalogue.keys.revoke(revoked.split("_")[1])
    for headers in (bearer(key), {"Authorization": f"bearer  {key}"}, basic(key), basic(key, user="")):
        assert api.get("/v1/jobs", headers=headers).status_code == 200
    broken = (
        {"Authorization": "Basic %%%"},
        {"Authorization": "Digest x"},
        {"Authorization": b"Basic \xff\xfe"},
        bearer("nonsense"),
        basic("nonsense"),
    )
    for headers in (*broken, bearer(revoked), basic(revoked)):
        assert api.get("/v1/jobs", headers=headers).status_code == 401
    assert api.get(f"/v1/jobs?key={key}").status_code == 401, "an address is no place for a key"


def test_no_key_is_in_a_log_or_an_answer(
    shared_service: Keyed, caplog: pytest.LogCaptureFixture, image_file: Path
) -> None:
    caplog.set_level(logging.DEBUG)
    client = shared_service.client("ann")
    secret = str(client.headers["Authorization"]).split("_", 2)[2]
    upload(client, image_file)
    texts = [client.get(a).text for a in ("/v1/images", "/v1/jobs/zzz", "/nowhere", "/uws/jobs")]
    assert secret not in "".join(texts)
    told = [f"{record.getMessage()} {record.__dict__}" for record in caplog.records]
    assert any("ann" in line for line in told), "whose request it was is known"
    assert not [line for line in told if secret in line]


# Who may serve --------------------------------------------------------------------------------------


def test_open_only_where_this_machine_alone_asks(settings: Settings) -> None:
    for bound_to, access, keys_needed in (
        ("127.0.0.2", None, False),
        ("::1", None, False),
        ("localhost", None, False),
        ("0.0.0.0", None, True),
        ("::", None, True),
        ("192.0.2.7", None, True),
        ("localhost.example.org", None, True),
        ("127.0.0.1", "keys", True),
        ("0.0.0.0", "open", False),
    ):
        asks = Access.of(settings.model_copy(update={"access": access}), bound_to)
        assert asks.keys == keys_needed, (bound_to, access)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """A command on the data of the service of this test."""
    for name in ("ACCESS", "KEY", "DATABASE_URL", "BROKER_URL"):
        monkeypatch.delenv(f"HELIOPSF_{name}", raising=False)
    return lambda *words: CliRunner().invoke(main, [*words, "--data", str(tmp_path / "data")])


def test_a_service_that_others_reach_does_not_start_without_a_key(run: Callable[..., Result]) -> None:
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


def test_keys_are_made_listed_and_revoked_by_command(run: Callable[..., Result], service: Keyed) -> None:
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
        ("--owner", "a", "--label", "\u202e"),
    ):
        assert run("key", "create", *wrong).exit_code == 2


def test_client_and_commands_take_a_key_and_never_show_it(
    shared_service: Keyed, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = shared_service.key("clients")
    transport = shared_service.api._transport
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
    assert seen == [key]
