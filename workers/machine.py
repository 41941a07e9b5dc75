"""The memory, the cores and the cache of built PSFs that this process may use. A container may limit memory and cores.

Commands with ``--local`` and the Python functions share the cache of a user.
This module needs no other module of ``workers``, so that the package ``heliopsf`` can import it alone.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from psfcore.errors import DataError
from psfcore.files import cache_folder
from psfcore.psf_cache import PsfCache

CGROUPS = Path("/sys/fs/cgroup")
MEMBERSHIP = Path("/proc/self/cgroup")
MEMINFO = Path("/proc/meminfo")
LARGEST = "HELIOPSF_CACHE_MIB"
DEFAULT_MIB = 2048  # about 15 PSFs of 2048 px with their components
_PSFS, _PUBLISHED = (
    "psfs",
    "published",
)  # a separate subfolder, because the cache makes its folder inaccessible to other users


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_bytes(cgroups: Path = CGROUPS, membership: Path = MEMBERSHIP) -> int:
    """Memory that this process may use, bytes: the smallest of the machine's memory and the limits of its cgroups.

    Parameters
    ----------
    cgroups
        The folder in which the system shows the limits of cgroups.
    membership
        The file that names the cgroups of this process.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([machine, *(cgroup.limit for cgroup in _limits(cgroups, membership))])


def free_bytes(cgroups: Path = CGROUPS, membership: Path = MEMBERSHIP, meminfo: Path = MEMINFO) -> int:
    """Memory that this process may use in addition to what it holds, bytes. Caches that the system can drop are free.

    Parameters
    ----------
    cgroups, membership
        The same folder and file as for ``memory_bytes``.
    meminfo
        The file in which the system shows its free memory; without this file, all memory counts as free.
    """
    shown = re.search(r"^MemAvailable:\s*(\d+) kB$", _text(meminfo), re.MULTILINE)
    machine = memory_bytes(cgroups, membership) if shown is None else 1024 * int(shown[1])
    return max(0, min([machine, *(cgroup.free for cgroup in _limits(cgroups, membership))]))


@dataclass(frozen=True)
class _Version:
    """The files of a version of cgroups: the limit, the memory in use, and the entry of memory.stat with the caches."""

    limit: str
    used: str
    caches: str


_V1 = _Version("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_V2 = _Version("memory.max", "memory.current", "inactive_file")


@dataclass(frozen=True)
class _Cgroup:
    """A cgroup with a memory limit, bytes."""

    folder: Path
    version: _Version
    limit: int

    @property
    def free(self) -> int:
        """The limit minus the memory in use; file caches that can be dropped are free."""
        used = _text(self.folder / self.version.used).strip()
        caches = re.search(
            rf"^{self.version.caches} (\d+)$", _text(self.folder / "memory.stat"), re.MULTILINE
        )
        return self.limit - (int(used) if used.isdecimal() else 0) + (int(caches[1]) if caches else 0)


def _limits(cgroups: Path, membership: Path) -> Iterator[_Cgroup]:
    """The memory limits of the cgroups of this process and of the cgroups above them, in both versions of cgroups."""
    for line in _text(membership).splitlines():
        number, controllers, path = line.split(":", 2)
        if number == "0":
            top, version = cgroups, _V2
        elif "memory" in controllers.split(","):
            top, version = cgroups / "memory", _V1
        else:
            continue
        # Inside a container this may be a path of the host. The container then shows only the limits of its uppermost
        # folder.
        below = Path(path.lstrip("/"))
        for folder in (below, *below.parents):
            limit = _text(top / folder / version.limit).strip()
            if limit.isdecimal():  # the text is "max" without a limit
                yield _Cgroup(top / folder, version, int(limit))


def _text(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:  # this system has no cgroups, or this cgroup has no such limit
        return ""


def psf_cache() -> PsfCache:
    """The cache in the folder that HELIOPSF_CACHE_DIR names, or in the user's cache folder, such as
    ``~/.cache/heliopsf``.

    Raises DataError "bad-setting" if HELIOPSF_CACHE_MIB is not a whole number.
    """
    largest = os.environ.get(LARGEST) or str(DEFAULT_MIB)
    if not (largest.isascii() and largest.isdigit()):
        raise DataError(
            "bad-setting", f"{LARGEST}: expected a whole number of MiB, 0 for no cache; got {largest!r}"
        )
    return PsfCache(cache_folder() / _PSFS, int(largest) * 2**20)


def published_folder() -> Path:
    """The folder of published PSFs (`psfcore.published_psfs`), beside the cache of built PSFs. Users may share it."""
    return cache_folder() / _PUBLISHED
