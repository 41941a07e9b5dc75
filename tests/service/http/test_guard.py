"""What holds for every request and answer: names of the host, other sites' pages, rates, bounds, headers."""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn
from fastapi.testclient import TestClient

from service.app import create_app
from service.http.access import Access
from service.pages import assets
from tests.service.conftest import upload
from tests.service.keyed import Keyed, bearer, keyed
from tests.whole.stack import Missing, Redis, free_port
from workers.settings import Settings


@pytest.fixture
def service(settings: Settings) -> Iterator[Keyed]:
    with keyed(settings) as running:
        yield running


# Hosts and other sites ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:8765", 200),
        ("localhost", 200),
        ("LOCALHOST:1", 200),
        ("[::1]:8765", 200),
        ("sun.example.org", 200),
        ("evil.example", 421),
        ("127.0.0.1.evil.example", 421),
        ("localhost.", 421),
        ("user@evil.example:80", 421),
        ("", 421),
        ("[::1", 421),
        ("a:b:c", 421),
    ],
)
def test_an_open_service_is_called_by_its_own_names(settings: Settings, host: str, status: int) -> None:
    named = settings.model_copy(update={"allowed_hosts": "sun.example.org, other.example"})
    with TestClient(create_app(named)) as api:
        for address in ("/v1/jobs", "/uws/jobs", "/healthz"):
            answer = api.get(address, headers={"Host": host})
            assert answer.status_code == status, answer.text
            if status == 421:
                assert answer.headers["content-type"] == "application/problem+json"


def test_with_keys_any_name_will_do_unless_some_are_named(settings: Settings) -> None:
    assert (
        Access.of(settings.model_copy(update={"access": "keys", "allowed_hosts": ""}), "0.0.0.0").hosts
        is None
    )
    named = Access.of(settings.model_copy(update={"access": "keys"}), "0.0.0.0").hosts
    assert named is not None and {"testserver", "127.0.0.1"} <= named
    assert Access.of(settings.model_copy(update={"allowed_hosts": "*"}), "127.0.0.1").hosts is None


@pytest.mark.parametrize(
    ("headers", "foreign"),
    [
        ({}, False),
        ({"Origin": "http://testserver"}, False),
        ({"Origin": "http://evil.example"}, True),
        ({"Origin": "http://testserver:81"}, True),
        ({"Origin": "null"}, True),
        ({"Sec-Fetch-Site": "cross-site"}, True),
        ({"Sec-Fetch-Site": "same-site", "Origin": "http://testserver"}, True),
        ({"Sec-Fetch-Site": "same-origin", "Origin": "https://testserver"}, False),
        ({"Sec-Fetch-Site": "none"}, False),
    ],
)
def test_a_page_of_another_site_changes_nothing(
    api: TestClient, headers: dict[str, str], foreign: bool
) -> None:
    for method, address in (
        ("POST", "/uws/jobs"),
        ("POST", "/v1/jobs"),
        ("POST", "/v1/images"),
        ("DELETE", "/v1/jobs/x"),
    ):
        answer = api.request(method, address, headers=headers)
        assert (answer.status_code == 403) == foreign, answer.text
        assert not foreign or answer.json()["type"] == "urn:heliopsf:cross-site"
    assert api.get("/v1/jobs", headers=headers).status_code == 200


@pytest.mark.parametrize(
    ("method", "headers", "status", "title", "code"),
    [
        ("GET", {"Host": "evil.example"}, 421, "This host name is not served", "host-not-served"),
        ("POST", {"Origin": "http://evil.example"}, 403, "This request came from another site", "cross-site"),
    ],
)
def test_a_refusal_is_a_page_for_browsers_and_json_for_programs(
    api: TestClient, method: str, headers: dict[str, str], status: int, title: str, code: str
) -> None:
    browser = headers | {"Accept": "text/html,application/xhtml+xml;q=0.9,*/*;q=0.8"}
    page = api.request(method, "/images/sample", headers=browser)
    assert page.status_code == status and page.headers["Content-Type"].startswith("text/html")
    assert f"<h1>{title}</h1>" in page.text and code in page.text and "Expected" in page.text
    assert "style-src 'self'" in page.headers["Content-Security-Policy"]
    assert ("To the images" in page.text) == (status == 403), "no link to a page that is refused too"
    for address, sent in (("/images/sample", headers), ("/v1/jobs", browser)):
        told = api.request(method, address, headers=sent)
        assert told.status_code == status
        assert told.headers["Content-Type"] == "application/problem+json"
        assert told.json()["type"] == f"urn:heliopsf:{code}"


