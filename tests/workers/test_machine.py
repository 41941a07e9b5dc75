"""The memory that a process may use, and the largest job that follows from it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from workers.machine import memory_bytes
from workers.settings import Settings

GIB = 2**30
MACHINE = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def limited(folder: Path, membership: str, **limits: str) -> int:
    """The memory of a process with these cgroups; limits: texts of files, ``__`` in a name stands for a slash."""
    (folder / "membership").write_text(membership)
    for name, text in limits.items():
        file = folder / "cgroups" / name.replace("__", "/").replace("_dot_", ".")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return memory_bytes(folder / "cgroups", folder / "membership")


def test_without_cgroups_it_is_the_memory_of_the_machine(tmp_path: Path) -> None:
    assert memory_bytes(tmp_path / "none", tmp_path / "none") == MACHINE


@pytest.mark.parametrize(
    ("membership", "limits"),
    [
        ("0::/\n", {"memory_dot_max": "104857600\n"}),
        ("0::/system/heliopsf\n", {"system__memory_dot_max": "104857600\n"}),
        ("0::/a\n", {"a__memory_dot_max": "max\n", "memory_dot_max": "104857600\n"}),
        ("0::/on/the/host\n", {"memory_dot_max": "104857600\n"}),
        ("5:cpu:/x\n4:memory:/x\n0::/\n", {"memory__x__memory_dot_limit_in_bytes": "104857600\n"}),
    ],
)
def test_the_smallest_limit_of_the_cgroups_counts(
    tmp_path: Path, membership: str, limits: dict[str, str]
) -> None:
    assert limited(tmp_path, membership, **limits) == 100 * 2**20


def test_a_limit_above_the_memory_of_the_machine_is_none(tmp_path: Path) -> None:
    assert limited(tmp_path, "0::/\n", memory_dot_max=str(2**63 - 4096)) == MACHINE


@pytest.mark.parametrize(("processes", "expected_mib"), [(1, 6553), (4, 1638)])
def test_the_largest_job_follows_from_memory_and_processes(
    monkeypatch: pytest.MonkeyPatch, processes: int, expected_mib: int
) -> None:
    monkeypatch.delenv("HELIOPSF_MAX_JOB_MEMORY_MIB", raising=False)
    monkeypatch.setattr("workers.settings.memory_bytes", lambda: 8 * GIB)
    assert Settings(worker_processes=processes).max_job_memory_mib == expected_mib


def test_the_operator_may_set_another_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workers.settings.memory_bytes", lambda: 8 * GIB)
    monkeypatch.setenv("HELIOPSF_MAX_JOB_MEMORY_MIB", "100000")
    assert Settings().max_job_memory_mib == 100_000
