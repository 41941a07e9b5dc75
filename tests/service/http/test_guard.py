"""What holds for every request and answer: names of the host, other sites' pages, rates, headers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.http.state import Access
from service.pages import assets
from tests.service.conftest import refusal, upload
from tests.service.keyed import Keyed, bearer, keyed
from tests.whole.stack import Missing, Redis, free_port
from workers.settings import Settings

# Hosts and other sites ------------------------------------------------------------------------------

HOSTS = {
    "127.0.0.1:8765": 200,
    "localhost": 200,
    "LOCALHOST:1": 200,
    "[::1]:8765": 200,
    "sun.example.org": 200,
    "evil.example": 421,
    "127.0.0.1.evil.example": 421,
    "localhost.": 421,
    "user@evil.example:80": 421,
    "": 421,
    "[::1": 421,
    "a:b:c": 421,
}


def test_an_open_service_is_called_by_its_own_names(settings: Settings) -> None:
    named = settings.model_copy(update={"allowed_hosts": "sun.example.org, other.example"})
    with TestClient(create_app(named)) as api:
        for host, status in HOSTS.items():
            for address in ("/v1/jobs", "/uws/jobs", "/healthz"):
                answer = api.get(address, headers={"Host": host})
                assert answer.status_code == status, (host, address, answer.text)
                if status == 421:
                    assert answer.headers["content-type"] == "application/problem+json", host


def test_with_keys_any_name_will_do_unless_some_are_named(settings: Settings) -> None:
    def hosts(address: str, **changes: str) -> frozenset[str] | None:
        return Access.of(settings.model_copy(update=changes), address).hosts

    assert hosts("0.0.0.0", access="keys", allowed_hosts="") is None
    assert hosts("127.0.0.1", allowed_hosts="*") is None
    named = hosts("0.0.0.0", access="keys")
    assert named is not None and {"testserver", "127.0.0.1"} <= named


SITES: list[tuple[dict[str, str], bool]] = [
    ({}, False),
    ({"Origin": "http://testserver"}, False),
    ({"Sec-Fetch-Site": "same-origin", "Origin": "https://testserver"}, False),
    ({"Sec-Fetch-Site": "none"}, False),
    ({"Origin": "http://evil.example"}, True),
    ({"Origin": "http://testserver:81"}, True),
    ({"Origin": "http://["}, True),
    ({"Sec-Fetch-Site": "cross-site"}, True),
    ({"Sec-Fetch-Site": "same-site", "Origin": "http://testserver"}, True),
]
CHANGES = (("POST", "/uws/jobs"), ("DELETE", "/uws/jobs/x"), ("POST", "/v1/images"), ("DELETE", "/v1/jobs/x"))


def test_a_page_of_another_site_changes_nothing(shared_api: TestClient, shared_service: Keyed) -> None:
    # A browser adds the password of HTTP Basic by itself, also to a form of another site.
    password = ("anybody", shared_service.key("owner"))
    for headers, foreign in SITES:
        form = shared_service.api.post(
            "/uws/jobs", data={"KIND": "psf-build"}, headers=headers, auth=password
        )
        assert (form.status_code == 403) == foreign, headers
        for method, address in CHANGES:
            answer = shared_api.request(method, address, headers=headers)
            assert (answer.status_code == 403) == foreign, (headers, method, address, answer.text)
            assert not foreign or refusal(answer, 403, "cross-site")
        assert shared_api.get("/v1/jobs", headers=headers).status_code == 200, headers


def test_a_refusal_is_a_page_for_browsers_and_json_for_programs(shared_api: TestClient) -> None:
    for method, headers, status, code in (
        ("GET", {"Host": "evil.example"}, 421, "host-not-served"),
        ("POST", {"Origin": "http://evil.example"}, 403, "cross-site"),
    ):
        browser = headers | {"Accept": "text/html,application/xhtml+xml;q=0.9,*/*;q=0.8"}
        page = shared_api.request(method, "/images/sample", headers=browser)
        assert page.status_code == status and page.headers["Content-Type"].startswith("text/html")
        assert "<h1>" in page.text and code in page.text and "Expected" in page.text
        assert "style-src 'self'" in page.headers["Content-Security-Policy"]
        assert ("To the images" in page.text) == (status == 403), "no link to a page that is refused too"
        for address, sent in (("/images/sample", headers), ("/v1/jobs", browser)):
            refusal(shared_api.request(method, address, headers=sent), status, code)


def test_the_files_of_pages_are_served_under_any_name(shared_api: TestClient) -> None:
    there = assets.address("heliopsf.css")
    assert shared_api.get(there, headers={"Host": "evil.example"}).status_code == 200
    assert shared_api.post(there, headers={"Host": "evil.example"}).status_code == 421


def test_a_text_that_no_database_holds_is_refused_wherever_it_stands(shared_api: TestClient) -> None:
    """NUL and halves of surrogate pairs: in addresses, queries, names and values of JSON, and fields of forms."""
    requests: tuple[tuple[str, str, dict[str, Any]], ...] = (
        ("GET", "/v1/images/a%00b", {}),
        ("GET", "/v1/psfs?name=a%00b", {}),
        ("GET", "/psfs?context=a%00b", {}),
        ("POST", "/v1/psfs?name=a%00b", {"content": b"SIMPLE  ="}),
        ("POST", "/v1/bulk", {"content": rb'{"files": [{"glob": "/a/*"}], "context": "a\u0000b"}'}),
        ("POST", "/v1/jobs", {"content": rb'{"kind": "psf-build", "parameters": {"a\ud800": 1}}'}),
        ("POST", "/bulk/start", {"data": {"name": "a\0b"}}),
    )
    for method, address, sent in requests:
        headers = {"Content-Type": "application/json"} if "/v1/" in address and "content" in sent else {}
        refusal(shared_api.request(method, address, headers=headers, **sent), 422, "invalid-request")


def test_a_name_that_looks_like_another_one_is_refused_wherever_it_is_given(shared_service: Keyed) -> None:
    """A mark of the direction of writing, or a control character of C1."""
    ann, image_id = shared_service.client("ann"), 64 * "a"
    run = {"images": [image_id], "psf_id": image_id}
    for sign in ("\u202e", "\x9b"):
        for address, sent in (
            ("/v1/keys", {"json": {"label": sign, "scopes": ["read"]}}),
            ("/v1/bulk", {"json": run | {"name": sign}}),
            ("/v1/psfs", {"params": {"name": sign}, "content": b"SIMPLE  ="}),
            ("/v1/psfs", {"params": {"version": sign}, "content": b"SIMPLE  ="}),
            ("/v1/contexts", {"json": {"name": "c", "reason": sign}}),
        ):
            assert "printable" in refusal(ann.post(address, **sent), 422, "invalid-request"), address
        uws = ann.post("/uws/jobs", data={"KIND": "psf-build", "instrument": "hri_euv", "RUNID": sign})
        assert uws.status_code == 400 and "RUNID" in uws.text


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
        assert service.client("ann").get("/v1/jobs").status_code == 429, "another key of the same owner"
        refused = ann.get("/v1/jobs")
        assert "5 requests" in refusal(refused, 429, "too-many-requests")
        assert 1 <= int(refused.headers["Retry-After"]) <= 60
        uws = ann.get("/uws/jobs")
        assert uws.status_code == 429 and "Retry-After" in uws.headers
        assert bob.get("/v1/jobs").status_code == 200, "another owner"
        assert ann.get("/healthz").status_code == 200, "no rate limits"
        assert [ann.post("/v1/jobs", json={}).status_code for _ in range(4)] == [422, 422, 422, 429]
        statuses = [service.api.get("/v1/jobs", headers=bearer(f"x{n}")).status_code for n in range(7)]
        assert statuses == 5 * [401] + 2 * [429], "who tries keys is not let try without end"
        assert service.client("eve").get("/v1/jobs").status_code == 200
    with keyed(settings, reads_per_minute=0) as service:
        answer = service.client("ann").get("/v1/jobs")
        assert answer.status_code == 200 and "RateLimit" not in answer.headers, "0: no limit"


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
            assert "3 MiB of uploads" in refusal(refused, 429, "too-many-requests")
        assert service.client("bob").post("/v1/images", content=content).status_code == 201
    assert list((settings.data_dir / "tmp").iterdir()) == []
    with keyed(settings, upload_mib_per_minute=1) as service:
        larger = content + bytes(900_000)
        assert service.client("eve").post("/v1/images", content=larger).status_code == 201, (
            "a file larger than a minute's allowance can be sent all the same"
        )


def test_rates_are_counted_in_redis_by_all_servers(settings: Settings, tmp_path: Path) -> None:
    try:
        redis = Redis(tmp_path)
    except Missing as missing:
        pytest.skip(str(missing))
    with redis, keyed(settings, reads_per_minute=4, broker_url=redis.url) as one:
        with keyed(settings, reads_per_minute=4, broker_url=redis.url) as other:
            ann = bearer(one.key("ann"))
            statuses = [server.api.get("/v1/jobs", headers=ann).status_code for server in 3 * [one, other]]
        assert statuses == 4 * [200] + 2 * [429]


def test_a_redis_that_is_away_lets_all_in(settings: Settings, caplog: pytest.LogCaptureFixture) -> None:
    url = f"redis://:s3cret@127.0.0.1:{free_port()}/0"
    with keyed(settings, reads_per_minute=2, broker_url=url) as service:
        ann = service.client("ann")
        assert [ann.get("/v1/jobs").status_code for _ in range(5)] == 5 * [200]
    told = [record.getMessage() for record in caplog.records if record.name == "service.http.rates"]
    assert len(told) == 1 and "no rate limits" in told[0] and "s3cret" not in told[0]


# What every answer carries --------------------------------------------------------------------------


def test_every_answer_tells_the_browser_what_it_may_do(
    shared_service: Keyed, image_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ann = shared_service.client("ann")
    upload(ann, image_file)
    for address in ("/v1/images", "/v1/images?limit=0", "/nowhere", "/uws/jobs", "/healthz", "/docs"):
        headers = ann.get(address).headers
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Referrer-Policy"] == "no-referrer"
        assert headers["X-Frame-Options"] == "DENY"
        assert headers["Cross-Origin-Opener-Policy"] == "same-origin"
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert headers["Cache-Control"] == "no-store"
        assert "Server" not in headers or "uvicorn" in headers["Server"]

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("oh")

    monkeypatch.setattr(shared_service.catalogue, "page", fail)
    answer = ann.get("/v1/jobs")
    assert answer.status_code == 500 and answer.headers["X-Content-Type-Options"] == "nosniff"
    assert answer.headers["Connection"] == "close", "the server closes it after a failure"


def test_the_api_reference_loads_nothing_from_other_hosts(shared_service: Keyed) -> None:
    api = shared_service.api
    page = api.get("/docs")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert not [address for address in loaded if address.startswith(("http", "//"))]
    assert "<script>" not in page.text and "onload" not in page.text
    for address in loaded:
        answer = api.get(urljoin("/docs", address))
        assert answer.status_code == 200 and len(answer.content) > 100, address
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    assert any(
        "SwaggerUIBundle" in api.get(address).text for address in loaded if address.endswith("bundle.js")
    )
    for address in ("/docs/..%2Fmain.py", "/static/1/..%2Frendering.py", "/static/..%2Frendering.py/1"):
        refusal(api.get(address), 404, "http-404")
