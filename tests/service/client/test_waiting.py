"""Waiting for a job whose service goes away and comes back, and Control-C meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

from service.client import bulk, http
from service.client.errors import ServiceError, WaitInterrupted
from service.client.http import Client

JOB = {"id": "a" * 32, "kind": "deconvolve", "queue": "interactive", "result": None, "error": None}
STILL = {"stage": "deconvolving", "step": 3, "steps": 20, "time_left_s": None}


def job(phase: str) -> dict[str, Any]:
    return JOB | {"phase": phase, "progress": STILL}


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """The times that the client slept; nothing waits for them. The clock goes on by as much."""
    times: list[float] = []
    monkeypatch.setattr(http.time, "sleep", times.append)
    monkeypatch.setattr(http.time, "monotonic", lambda: sum(times))
    yield times


def client(answers: list[Callable[[], httpx.Response]], said: list[str]) -> Client:
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
    found = client([at_work, *lost, at_work, done], said).wait(
        job("EXECUTING"), progress=lambda *step: steps.append(step)
    )
    assert found["phase"] == "COMPLETED" and ("deconvolving", 3, 20) in steps
    assert len(said) == 2 and said[1] == "the service answers again"
    assert "no answer from http://testserver" in said[0] and "continue when the service runs again" in said[0]
    assert sum(slept) > 60, "longer than a restart takes"
    waits = [one for one in slept if one > 0.1]
    assert waits == sorted(waits) and waits[1] == 2 * waits[0] and max(waits) == bulk.LONGEST_WAIT_S


def test_a_service_that_stays_away_is_given_up(slept: list[float]) -> None:
    said: list[str] = []
    with pytest.raises(ServiceError, match="no answer"):
        client([nothing], said).wait(job("EXECUTING"))
    assert len(said) == 1 and bulk.PATIENCE_S < sum(slept) < 2 * bulk.PATIENCE_S


def test_a_refusal_is_not_repeated(slept: list[float]) -> None:
    said: list[str] = []
    with pytest.raises(ServiceError):
        client([lambda: httpx.Response(404)], said).wait(job("EXECUTING"))
    assert said == [] and len(slept) == 1


def test_a_job_that_stays_in_the_queue_is_told_once(slept: list[float]) -> None:
    said: list[str] = []
    queued = [lambda: httpx.Response(200, json=job("QUEUED"))] * 300
    client([*queued, done], said).wait(job("QUEUED"))
    assert said == ["job aaaaaaaaaaaa waits in the queue interactive"]


def test_control_c_says_which_job_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(http.time, "sleep", interrupt)
    with pytest.raises(WaitInterrupted) as stopped:
        client([at_work], []).wait(job("EXECUTING"))
    assert (stopped.value.what, stopped.value.identity) == ("job", "a" * 32)
    assert stopped.value.server == "http://testserver"

    def broken() -> httpx.Response:
        raise KeyboardInterrupt

    with pytest.raises(WaitInterrupted) as stopped:
        client([broken], []).wait_for_bulk("b" * 32)
    assert (stopped.value.what, stopped.value.identity) == ("bulk", "b" * 32)


def test_a_bulk_run_of_a_lost_service_is_rejoined(slept: list[float]) -> None:
    said: list[str] = []
    counts = {"total": 2, "done": 2, "failed": 0}
    event = f'id: 1\nevent: end\ndata: {{"phase": "COMPLETED", "images": {str(counts).replace(chr(39), chr(34))}}}\n\n'

    def ended() -> httpx.Response:
        return httpx.Response(200, text=event)

    assert client([nothing, nothing, ended], said).wait_for_bulk("b" * 32)["phase"] == "COMPLETED"
    assert len(said) == 2 and said[1] == "the service answers again"
