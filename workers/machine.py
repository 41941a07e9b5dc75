"""The memory and the cores that this process may use. A container may limit them to a part of the machine."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
MEMBERSHIP = Path("/proc/self/cgroup")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_bytes(cgroups: Path = CGROUPS, membership: Path = MEMBERSHIP) -> int:
    """Memory that this process may use, bytes: the smallest of the machine's memory and the limits of its cgroups.

    cgroups: where the system shows the limits of cgroups. membership: the file that names the cgroups of this process.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([machine, *_limits(cgroups, membership)])


def _limits(cgroups: Path, membership: Path) -> Iterator[int]:
    """The memory limits of the cgroups of this process and of the cgroups above them, in both versions of cgroups."""
    for line in _text(membership).splitlines():
        number, controllers, path = line.split(":", 2)
        if number == "0":
            top, file = cgroups, "memory.max"
        elif "memory" in controllers.split(","):
            top, file = cgroups / "memory", "memory.limit_in_bytes"
        else:
            continue
        # Inside a container this may be a path of the host. The container then shows only the limits of its uppermost
        # folder.
        below = Path(path.lstrip("/"))
        for folder in (below, *below.parents):
            limit = _text(top / folder / file).strip()
            if limit.isdecimal():  # the text is "max" without a limit
                yield int(limit)


def _text(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:  # this system has no cgroups, or this cgroup has no such limit
        return ""
