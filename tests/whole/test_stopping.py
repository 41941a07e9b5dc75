"""SIGTERM to a server: it takes no more, and is gone within the time that it states, whatever a client does."""

from __future__ import annotations

import signal
import socket
import threading
import time
from pathlib import Path

import httpx
import pytest

from tests.conftest import SMALL_INSTRUMENT
from tests.whole import stack as stacks
from tests.whole.stack import wait_for


@pytest.mark.parametrize("stop_s", [0.5, 60.0])
def test_a_server_lets_requests_end_and_does_not_wait_for_those_that_do_not(
    tmp_path: Path, stop_s: float
) -> None:
    """With half an upload on the line: gone after stop_s; or, where the rest comes in time, after the answer. A request that
    waits for a job without end is answered at once."""
    with stacks.alone(tmp_path, {"HELIOPSF_STOP_S": str(stop_s)}) as stack:
        assert stack.server is not None
        url = stack.client.server
        build = {"KIND": "psf-build", "instrument_file": SMALL_INSTRUMENT, "size": "128"}
        job = httpx.post(f"{url}/uws/jobs", data=build, follow_redirects=True, timeout=60).url
        answers: list[httpx.Response] = []
        waiting = threading.Thread(
            target=lambda: answers.append(httpx.get(job, params={"WAIT": "-1"}, timeout=60))
        )
        port = int(url.rsplit(":", 1)[1])
        with socket.create_connection(("127.0.0.1", port)) as line:
            line.sendall(
                b"POST /v1/images HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 2880\r\n\r\nSIMPLE  ="
            )
            waiting.start()
            wait_for(lambda: any((stack.data / "tmp").iterdir()), "the upload is at work")
            time.sleep(1.0)  # until the request that waits is surely there
            stack.server.send_signal(signal.SIGTERM)
            wait_for(lambda: not listens(port), "it takes no more")
            if stop_s > 1:
                assert stack.server.poll() is None
                line.sendall(b" " * (2880 - len(b"SIMPLE  =")))
                assert line.recv(65536).startswith(b"HTTP/1.1 422"), "no good file, but a whole answer"
            assert stack.server.wait(30) == 0
        waiting.join()
        assert answers[0].status_code == 200 and b"PENDING" in answers[0].content
        assert list((stack.data / "tmp").iterdir()) == [], "half an upload is not left behind"


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