def test_the_files_of_pages_are_served_under_any_name(api: TestClient) -> None:
    there = assets.address("heliopsf.css")
    assert api.get(there, headers={"Host": "evil.example"}).status_code == 200
    assert api.post(there, headers={"Host": "evil.example"}).status_code == 421


# Rates ----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("one_minute")
def test_each_caller_has_rates_of_its_own(settings: Settings) -> None:
    with keyed(settings, reads_per_minute=5, submissions_per_minute=3) as service:
        ann, bob = service.client("ann"), service.client("bob")
        for left in (4, 3, 2, 1, 0):
            answer = ann.get("/v1/jobs")
            assert answer.status_code == 200
            assert re.fullmatch(rf'"reads";r={left};t=\d+', answer.headers["RateLimit"])
            assert answer.headers["RateLimit-Policy"] == '"reads";q=5;w=60'
        refused = ann.get("/v1/jobs")
        assert refused.status_code == 429 and 1 <= int(refused.headers["Retry-After"]) <= 60
        assert refused.headers["content-type"] == "application/problem+json"
        assert (
            refused.json()["type"] == "urn:heliopsf:too-many-requests"
            and "5 requests" in refused.json()["detail"]
        )
        uws = ann.get("/uws/jobs")
        assert uws.status_code == 429 and "Retry-After" in uws.headers
        assert bob.get("/v1/jobs").status_code == 200, "another key"
        assert ann.get("/healthz").status_code == 200, "no rate limits"
        assert [ann.post("/v1/jobs", json={}).status_code for _ in range(4)] == [422, 422, 422, 429]


@pytest.mark.usefixtures("one_minute")
def test_who_tries_keys_is_not_let_try_without_end(settings: Settings) -> None:
    with keyed(settings, reads_per_minute=5) as service:
        tried = [service.api.get("/v1/jobs", headers=bearer(f"x{n}")).status_code for n in range(7)]
        assert tried == 5 * [401] + 2 * [429]
        assert service.client("ann").get("/v1/jobs").status_code == 200


@pytest.mark.usefixtures("one_minute")
def test_bytes_sent_in_are_counted(settings: Settings, image_file: Path) -> None:
    content = image_file.read_bytes() + bytes(600_000)
    with keyed(settings, upload_mib_per_minute=3) as service:
        ann = service.client("ann")
        chunked = (content[at : at + 50_000] for at in range(0, len(content), 50_000))
        assert ann.post("/v1/images", content=content).status_code == 201  # one MiB, as declared
        assert ann.post("/v1/images", content=chunked).status_code == 200  # one more, as it comes
        assert ann.post("/v1/images", content=content + bytes(2880)).status_code == 201
        for body in (content, iter([content])):
            refused = ann.post("/v1/images", content=body)
            assert refused.status_code == 429 and "3 MiB of uploads" in refused.json()["detail"]
        assert service.client("bob").post("/v1/images", content=content).status_code == 201
    assert list((settings.data_dir / "tmp").iterdir()) == []


def test_a_file_larger_than_a_minute_s_allowance_can_be_sent_all_the_same(
    settings: Settings, image_file: Path
) -> None:
    content = image_file.read_bytes() + bytes(1_500_000)
    with keyed(settings, upload_mib_per_minute=1) as service:
        assert service.client("ann").post("/v1/images", content=content).status_code == 201


def test_no_limits_where_they_are_zero(settings: Settings) -> None:
    with keyed(settings, reads_per_minute=0) as service:
        answer = service.client("ann").get("/v1/jobs")
        assert answer.status_code == 200 and "RateLimit" not in answer.headers


