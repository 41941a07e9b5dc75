"""The client over HTTP: addresses, waiting for a service that goes away, and requests that no command makes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from astropy.io import fits
from fastapi.testclient import TestClient

from service.client import errors, http
from service.client.errors import ServiceError, WaitInterrupted, service_address
from service.client.http import Client
from tests.conftest import write_image, write_psf
from tests.service.keyed import Keyed
from tests.service.serving import running
from workers.catalogue.access import Scope
from workers.settings import Settings


def test_addresses_of_services() -> None:
    """One of this machine needs no scheme; other addresses are refused with an example."""
    for said, url in (
        (" 127.0.0.1:8791 ", "http://127.0.0.1:8791"),
        ("[::1]:8791", "http://[::1]:8791"),
        ("localhost", "http://localhost"),
        ("http://sun.example:80", "http://sun.example:80"),
        ("https://sun.example/heliopsf", "https://sun.example/heliopsf"),
    ):
        assert service_address(said) == url
    for said, told in (
        ("sun.example:8765", "write https://sun.example:8765"),
        ("10.0.0.7:8765", "https://10.0.0.7:8765"),
        ("ftp://localhost", "expected the address of a service"),
        ("local host:1", "expected the address of a service"),
        ("http://localhost:99999", "expected the address of a service"),
        ("[::1:8791", "expected the address of a service"),
    ):
        with pytest.raises(ServiceError) as refused:
            service_address(said)
        assert refused.value.code == "bad-address" and told in str(refused.value), said


def test_an_error_says_how_to_start_a_service_at_this_address() -> None:
    def refuse(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("connection refused")

    for server, told in (
        ("localhost:8765", "`heliopsf serve` starts"),
        ("localhost:9321", "`heliopsf serve --port 9321` starts"),
        ("http://localhost", "`heliopsf serve --port 80` starts"),
        ("https://localhost:9321", "ask the operator"),
        ("http://sun.example:8765", "ask the operator"),
    ):
        with (
            Client(server, transport=httpx.MockTransport(refuse)) as client,
            pytest.raises(ServiceError) as no,
        ):
            client.health()
        assert told in str(no.value), server


def test_the_client_takes_the_address_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HELIOPSF_SERVER", "localhost:8791")
    with Client() as client:
        assert client.server == "http://localhost:8791"


JOB = {"id": "a" * 32, "kind": "deconvolve", "queue": "interactive", "result": None, "error": None}
STILL = {"stage": "deconvolving", "step": 3, "steps": 20, "time_left_s": None, "share": None}


def job(phase: str) -> dict[str, Any]:
    return JOB | {"phase": phase, "progress": STILL}


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The times that the client slept; nothing waits for them. The clock goes on by as much."""
    times: list[float] = []
    monkeypatch.setattr(http.time, "sleep", times.append)
    monkeypatch.setattr(http.time, "monotonic", lambda: sum(times))
    return times


def client_of(answers: list[Callable[[], httpx.Response]], said: list[str]) -> Client:
    """A client of a service that gives these answers, the last again and again."""

    def answer(_request: httpx.Request) -> httpx.Response:
        return (answers.pop(0) if len(answers) > 1 else answers[0])()

    return Client("http://testserver", transport=httpx.MockTransport(answer), say=said.append)


def nothing() -> httpx.Response:
    raise httpx.ConnectError("connection refused")


def at_work() -> httpx.Response:
    return httpx.Response(200, json=job("EXECUTING"))


def done() -> httpx.Response:
    return httpx.Response(200, json=job("COMPLETED"))


def away() -> httpx.Response:
    return httpx.Response(503)


def test_a_lost_service_is_told_once_and_rejoined(slept: list[float]) -> None:
    said: list[str] = []
    steps: list[tuple[str, int, int]] = []
    lost = [nothing] * 8 + [away]
    found = client_of([at_work, *lost, at_work, done], said).wait(
        job("EXECUTING"), progress=lambda *step: steps.append(step)
    )
    assert found["phase"] == "COMPLETED" and ("deconvolving", 3, 20) in steps
    assert len(said) == 2 and said[1] == "the service answers again"
    assert "no answer from http://testserver" in said[0] and "continue when the service runs again" in said[0]
    assert sum(slept) > 60, "longer than a restart takes"
    waits = [one for one in slept if one > 0.1]
    assert waits == sorted(waits) and waits[1] == 2 * waits[0] and max(waits) == errors.LONGEST_WAIT_S


def test_a_service_that_stays_away_is_given_up_and_a_refusal_is_not_repeated(slept: list[float]) -> None:
    said: list[str] = []
    with pytest.raises(ServiceError):
        client_of([lambda: httpx.Response(404)], said).wait(job("EXECUTING"))
    assert said == [] and len(slept) == 1
    with pytest.raises(ServiceError, match="no answer"):
        client_of([nothing], said).wait(job("EXECUTING"))
    assert len(said) == 1 and errors.PATIENCE_S < sum(slept) < 2 * errors.PATIENCE_S


