"""The gate: whose turn it is, and that one owner's long work leaves a place for another."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import HeaderSummary
from service.http import files as http_files
from service.http.gate import Gate
from tests.conftest import write_image
from tests.service.keyed import keyed
from tests.service.serving import in_own_loop
from tests.whole.stack import wait_for
from workers.settings import Settings


class Works:
    """Works behind a gate, that end when a test lets them. begun: their names, in the order in which they began."""

    def __init__(self, places: int) -> None:
        self.now = 0.0
        self.gate = Gate(places, lambda: self.now)
        self.begun: list[str] = []
        self._seen = 0
        self._ends: dict[str, threading.Event] = {}
        self._tasks: dict[str, asyncio.Task[str]] = {}

    def _work(self, name: str) -> str:
        self.begun.append(name)
        assert self._ends[name].wait(20.0)
        return name

    async def send(self, *names: str) -> None:
        """Send works. The first letter of a name is the owner."""
        for name in names:
            self._ends[name] = threading.Event()
            self._tasks[name] = asyncio.create_task(self.gate.run(name[0], self._work, name))
            await asyncio.sleep(0)
        await asyncio.sleep(0.05)

    async def end(self, name: str, after_s: float = 0.0) -> None:
        """Let a work end that has begun ``after_s`` seconds ago, and see who comes next."""
        self.now += after_s
        self._ends[name].set()
        assert await self._tasks.pop(name) == name
        await asyncio.sleep(0.05)

    async def reach(self, *names: str) -> None:
        """Wait until these works have begun as the last ones, in any order."""
        for _ in range(200):
            if len(self.begun) >= self._seen + len(names):
                break
            await asyncio.sleep(0.02)
        assert sorted(self.begun[self._seen :]) == sorted(names)
        self._seen = len(self.begun)

    async def cancel(self, name: str) -> None:
        """Cancel a work that waits."""
        self._tasks.pop(name).cancel()
        await asyncio.sleep(0.05)


def run(scenario: Callable[[Works], object], places: int) -> None:
    in_own_loop(lambda: scenario(Works(places)))  # type: ignore[arg-type, return-value]


def test_one_owner_leaves_a_place_and_waits_for_others_with_its_second() -> None:
    async def scenario(works: Works) -> None:
        await works.send("a1", "a2", "a3", "a4")
        await works.reach("a1", "a2")  # one place stays free
        await works.send("b1", "b2")
        await works.reach("b1")  # another owner begins at once
        await works.end("a1")
        await works.end("a2")
        await works.reach("a3")  # one place for each while both wait
        await works.cancel("b2")
        await works.end("b1")
        await works.reach("a4")  # alone again
        for name in ("a3", "a4"):
            await works.end(name)
        await works.send("c1", "c2")
        await works.reach("c1", "c2")
        for name in ("c1", "c2"):
            await works.end(name)

    run(scenario, 3)


def test_who_took_less_time_comes_first_and_who_is_new_not_for_ever() -> None:
    async def scenario(works: Works) -> None:
        await works.send("a1", "b1", "a2", "b2", "b3", "a3")
        await works.reach("a1", "b1")
        await works.end("b1", after_s=1.0)
        await works.reach("b2")  # a holds a place
        await works.end("b2", after_s=1.0)
        await works.reach("b3")
        await works.send("c1", "c2")
        await works.end("a1", after_s=8.0)
        await works.reach("c1")  # c begins with as much as b, who took the least; a took 10 s
        await works.end("b3")
        await works.reach("a2")  # c holds a place
        await works.end("c1", after_s=1.0)
        await works.reach("c2")
        await works.end("c2")
        await works.end("a2")
        await works.end("a3")

    run(scenario, 2)


def test_a_work_that_fails_frees_its_place() -> None:
    async def scenario(works: Works) -> None:
        for _ in range(4):
            with pytest.raises(ZeroDivisionError):
                await works.gate.run("a", divmod, 1, 0)
        await works.send("a1")
        await works.end("a1")

    run(scenario, 2)


def test_uploads_of_one_owner_do_not_keep_those_of_another_waiting(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor downloads and headers. The inspections of the first owner's uploads do not end."""
    write_image(tmp_path / "image.fits")
    content = (tmp_path / "image.fits").read_bytes()
    let_end, begun = threading.Event(), []
    inspect = http_files.read_summary

    def slow(path: Path, limits: FitsLimits) -> HeaderSummary:
        if path.stat().st_size > len(content):
            begun.append(path)
            let_end.wait(60.0)
        return inspect(path, limits)

    monkeypatch.setattr(http_files, "read_summary", slow)
    with keyed(settings) as service:
        keys = {name: {"Authorization": f"Bearer {service.key(name)}"} for name in ("ann", "bob")}
        heavy = [
            threading.Thread(
                target=service.api.post,
                args=("/v1/images",),
                kwargs={"content": content + bytes(2880 * number), "headers": keys["ann"]},
            )
            for number in range(1, 9)
        ]
        for one in heavy:
            one.start()
        try:
            wait_for(lambda: len(begun) == 2, "ann has all places that one owner gets", timeout_s=20)
            sent = service.api.post("/v1/images", content=content, headers=keys["bob"])
            assert sent.status_code == 201
            there = f"/v1/images/{sent.json()['id']}"
            for part in ("file", "header", "pixels"):
                assert service.api.get(f"{there}/{part}", headers=keys["bob"]).status_code == 200
            assert len(begun) == 2
        finally:
            let_end.set()
            for one in heavy:
                one.join(60)
