"""Bodies: the key comes first, then sizes, and how many values JSON may have.
Sockets and connections: how the server listens, and how many files it may open."""

from __future__ import annotations

import asyncio
import json
import re
import select
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from starlette import requests

from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import HeaderSummary
from service import server
from service.app import create_app
from service.http import files as http_files
from service.http.guard import SESSION_COOKIE
from tests.conftest import write_image
from tests.service.conftest import refusal, settings_in
from tests.service.keyed import Keyed, bearer, keyed
from tests.service.serving import in_own_loop, serving
from tests.whole.stack import wait_for
from workers.catalogue.access import Scope
from workers.settings import Settings

JSON = {"Content-Type": "application/json"}
KIB = 2**10


@dataclass
class Live:
    """A server in a thread that asks for keys."""

    address: tuple[str, int]
    service: Keyed

    def begin(self, method: str, path: str, headers: dict[str, str], body: bytes = b"") -> socket.socket:
        """Send the header of a request, and the beginning of its body."""
        connection = socket.create_connection(self.address, timeout=20)
        lines = "".join(f"{name}: {value}\r\n" for name, value in ({"Host": "localhost"} | headers).items())
        connection.sendall(f"{method} {path} HTTP/1.1\r\n{lines}\r\n".encode() + body)
        return connection

    def answer(self, connection: socket.socket) -> bytes:
        """The whole answer, header and body, to a request whose body was not sent to its end."""
        with connection.makefile("rb") as file:
            head = b"".join(iter(file.readline, b"\r\n"))
            (length,) = re.findall(rb"(?i)content-length: (\d+)", head)
            return head + file.read(int(length))


@contextmanager
def running(folder: Path, **changes: object) -> Iterator[Live]:
    app = create_app(settings_in(folder, access="keys", **changes))
    with serving(app) as port:
        yield Live(("127.0.0.1", port), Keyed(TestClient(app), app.state.heliopsf.catalogue))


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    with running(tmp_path_factory.mktemp("bodies")) as live:
        yield live


# The key first --------------------------------------------------------------------------------------


def routes_that_take_a_body() -> list[tuple[str, str]]:
    app = create_app(Settings(database_url=None, broker_url="filesystem://"))
    routes = [
        (method.upper(), path.replace("{psf_id}", 64 * "a").replace("{bulk_id}", 32 * "a"))
        for path, operations in app.openapi()["paths"].items()
        for method in operations
        if method in ("post", "put", "patch")
    ]
    assert len(routes) >= 15 and ("POST", "/v1/jobs") in routes and ("POST", "/v1/images") in routes
    return routes


def test_without_a_key_or_its_scope_no_body_is_awaited(live: Live) -> None:
    """The answer comes while the body has not: nothing of it was read or parsed."""
    no_keys: tuple[dict[str, str], ...] = ({}, {"Authorization": "Bearer nonsense"})
    cases = [(route, key, 401) for key in no_keys for route in routes_that_take_a_body()]
    reader = bearer(live.service.key("reader", Scope.READ))
    for route in (("POST", "/v1/jobs"), ("POST", "/v1/bulk"), ("PUT", "/v1/contexts/default")):
        cases.append((route, reader, 403))
    for (method, path), key, status in cases:
        headers = JSON | {"Content-Length": "1000"} | key
        with live.begin(method, path, headers, b"[[],[],") as connection:
            assert connection.recv(100).startswith(f"HTTP/1.1 {status}".encode()), (method, path, key)


# Heads ----------------------------------------------------------------------------------------------


