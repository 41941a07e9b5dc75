"""Commands that send their requests to the application in this process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from click.testing import CliRunner, Result
from fastapi.testclient import TestClient

from service.cli.main import main
from service.client import http


@pytest.fixture
def command(
    api: TestClient, run_jobs: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., str]:
    """Run a command; returns what it writes. Jobs run as soon as a client waits for them.

    `service.client.http.Client` is then a client of the application in this process.
    """

    class AtOnce(http.Client):
        def __init__(self, server: str | None = None, *, key: str | None = None, **options: Any) -> None:
            super().__init__("http://testserver", key=key, transport=api._transport, **options)

        def wait(self, job: dict[str, Any], **options: Any) -> dict[str, Any]:
            run_jobs()
            return super().wait(job, **options)

        def close(self) -> None:
            """The transport is the application's: it goes on."""

    monkeypatch.setattr(http, "Client", AtOnce)

    def run(*words: object, code: int = 0) -> str:
        done: Result = CliRunner().invoke(main, [str(word) for word in words])
        assert done.exit_code == code, (words, done.output, done.exception)
        assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
        return done.output

    return run


@pytest.fixture
def client(command: Callable[..., str]) -> http.Client:
    """A client of the application in this process, as the commands have one."""
    return http.Client()