def test_a_job_that_stays_in_the_queue_is_told_once(slept: list[float]) -> None:
    said: list[str] = []
    queued = [lambda: httpx.Response(200, json=job("QUEUED"))] * 300
    client_of([*queued, done], said).wait(job("QUEUED"))
    assert said == ["job aaaaaaaaaaaa waits in the queue interactive"]


def test_control_c_says_which_job_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(http.time, "sleep", interrupt)
    with pytest.raises(WaitInterrupted) as stopped:
        client_of([at_work], []).wait(job("EXECUTING"))
    assert (stopped.value.what, stopped.value.identity) == ("job", "a" * 32)
    assert stopped.value.server == "http://testserver"

    def broken() -> httpx.Response:
        raise KeyboardInterrupt

    with pytest.raises(WaitInterrupted) as stopped:
        client_of([broken], []).wait_for_bulk("b" * 32)
    assert (stopped.value.what, stopped.value.identity) == ("bulk", "b" * 32)


def test_a_bulk_run_of_a_lost_service_is_rejoined(slept: list[float]) -> None:
    said: list[str] = []
    counts = {"total": 2, "done": 2, "failed": 0}
    event = f'id: 1\nevent: end\ndata: {{"phase": "COMPLETED", "images": {str(counts).replace(chr(39), chr(34))}}}\n\n'

    def ended() -> httpx.Response:
        return httpx.Response(200, text=event)

    assert client_of([nothing, nothing, ended], said).wait_for_bulk("b" * 32)["phase"] == "COMPLETED"
    assert len(said) == 2 and said[1] == "the service answers again"


PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def client(api: TestClient) -> Iterator[Client]:
    """A client of the application in this process."""
    with Client("http://testserver", transport=api._transport) as made:
        yield made


@pytest.fixture
def image_id(client: Client, tmp_path: Path) -> str:
    write_image(tmp_path / "sun.fits", shape=(48, 64))
    identity: str = client.upload_image(tmp_path / "sun.fits")["id"]
    return identity


@pytest.fixture
def psf_id(client: Client, tmp_path: Path) -> str:
    write_psf(tmp_path / "psf.fits")
    identity: str = client.upload_psf(tmp_path / "psf.fits")["id"]
    return identity


@pytest.fixture
def product_id(client: Client, image_id: str, psf_id: str, run_jobs: Callable[[], None]) -> str:
    job = client.submit("deconvolve", image_id=image_id, psf_id=psf_id, method={"name": "linear"})
    run_jobs()
    return str(client.job(job["id"])["result"].rpartition("/")[2])


def test_contents_of_files(client: Client, image_id: str, product_id: str, tmp_path: Path) -> None:
    stored = fits.getdata(tmp_path / "sun.fits").astype(np.float32)
    part = client.pixels("image", image_id, x=4, y=8, width=20, height=10)
    np.testing.assert_array_equal(part, stored[8:18, 4:24])
    assert part.dtype == np.float32 and part.flags.writeable
    client.download(f"/v1/products/{product_id}/file", tmp_path / "product.fits")
    quality = client.pixels("product", product_id, "quality")
    np.testing.assert_array_equal(quality, fits.getdata(tmp_path / "product.fits", "QUALITY"))
    for more, code in (({"plane": "error"}, "no-such-plane"), ({"x": 64}, "window-outside")):
        with pytest.raises(ServiceError) as refused:
            client.pixels("product", product_id, **more)  # type: ignore[arg-type]
        assert refused.value.code == code

    [primary] = client.image_header(image_id)
    header = fits.getheader(tmp_path / "sun.fits")
    assert [card[0] for card in primary["cards"]] == [card.keyword for card in header.cards]
    listed = client.product_header(product_id)
    assert "QUALITY" in [one["name"] for one in listed]
    assert "DCNVMETH" in {card[0] for card in listed[0]["cards"]}
    client.thumbnail(product_id, tmp_path / "small.png")
    assert (tmp_path / "small.png").read_bytes().startswith(PNG)


def test_keys_are_made_listed_and_revoked(service: Keyed) -> None:
    own = service.key("ann", Scope.READ, Scope.SUBMIT)
    with Client("http://testserver", key=own, transport=service.api._transport) as client:
        made = client.make_key(["read"], label="laptop", lasts_days=2)
        listed = client.keys()
        assert [one["id"] for one in listed] == [made["id"], own.split("_")[1]]
        assert client.revoke_key(made["id"])["state"] == "revoked"


def test_the_events_of_an_owner_tell_of_every_job_and_of_named_ones(settings: Settings) -> None:
    with running(settings.model_copy(update={"stream_s": 1.0})) as live:
        first, lease = live.job()
        live.catalogue.jobs.complete(lease, "/v1/psfs/x")
        events = live.client.events(jobs=[first, "0" * 32])
        seen = [next(events), next(events)]
        assert {(name, told["id"]) for name, told in seen} == {("job", first), ("gone", "0" * 32)}
        second, _ = live.job()
        # Of a later stream, because each one lasts a second; it may tell of the others again.
        told = next(told for _, told in events if told["id"] not in (first, "0" * 32))
        assert (told["id"], told["phase"]) == (second, "EXECUTING")
        events.close()  # type: ignore[attr-defined]
