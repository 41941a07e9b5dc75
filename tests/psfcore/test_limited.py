"""A function that reads a file of strangers may do what it likes in its process: the caller gets an answer or an
error."""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import socket
import stat
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import pytest
from astropy.io import fits

from psfcore import limited
from psfcore.errors import DataError, HeaderError
from psfcore.limited import run_limited, scratch_file
from psfcore.wall import walls

MIB = 2**20


def work(target: BinaryIO, *, path: str, kind: str) -> dict[str, Any]:
    """What the child does."""
    if kind == "crash":
        ctypes.string_at(0)
    if kind == "spin":
        resource.setrlimit(resource.RLIMIT_CPU, (1, resource.getrlimit(resource.RLIMIT_CPU)[1]))
        while True:
            pass
    if kind == "memory":
        return {"length": len(bytearray(600 * MIB))}
    if kind == "much":
        return {"written": os.pwrite(target.fileno(), b"x", 600 * MIB)}
    if kind == "refuse":
        raise HeaderError("bad-card", "expected a card; got none", {"card": "X"})
    if kind == "fault":
        raise KeyError(kind)
    if kind == "full":
        raise OSError(28, "no space")
    if kind == "hdus":
        fits.HDUList([fits.PrimaryHDU()]).writeto(target)
        return {"is_child": scratch_file().write(b"x") == 1}
    if kind == "wait":
        target.write(str(os.getpid()).encode())
        target.flush()
        time.sleep(600)
    if kind == "once" and not target.tell():  # the first try waits for the signal of the test
        target.write(b"%08d" % os.getpid())
        target.flush()
        time.sleep(3)
    if kind.startswith("wall "):
        return reached(kind.removeprefix("wall "))
    target.write(Path(path).read_bytes()[::-1])
    return {"process": os.getpid(), "parent": os.getppid(), "variables": sorted(os.environ)}


def reached(what: str) -> dict[str, Any]:
    """What the child reaches beyond its wall: empty if it is refused."""
    name, _, place = what.partition(" ")
    try:
        if name == "read":
            return {"found": Path(place).read_bytes()[:10].decode("latin-1")}
        if name == "list":
            return {"found": os.listdir(place)}
        if name == "write":
            Path(place).write_bytes(b"x")
        elif name == "socket":
            socket.create_connection(("127.0.0.1", int(place)), 2)
        elif name == "exec":
            os.execv("/bin/true", ["true"])
        elif name == "signal":
            os.kill(int(place), signal.SIGTERM)
        elif name == "fork":
            if os.fork() == 0:
                os._exit(0)
        elif name == "mode":
            os.chmod(place, 0o666)
        elif name == "owner":
            return {"found": stat.S_ISSOCK(os.fstat(0).st_mode)}
        elif name == "user":
            return {"found": [*os.getresuid(), *os.getresgid(), *os.getgroups()]}
        elif name == "root":
            os.setresuid(0, 0, 0)
        elif name == "thread":
            threading.Thread(target=lambda: None).start()
    except PermissionError:
        return walls()
    return {"found": what}


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


@pytest.mark.parametrize("kind", ["crash", "memory", "spin", "much"])
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


@pytest.mark.skipif(sys.platform != "linux", reason="the wall is made of parts of Linux")
def test_the_child_reaches_its_file_and_nothing_else(path: Path) -> None:
    """The database, the key file and other uploads of this user; a socket; a program; another process."""
    secret = path.with_name("heliopsf.db")
    secret.write_bytes(b"keys")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        others = [f"read {secret}", "read /etc/passwd", f"read /proc/{os.getpid()}/environ"]
        others += [f"list {path.parent}", f"write {path}", f"write {path.parent / 'new'}"]
        beyond = {"files": others, "calls": [f"socket {port}", "exec", f"signal {os.getpid()}"]}
        beyond["calls"] += ["fork", f"mode {secret}"]
        acting = limited.acting(path)
        for what in (one for part, several in beyond.items() if acting[part] for one in several):
            assert answer(path, f"wall {what}")[0] == acting, what
        if not all(acting.values()):
            pytest.skip(f"this kernel has not all parts of the wall: {acting}")
    assert answer(path, "wall thread")[0] == {"found": "thread"}, "libraries may start threads"
    assert answer(path, "wall owner")[0] == {"found": False}, "the socket over which other requests come"
    assert path.read_bytes() == b"abc" and not (path.parent / "new").exists()


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="for a service that runs as root")
def test_the_child_of_root_is_another_user(path: Path) -> None:
    """It still reads a file that only root may read."""
    if not limited.acting(path)["user"]:
        pytest.skip("this machine lets root become no other user")
    path.chmod(0o600)
    path.parent.chmod(0o700)
    assert answer(path, "read")[1] == b"cba"
    users = answer(path, "wall user")[0]["found"]
    assert len(users) == 6 and 0 not in users, "no further groups"
    assert answer(path, "wall root")[0] == limited.acting(path), "it cannot become root again"


def test_what_libraries_do_once_is_done_before_there_is_a_wall(path: Path) -> None:
    """For its first HDU list astropy makes a file of its own; a scratch file behind the wall is in memory."""
    about, content = answer(path, "hdus")
    assert about["is_child"] and content.startswith(b"SIMPLE")


def child_of(target: BinaryIO) -> int:
    """The process that writes its number to a file."""
    for _ in range(2000):
        content = os.pread(target.fileno(), 20, 0)
        if content:
            return int(content)
        time.sleep(0.01)
    raise AssertionError("no child")


def test_a_child_that_is_killed_from_outside_is_tried_again(path: Path) -> None:
    """An honest file is not blamed; if it happens again and again, the error is one of the system."""
    with TemporaryFile() as target, ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(run_limited, work, path, target, pixels=10, kind="once")
        os.kill(child_of(target), signal.SIGKILL)
        time.sleep(0.2)
        about = waiting.result()
        assert about["process"] and os.pread(target.fileno(), 20, 0).endswith(b"cba")
    with TemporaryFile() as target, ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(run_limited, work, path, target, pixels=10, kind="wait")
        for _ in range(limited.TRIES):
            os.kill(child_of(target), signal.SIGKILL)
            time.sleep(0.3)
        with pytest.raises(OSError, match="ended from outside"):
            waiting.result()


def test_a_child_that_was_stopped_does_not_hold_its_caller(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limited, "PATIENCE_S", 2.0)
    with TemporaryFile() as target, ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(run_limited, work, path, target, pixels=10, kind="wait")
        child = child_of(target)
        os.kill(child, signal.SIGSTOP)
        with pytest.raises(TimeoutError):
            waiting.result()
        os.kill(child, signal.SIGKILL)


def test_a_process_without_open_files_left_is_told_so(path: Path) -> None:
    answer(path, "read")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with TemporaryFile() as target:
        free = os.dup(target.fileno())  # the lowest number that is free
        os.close(free)
        resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))
        try:
            with pytest.raises(OSError, match="Too many open files"):
                run_limited(work, path, target, pixels=10, kind="read")
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_fork_beside_a_held_lock_reads_files(path: Path) -> None:
    held, go = threading.Event(), threading.Event()

    def hold() -> None:
        with limited._lock:
            held.set()
            go.wait(20)

    holder = threading.Thread(target=hold)
    holder.start()
    held.wait(20)
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        good = answer(path, "read")[1] == b"cba"
        limited._stop()
        os._exit(0 if good else 1)
    go.set()
    holder.join()
    assert os.waitpid(child, 0)[1] == 0