def test_only_the_own_cookie_is_parsed_and_long_cookies_are_refused_before_the_key(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python's parser of cookies took seconds for 60 kB of backslashes (CVE-2024-7592)."""
    parsed: list[str] = []
    parser = requests.cookie_parser
    monkeypatch.setattr(requests, "cookie_parser", lambda text: parsed.append(text) or parser(text))
    foreign, own = 'other="' + 1000 * r"\"\\" + '"', f"{SESSION_COOKIE}=no-session_1"
    for cookies, status, kept in (
        (foreign, 401, []),
        (f"{foreign}; {own}; x=y", 401, [own]),
        (f"x{own}; {own}\tx", 401, []),
        (f'{SESSION_COOKIE}="a\\"', 401, []),
        (foreign + 100 * "a", 431, []),
    ):
        parsed.clear()
        with live.begin("GET", "/v1/jobs", {"Cookie": cookies}) as connection:
            answer = live.answer(connection)
        assert answer.startswith(f"HTTP/1.1 {status}".encode()), (cookies[-80:], answer)
        assert set(parsed) <= {own} and list(dict.fromkeys(parsed)) == kept, cookies[-80:]
    assert b"cookies-too-long" in answer


def test_a_body_with_two_lengths_is_refused_and_its_connection_closed(live: Live) -> None:
    """A proxy that goes by the other length would read the request at its end as one of another client."""
    both = JSON | {"Content-Length": "5", "Transfer-Encoding": "chunked"} | bearer(live.service.key("ann"))
    hidden = b"0\r\n\r\nGET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with live.begin("POST", "/v1/jobs", both, hidden) as connection:
        answer = live.answer(connection)
        assert answer.startswith(b"HTTP/1.1 400") and b"two-body-lengths" in answer
        assert connection.recv(100) == b"", "the connection is closed"


# Sizes ----------------------------------------------------------------------------------------------


def test_a_body_that_is_declared_too_long_is_refused_before_it_comes(live: Live) -> None:
    headers = JSON | {"Content-Length": "99999999999"} | bearer(live.service.key("ann"))
    with live.begin("POST", "/v1/jobs", headers) as connection:
        assert connection.recv(100).startswith(b"HTTP/1.1 413")


def test_only_a_bulk_run_may_be_large(settings: Settings) -> None:
    body = json.dumps({"images": ["a" * 64] * 5000, "psf_id": "b" * 64}).encode()
    assert 128 * KIB < len(body) < 2**20
    with keyed(settings, max_body_kib=128) as service:
        ann = service.client("ann")
        for declared in (True, False):

            def answer(path: str, kind: str = "application/json", declared: bool = declared) -> Any:
                content = body if declared else iter([body[:1000], body[1000:]])
                return ann.post(path, content=content, headers={"Content-Type": kind})

            for path in ("/v1/jobs", "/v1/contexts"):
                assert "131072 bytes" in refusal(answer(path), 413, "too-large")
            form = answer("/uws/jobs", "application/x-www-form-urlencoded")
            assert form.status_code == 413 and "131072 bytes" in form.text
            refusal(answer("/v1/bulk"), 404, "no-such-psf")


def test_a_body_of_lists_without_end_is_counted_before_it_is_parsed(
    shared_service: Keyed, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[tuple[int, str]] = []
    loads, good = json.loads, b'{"kind": "x"}'

    def parse(content: Any, **options: Any) -> Any:
        parsed.append((len(content), threading.current_thread().name if content == good else ""))
        return loads(content, **options)

    ann = shared_service.client("ann")
    monkeypatch.setattr(json, "loads", parse)  # also the database parses JSON, of a few bytes
    answers = [
        ann.post("/v1/bulk", content=b"[" + unit * 2**18, headers=JSON) for unit in (b"[],", b"{},", b'"":0,')
    ]
    small = ann.post("/v1/jobs", content=good, headers=JSON)
    monkeypatch.undo()
    for answer in answers:
        refusal(answer, 413, "too-many-values")
    assert all(length < 1000 for length, _ in parsed)
    (thread,) = [name for _, name in parsed if name]
    assert small.status_code == 422 and "worker" in thread.lower(), "off the event loop"


def test_many_wrong_values_get_a_short_answer(shared_service: Keyed) -> None:
    ann = shared_service.client("ann")
    wrong = {"images": [f"{n:x}" for n in range(25_000)], "psf_id": "b" * 64}
    answer = ann.post("/v1/bulk", json=wrong)
    assert "body/images/0" in refusal(answer, 422, "invalid-request") and len(answer.content) < 10_000
    names = ann.post("/v1/jobs", json={"kind": "psf-build", "parameters": {f"x{n}": n for n in range(5000)}})
    assert "more errors" in refusal(names, 422, "invalid-request") and len(names.content) < 50_000
    assert len(names.json()["errors"]) == 20


def test_a_body_that_nobody_reads_breaks_no_stream(live: Live, caplog: pytest.LogCaptureFixture) -> None:
    """A stream of events waits for the end of the connection; a body that is late or long is none."""
    job, _ = live.service.catalogue.jobs.submit("psf-build", {}, "k", "ann")
    headers = {"Content-Length": str(10**9)} | bearer(live.service.key("ann"))
    with (
        live.begin("GET", f"/v1/jobs/{job.id}/events", headers) as connection,
        connection.makefile("rb") as file,
    ):

        def until(event: bytes) -> list[bytes]:
            return list(takewhile(lambda line: line not in (b"", event), iter(file.readline, None)))

        assert until(b"event: progress\n")[0].startswith(b"HTTP/1.1 200")
        live.service.catalogue.jobs.cancel(job.id)
        until(b"event: end\n")
        assert file.readline().startswith(b"data:"), "the last event came"
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


# At once --------------------------------------------------------------------------------------------


def test_an_owner_sends_one_bulk_run_at_a_time(tmp_path: Path) -> None:
    """Its body may be large; the others of the owner wait until it has come. Another owner's do not."""
    body = json.dumps({"images": ["a" * 64], "psf_id": "b" * 64}).encode()
    with running(tmp_path) as live, ExitStack() as open_:
        ann, bob = (bearer(live.service.key(name)) for name in ("ann", "bob"))
        at_work = live.service.api.app.state.heliopsf.requests

        def begin(headers: dict[str, str], sent: bytes) -> socket.socket:
            before = at_work.total()
            length = {"Content-Length": str(len(body))}
            connection = open_.enter_context(live.begin("POST", "/v1/bulk", JSON | length | headers, sent))
            if headers is ann:
                wait_for(lambda: at_work.total() > before, "the caller is let in", timeout_s=20)
                # Meanwhile the server goes from there to the turn of the owner.
                live.answer(open_.enter_context(live.begin("GET", "/healthz", {})))
            return connection

        first, second = begin(ann, body[:10]), begin(ann, body)
        assert select.select([second], [], [], 0.2)[0] == [], "it waits"
        assert live.answer(begin(bob, body)).startswith(b"HTTP/1.1 404")
        first.sendall(body[10:])
        for connection in (first, second):
            assert live.answer(connection).startswith(b"HTTP/1.1 404")


def test_a_caller_holds_only_so_many_requests(settings: Settings) -> None:
    with keyed(settings, requests_per_caller=2) as service:
        ann, bob = service.client("ann"), service.client("bob")
        held = service.api.app.state.heliopsf.requests
        who = "ann"  # all keys of an owner count together
        held.open(who), held.open(who)
        refusal(service.client("ann").get("/v1/jobs"), 429, "too-many-requests-at-once")
        refusal(ann.get("/v1/jobs"), 429, "too-many-requests-at-once")
        assert bob.get("/v1/jobs").status_code == 200
        held.close(who)
        for path in ("/v1/jobs", "/v1/jobs/x", "/v1/images/x", "/v1/jobs"):
            assert ann.get(path).status_code in (200, 422)
        held.close(who)
        assert held.total() == 0


def test_inspections_of_uploads_do_not_use_the_threads_of_other_requests(
    api: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More files than the server has threads are inspected at once, and none of the inspections ends."""
    write_image(tmp_path / "image.fits")
    content = (tmp_path / "image.fits").read_bytes()
    let_end = threading.Event()
    inspect = http_files.read_summary

    def slow(path: Path, limits: FitsLimits) -> HeaderSummary:
        let_end.wait(180.0)
        return inspect(path, limits)

    monkeypatch.setattr(http_files, "read_summary", slow)
    with ThreadPoolExecutor(64) as pool:
        sent = [pool.submit(api.post, "/v1/images", content=content) for _ in range(60)]
        try:
            assert pool.submit(api.get, "/v1/images").exception(90.0) is None
        finally:
            let_end.set()
        assert {one.result().status_code for one in sent} <= {200, 201}


# --- sockets and connections -----------------------------------------------------------------------------


def test_answers_on_a_connection_that_is_used_again_do_not_wait_for_an_acknowledgement() -> None:
    """Whether asyncio sets TCP_NODELAY depends on the protocol that the listener states."""

    async def delay_is_off() -> bool:
        accepted: asyncio.Future[bool] = asyncio.get_running_loop().create_future()

        def look(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            own: socket.socket = writer.get_extra_info("socket")
            accepted.set_result(bool(own.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)))
            writer.close()

        with server.listening("127.0.0.1", 0) as listener:
            async with await asyncio.start_server(look, sock=listener):
                _, client = await asyncio.open_connection(*listener.getsockname()[:2])
                off = await asyncio.wait_for(accepted, 10)
                client.close()
        return off

    assert in_own_loop(delay_is_off)


def test_a_port_that_is_in_use_is_refused() -> None:
    with server.listening("127.0.0.1", 0) as listener:
        listener.listen()
        with pytest.raises(OSError, match="in use"):
            server.listening("127.0.0.1", listener.getsockname()[1])
