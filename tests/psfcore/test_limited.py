"""A function that reads a file of strangers may do what it likes in its process: the caller gets an answer or an error."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import pytest

from psfcore import limited
from psfcore.errors import DataError, HeaderError
from psfcore.limited import run_limited

MIB = 2**20


def work(target: BinaryIO, *, path: str, kind: str) -> dict[str, Any]:
    """What the child does."""
    if kind == "crash":
        ctypes.string_at(0)
    if kind == "memory":
        return {"length": len(bytearray(600 * MIB))}
    if kind == "refuse":
        raise HeaderError("bad-card", "expected a card; got none", {"card": "X"})
    if kind == "fault":
        raise KeyError(kind)
    if kind == "full":
        raise OSError(28, "no space")
    target.write(Path(path).read_bytes()[::-1])
    return {"process": os.getpid(), "parent": os.getppid(), "variables": sorted(os.environ)}


def answer(path: Path, kind: str) -> tuple[dict[str, Any], bytes]:
    with TemporaryFile() as target:
        about = run_limited(work, path, target, pixels=10, kind=kind)
        target.seek(0)
        return about, target.read()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "file").write_bytes(b"abc")
    return tmp_path / "file"


def test_the_answer_and_what_is_written(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HELIOPSF_DATABASE_URL", "a secret")
    about, content = answer(path, "read")
    assert content == b"cba"
    assert about["process"] != os.getpid() != about["parent"]
    assert "HELIOPSF_DATABASE_URL" not in about["variables"]
    with ThreadPoolExecutor(4) as pool:
        several = list(pool.map(lambda _: answer(path, "read"), range(12)))
    assert len({about["process"] for about, _ in several}) == 12


@pytest.mark.parametrize("kind", ["crash", "memory"])
def test_a_child_that_crashes_or_takes_too_much_is_an_error_of_the_file(path: Path, kind: str) -> None:
    with pytest.raises(DataError, match=r"unreadable-pixels: .*crashed, or needed much more memory or time"):
        answer(path, kind)
    assert answer(path, "read")[1] == b"cba"


def test_errors_of_the_function_arrive(path: Path) -> None:
    with pytest.raises(HeaderError) as refused:
        answer(path, "refuse")
    assert (refused.value.code, refused.value.fields) == ("bad-card", {"card": "X"})
    with pytest.raises(OSError, match="No space") as full:
        answer(path, "full")
    assert full.value.errno == 28
    with pytest.raises(RuntimeError, match="KeyError: 'fault'"):
        answer(path, "fault")


def test_a_server_that_was_killed_is_replaced(path: Path) -> None:
    server = answer(path, "read")[0]["parent"]
    os.kill(server, signal.SIGKILL)
    while Path(f"/proc/{server}/stat").is_file() and " Z " not in Path(f"/proc/{server}/stat").read_text():
        time.sleep(0.01)
    assert answer(path, "read")[0]["parent"] != server


def test_a_process_that_was_forked_has_a_server_of_its_own(path: Path) -> None:
    server = answer(path, "read")[0]["parent"]
    reader, writer = os.pipe()
    if os.fork() == 0:
        os.write(writer, str(answer(path, "read")[0]["parent"]).encode())
        limited._stop()
        os._exit(0)
    assert 0 < int(os.read(reader, 20)) != server
    os.wait()
    assert answer(path, "read")[0]["parent"] == server