def test_rates_are_counted_in_redis_by_all_servers(settings: Settings, tmp_path: Path) -> None:
    try:
        redis = Redis(tmp_path)
    except Missing as missing:
        pytest.skip(str(missing))
    with redis, keyed(settings, reads_per_minute=4, broker_url=redis.url) as one:
        with keyed(settings, reads_per_minute=4, broker_url=redis.url) as other:
            ann = bearer(one.key("ann"))
            asked = [server.api.get("/v1/jobs", headers=ann).status_code for server in 3 * [one, other]]
        assert asked == 4 * [200] + 2 * [429]


def test_a_redis_that_is_away_lets_all_in_and_keeps_nobody_waiting(
    settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    url = f"redis://:s3cret@127.0.0.1:{free_port()}/0"
    with keyed(settings, reads_per_minute=2, broker_url=url) as service:
        ann = service.client("ann")
        started = time.monotonic()
        assert [ann.get("/v1/jobs").status_code for _ in range(5)] == 5 * [200]
        assert time.monotonic() - started < 30  # guards against a hang; under 3 s normally
    told = [record.getMessage() for record in caplog.records if record.name == "service.http.rates"]
    assert len(told) == 1 and "no rate limits" in told[0] and "s3cret" not in told[0]


# What every answer carries --------------------------------------------------------------------------


def test_every_answer_tells_the_browser_what_it_may_do(service: Keyed, image_file: Path) -> None:
    ann = service.client("ann")
    upload(ann, image_file)
    for address in (
        "/v1/images",
        "/v1/images?limit=0",
        "/nowhere",
        "/uws/jobs",
        "/healthz",
        "/docs",
        "/v1/jobs/" + 32 * "0",
    ):
        headers = ann.get(address).headers
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Referrer-Policy"] == "no-referrer"
        assert headers["X-Frame-Options"] == "DENY"
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert headers["Cache-Control"] == "no-store"
        assert "Server" not in headers or "uvicorn" in headers["Server"]


def test_a_failure_of_ours_carries_them_too(service: Keyed, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("oh")

    monkeypatch.setattr(service.catalogue, "page", fail)
    answer = service.client("ann").get("/v1/jobs")
    assert answer.status_code == 500 and answer.headers["X-Content-Type-Options"] == "nosniff"


def test_the_api_reference_loads_nothing_from_other_hosts(service: Keyed) -> None:
    page = service.api.get("/docs")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert not [address for address in loaded if address.startswith(("http", "//", "/"))]
    assert "<script>" not in page.text and "onload" not in page.text
    for address in loaded:
        answer = service.api.get(f"/{address}")
        assert answer.status_code == 200 and len(answer.content) > 100, address
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    assert "SwaggerUIBundle" in service.api.get("/docs/swagger-ui-bundle.js").text
    refused = service.api.get("/docs/..%2Fmain.py")
    assert refused.status_code == 404 and refused.headers["content-type"] == "application/problem+json"


# Bodies ---------------------------------------------------------------------------------------------


def test_a_body_that_is_no_file_is_bounded_before_it_is_read(settings: Settings) -> None:
    with TestClient(
        create_app(settings.model_copy(update={"max_body_kib": 1024})), raise_server_exceptions=False
    ) as api:
        large = b'{"kind": "' + bytes(2**21) + b'"}'
        json_type = {"Content-Type": "application/json"}
        for body in (large, (large[at : at + 2**16] for at in range(0, len(large), 2**16))):
            answer = api.post("/v1/jobs", content=body, headers=json_type)
            assert answer.status_code == 413, answer.text
            assert answer.headers["content-type"] == "application/problem+json"


def test_nobody_waits_for_a_body_that_is_declared_too_long(settings: Settings) -> None:
    """The refusal comes while the client has sent no more than the header."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
        server = uvicorn.Server(uvicorn.Config(create_app(settings), log_level="warning"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            deadline = time.monotonic() + 20
            while not server.started and time.monotonic() < deadline:
                time.sleep(0.05)
            with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
                head = "POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
                connection.sendall(f"{head}Content-Length: 99999999999\r\n\r\n".encode())
                assert connection.recv(100).startswith(b"HTTP/1.1 413")
        finally:
            server.should_exit = True
            thread.join(20)
