"""The memory that a process may use, what of it is free; the cache of built PSFs, the default data folder, and
settings."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import ValidationError

from psfcore.errors import DataError
from workers.machine import free_bytes, memory_bytes, psf_cache
from workers.settings import Settings

MIB = 2**20
MACHINE = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
LARGE = "MemAvailable: 99999999 kB\n"
# The cgroups of a process, and files of /sys/fs/cgroup that let it have 100 MiB.
LIMITED = (
    ("0::/\n", {"memory.max": "104857600\n"}),
    ("0::/system/heliopsf\n", {"system/memory.max": "104857600\n"}),
    ("0::/a\n", {"a/memory.max": "max\n", "memory.max": "104857600\n"}),
    ("0::/on/the/host\n", {"memory.max": "104857600\n"}),
    ("5:cpu:/x\n4:memory:/x\n0::/\n", {"memory/x/memory.limit_in_bytes": "104857600\n"}),
)
# Both let a process have 100 MiB, of which it uses 90; 30 of these are caches.
CACHES = (
    (
        "0::/a\n",
        {
            "a/memory.max": f"{100 * MIB}",
            "a/memory.current": f"{90 * MIB}\n",
            "a/memory.stat": f"anon 5\nactive_file 7\ninactive_file {30 * MIB}\n",
        },
    ),
    (
        "4:memory:/x\n",
        {
            "memory/x/memory.limit_in_bytes": f"{100 * MIB}",
            "memory/x/memory.usage_in_bytes": f"{90 * MIB}",
            "memory/x/memory.stat": f"inactive_file 1\ntotal_inactive_file {30 * MIB}\n",
        },
    ),
)


def written(folder: Path, membership: str, files: dict[str, str]) -> tuple[Path, Path]:
    """The folder of cgroups, and the file that says in which of them a process is."""
    folder.mkdir(exist_ok=True)
    (folder / "membership").write_text(membership)
    for name, text in files.items():
        file = folder / "cgroups" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return folder / "cgroups", folder / "membership"


def free(folder: Path, membership: str, meminfo: str, files: dict[str, str] | None = None) -> int:
    """The free memory of a process with these cgroups, on a machine with this file meminfo."""
    paths = written(folder, membership, files or {})
    (folder / "meminfo").write_text(meminfo)
    return free_bytes(*paths, folder / "meminfo")


def test_the_smallest_limit_of_the_cgroups_counts(tmp_path: Path) -> None:
    assert memory_bytes(tmp_path / "none", tmp_path / "none") == MACHINE, "without cgroups"
    for number, (membership, files) in enumerate(LIMITED):
        assert memory_bytes(*written(tmp_path / str(number), membership, files)) == 100 * MIB, membership
    above = written(tmp_path / "above", "0::/\n", {"memory.max": str(2**63 - 4096)})
    assert memory_bytes(*above) == MACHINE, "a limit above the memory of the machine is none"


def test_free_memory_is_what_the_system_shows_and_the_cgroup_leaves(tmp_path: Path) -> None:
    assert free(tmp_path / "a", "", "MemTotal: 900 kB\nMemAvailable:    300 kB\n") == 300 * 1024
    assert free(tmp_path / "b", "", "MemTotal: 900 kB\n") == MACHINE, "a system that does not show it"
    for number, (membership, files) in enumerate(CACHES):
        folder = tmp_path / str(number)
        assert free(folder, membership, LARGE, files) == 40 * MIB, "caches are free"
        assert free(folder, membership, "MemAvailable: 1024 kB\n", files) == MIB
    over = {"memory.max": f"{MIB}", "memory.current": f"{2 * MIB}"}
    assert free(tmp_path / "c", "0::/\n", LARGE, over) == 0, "above its limit"
    assert 0 < free_bytes() <= memory_bytes(), "of this machine"


def test_proxies_are_addresses_and_hosts_have_lower_case() -> None:
    assert Settings(allowed_hosts=" Sun.Example.org , *").host_names == ("sun.example.org", "*")
    assert Settings(trusted_proxies="").proxies == ()
    given = Settings(trusted_proxies=" 127.0.0.1, 10.0.0.0/8,::1,").proxies
    assert given == ("127.0.0.1", "10.0.0.0/8", "::1")
    # A name that uvicorn does not know as an address would silently match nothing.
    for wrong in ("*", "proxy.example.org", "10.0.0.1/8", "127.0.0.1 10.0.0.1"):
        with pytest.raises(ValidationError, match="expected IP addresses or networks"):
            Settings(trusted_proxies=wrong)


def test_the_largest_job_follows_from_memory_and_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workers.settings.memory_bytes", lambda: 8 * 2**30)
    monkeypatch.delenv("HELIOPSF_MAX_JOB_MEMORY_MIB", raising=False)
    assert Settings(worker_processes=1).max_job_memory_mib == 6553
    assert Settings(worker_processes=4).max_job_memory_mib == 1638
    monkeypatch.setenv("HELIOPSF_MAX_JOB_MEMORY_MIB", "100000")
    assert Settings().max_job_memory_mib == 100_000


def test_the_cache_is_where_the_variables_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HELIOPSF_CACHE_DIR", str(tmp_path / "here"))
    cache = psf_cache()
    assert cache.folder == tmp_path / "here" / "psfs" and cache.max_bytes == 2**31
    assert not cache.folder.exists(), "looking must not make the folder"
    monkeypatch.delenv("HELIOPSF_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("HELIOPSF_CACHE_MIB", "3")
    assert psf_cache().max_bytes == 3 * 2**20
    assert sys.platform != "linux" or psf_cache().folder == tmp_path / "heliopsf" / "psfs"
    for text in ("-1", "many", "1.5", "٣"):
        monkeypatch.setenv("HELIOPSF_CACHE_MIB", text)
        with pytest.raises(DataError, match="HELIOPSF_CACHE_MIB: expected a whole number"):
            psf_cache()


def test_the_module_loads_nothing_else_of_the_workers() -> None:
    code = "import sys, workers.machine; print('\\n'.join(sys.modules))"
    loaded = set(
        subprocess.run(
            [sys.executable, "-c", code], check=True, capture_output=True, text=True
        ).stdout.split()
    )
    assert {name for name in loaded if name.startswith("workers.")} == {"workers.machine"}
    assert loaded & {"pydantic", "sqlalchemy", "numpy", "celery"} == set()


def test_the_data_folder_does_not_depend_on_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "my data"))
    monkeypatch.delenv("HELIOPSF_DATA_DIR", raising=False)
    first = Settings().data_dir
    monkeypatch.chdir(tmp_path)
    assert first == Settings().data_dir == tmp_path / "my data" / "heliopsf"
