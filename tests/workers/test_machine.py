"""The memory that a process may use, and the largest job that follows from it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from workers.machine import free_bytes, memory_bytes
from workers.settings import Settings

GIB = 2**30
MACHINE = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


MIB = 2**20


def limited(folder: Path, membership: str, **limits: str) -> int:
    """The memory of a process with these cgroups; limits: texts of files, ``__`` in a name stands for a slash."""
    _write(folder, membership, limits)
    return memory_bytes(folder / "cgroups", folder / "membership")


def free(folder: Path, membership: str, meminfo: str, **limits: str) -> int:
    """The free memory of a process with these cgroups, on a machine with this file meminfo."""
    _write(folder, membership, limits)
    (folder / "meminfo").write_text(meminfo)
    return free_bytes(folder / "cgroups", folder / "membership", folder / "meminfo")


def _write(folder: Path, membership: str, limits: dict[str, str]) -> None:
    (folder / "membership").write_text(membership)
    for name, text in limits.items():
        file = folder / "cgroups" / name.replace("__", "/").replace("_dot_", ".")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)


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


def test_free_memory_is_what_the_system_shows_without_cgroups(tmp_path: Path) -> None:
    assert free(tmp_path, "", "MemTotal: 900 kB\nMemAvailable:    300 kB\n") == 300 * 1024
    assert free(tmp_path, "", "MemTotal: 900 kB\n") == MACHINE, "a system that does not show it"


@pytest.mark.parametrize(
    ("membership", "limits"),
    [
        (
            "0::/a\n",
            {
                "a__memory_dot_max": f"{100 * MIB}",
                "a__memory_dot_current": f"{90 * MIB}\n",
                "a__memory_dot_stat": f"anon 5\nactive_file 7\ninactive_file {30 * MIB}\n",
            },
        ),
        (
            "4:memory:/x\n",
            {
                "memory__x__memory_dot_limit_in_bytes": f"{100 * MIB}",
                "memory__x__memory_dot_usage_in_bytes": f"{90 * MIB}",
                "memory__x__memory_dot_stat": f"inactive_file 1\ntotal_inactive_file {30 * MIB}\n",
            },
        ),
    ],
)
def test_free_memory_of_a_cgroup_counts_its_caches_as_free(
    tmp_path: Path, membership: str, limits: dict[str, str]
) -> None:
    large = "MemAvailable: 99999999 kB\n"
    assert free(tmp_path, membership, large, **limits) == 40 * MIB
    assert free(tmp_path, membership, "MemAvailable: 1024 kB\n", **limits) == MIB


def test_a_cgroup_above_its_limit_has_no_free_memory(tmp_path: Path) -> None:
    over = {"memory_dot_max": f"{MIB}", "memory_dot_current": f"{2 * MIB}"}
    assert free(tmp_path, "0::/\n", "MemAvailable: 99999999 kB\n", **over) == 0


def test_the_free_memory_of_this_machine_is_a_part_of_its_memory() -> None:
    assert 0 < free_bytes() <= memory_bytes()


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
