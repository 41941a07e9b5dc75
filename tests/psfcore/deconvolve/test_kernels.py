"""Kernels are compiled by another process while a PSF is built, if they are not kept yet."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from psfcore.deconvolve import kernels


class _Process:
    """A process that runs until it is waited for or killed."""

    def __init__(self, command: list[str], **streams: Any) -> None:
        self.command, self.killed, self.status = command, False, None

    def wait(self) -> int:
        self.status = -9 if self.killed else 0
        return self.status

    def poll(self) -> int | None:
        return self.status

    def kill(self) -> None:
        self.killed = True


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[_Process]:
    """The processes that the module started."""
    found: list[_Process] = []

    def start(command: list[str], **streams: Any) -> _Process:
        found.append(_Process(command, **streams))
        return found[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    return found


def test_no_process_is_started_after_a_small_deconvolution(started: list[_Process]) -> None:
    """It leaves the kernels on disk."""
    kernels.compile_kernels("linear", (64, 96))
    with kernels.compiling_beside("linear", (64, 96)):
        pass
    assert started == []


def test_no_process_is_started_where_kernels_cannot_be_kept(
    started: list[_Process], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """This process would have to compile them again."""
    monkeypatch.setattr(kernels, "is_kept", lambda kernel: False)
    monkeypatch.setattr(kernels, "folder_of_kernels", lambda: (tmp_path, False))
    with kernels.compiling_beside("linear", (64, 96)):
        pass
    assert started == []


def test_the_block_waits_for_the_process_and_an_error_ends_it(
    started: list[_Process], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernels, "is_kept", lambda kernel: False)
    with kernels.compiling_beside("linear", (64, 96)):
        (process,) = started
        assert process.command == [sys.executable, "-m", "psfcore.deconvolve.kernels", "linear", "64", "96"]
        assert process.poll() is None
    assert process.poll() == 0
    with pytest.raises(InterruptedError), kernels.compiling_beside("linear", (64, 96)):
        raise InterruptedError
    assert started[1].killed


@pytest.mark.slow  # compiles for some seconds
def test_the_process_compiles_what_a_later_process_needs(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    command = [sys.executable, "-m", "psfcore.deconvolve.kernels", "richardson-lucy", "1024", "1024"]
    subprocess.run(command, check=True)
    kept = set(tmp_path.rglob("*.nbc"))
    subprocess.run(command, check=True)
    assert kept and set(tmp_path.rglob("*.nbc")) == kept
    assert len(list(tmp_path.rglob("*forward_4*"))) == 1, (
        "a row of 1024 px is transformed with 2048 px, 4 x 8 x 8 x 8"
    )
