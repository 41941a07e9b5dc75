"""What one owner sends at once goes on in turn, so that the requests of other owners do not wait for all of it."""

from __future__ import annotations

import asyncio
from collections import Counter
from functools import partial
from types import SimpleNamespace
from typing import Any

from fastapi import FastAPI, Request, Response
from starlette.types import Message

from service.http import guard
from service.http.state import Access
from tests.service.conftest import refusal
from tests.service.keyed import bearer, keyed
from tests.service.serving import in_own_loop
from workers.settings import Settings

PIECES = 5


class Server:
    """An application behind the guard. A key is the name of its owner, and a number.

    inside: how many requests of each owner are not yet admitted. go: lets them be admitted. rounds: in which round of
    the event loop the pieces of the bodies of each owner arrive.
    """

    def __init__(self, settings: Settings) -> None:
        self.inside: Counter[str] = Counter()
        self.go = asyncio.Event()
        self.rounds: dict[str, list[int]] = {"ann": [], "bob": []}
        self.round = 0
        self.app = FastAPI()
        self.app.add_api_route("/v1/images", self._endpoint, methods=["GET", "POST"])
        guard.install(self.app, Access(True, None), settings, lambda *_: Response())

    async def _endpoint(self, request: Request) -> Response:
        owner = request.headers.get("authorization", "nobody 0").split()[0]
        self.inside[owner] += 1
        await self.go.wait()
        request.state.caller = SimpleNamespace(account=owner)
        await asyncio.get_running_loop().run_in_executor(None, request.state.admitted)
        async for piece in request.stream():
            if piece:
                self.rounds[owner].append(self.round)
        self.inside[owner] -= 1
        return Response()

    async def send(self, key: str | None, pieces: int = 0) -> int:
        """The status of the answer to a request whose body is there at once."""
        left, statuses = [pieces], []

        async def receive() -> Message:
            left[0] -= 1
            return {"type": "http.request", "body": b"x" * (pieces > 0), "more_body": left[0] > 0}

        async def keep(message: Message) -> None:
            statuses.append(message.get("status"))

        headers = [] if key is None else [(b"authorization", key.encode())]
        method = "POST" if pieces else "GET"
        scope: dict[str, Any] = {"type": "http", "method": method, "path": "/v1/images", "headers": headers}
        scope |= {"query_string": b"", "scheme": "http", "server": ("h", 80), "root_path": "", "state": {}}
        await self.app(scope, receive, keep)
        return int(statuses[0])

    async def count_rounds(self) -> None:
        while True:
            self.round += 1
            await asyncio.sleep(0)


def test_the_requests_with_one_key_begin_one_after_the_other(settings: Settings) -> None:
    async def work() -> None:
        server = Server(settings)
        first = [asyncio.create_task(server.send("ann 1")) for _ in range(PIECES)]
        first += [asyncio.create_task(server.send(key)) for key in ("ann 2", "bob 1", None, None, None)]
        await asyncio.sleep(0.2)
        assert server.inside == {"ann": 2, "bob": 1, "nobody": 3}, "one for each key, which are new here"
        server.go.set()
        assert {await one for one in first} == {200}
        server.go.clear()
        again = [asyncio.create_task(server.send(key)) for key in ("ann 1", "ann 2", "bob 1")]
        await asyncio.sleep(0.2)
        assert +server.inside == {"ann": 1, "bob": 1}, "keys of one owner, which are known"
        again[0].cancel()
        server.go.set()
        assert {await one for one in again[1:]} == {200}

    in_own_loop(work)


def test_one_piece_of_the_bodies_of_an_owner_arrives_in_a_round(settings: Settings) -> None:
    async def work() -> None:
        server = Server(settings)
        server.go.set()
        counting = asyncio.create_task(server.count_rounds())
        uploads = [
            server.send(f"{owner} {number}", PIECES) for owner in ("ann", "bob") for number in range(8)
        ]
        assert set(await asyncio.gather(*uploads)) == {200}
        counting.cancel()
        for rounds in server.rounds.values():
            assert len(rounds) == 8 * PIECES
            assert max(Counter(rounds).values()) <= 2, "a round may begin between the counts"

    in_own_loop(partial(work))


def test_a_refused_request_ends_its_turn(settings: Settings) -> None:
    with keyed(settings) as service:
        for _ in range(2):
            refusal(service.api.get("/v1/jobs", headers=bearer("hpsf_none")), 401, "bad-key")
            refusal(service.api.get("/v1/nothing", headers=bearer("hpsf_none")), 404, "http-404")
        assert service.client("ann").get("/v1/jobs").status_code == 200
