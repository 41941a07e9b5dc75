"""Thousands of damaged files: each gives a result or an error of the user, within the memory and time of a small job."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.fuzz.child import KINDS

HANG_S = 120.0  # guards against a hang; the longest input takes seconds
LONG = 20_000


@dataclass
class Found:
    """The outcomes of a range of seeds. faults: what went wrong, by seed."""

    outcomes: Counter[str] = field(default_factory=Counter)
    faults: dict[int, str] = field(default_factory=dict)
    slowest_s: float = 0.0


def fuzz(kind: str, seeds: range, folder: Path, *, nice: int = 0) -> Found:
    """Read the inputs of these seeds in child processes. A child that dies is replaced, and its input is kept in `folder`."""
    found = Found()
    first = seeds.start
    while first < seeds.stop:
        first = _one_child(kind, range(first, seeds.stop), folder, found, nice)
    for seed in found.faults:
        (folder / f"{kind}-{seed}").write_bytes(KINDS[kind][0](seed))
    return found


def _one_child(kind: str, seeds: range, folder: Path, found: Found, nice: int) -> int:
    """Run a child until it ends; returns the first seed that is left."""
    tunables = {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=0"}  # so that all fresh memory is filled
    arguments = [kind, str(seeds.start), str(seeds.stop), str(folder)]
    child = subprocess.Popen(
        [sys.executable, "-m", "tests.fuzz.child", *arguments],
        cwd=REPOSITORY,
        env=os.environ | tunables | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        preexec_fn=lambda: os.nice(nice),
    )
    assert child.stdout is not None
    lines: queue.Queue[str] = queue.Queue()
    reading = threading.Thread(target=lambda: [*map(lines.put, child.stdout or ()), lines.put("")])
    reading.start()
    at, open_seed, why = seeds.start, None, "the process died"
    try:
        while line := lines.get(timeout=HANG_S):
            word, seed, *rest = line.split(maxsplit=3)
            open_seed = int(seed) if word == "start" else None
            if word == "end":
                at = int(seed) + 1
                found.slowest_s = max(found.slowest_s, float(rest[0]))
                outcome = rest[1].strip()
                found.outcomes[outcome.split()[0]] += 1
                if outcome.startswith("fault "):
                    found.faults[int(seed)] = json.loads(outcome.removeprefix("fault "))
    except queue.Empty:
        why = f"no end within {HANG_S:g} s"
    finally:
        child.kill()
        status = child.wait()
        reading.join()
        child.stdout.close()
    if open_seed is None and at < seeds.stop:
        raise RuntimeError(
            f"expected the child to read seeds {seeds.start} to {seeds.stop}; it ended at {at} with {status}"
        )
    if open_seed is not None:
        found.faults[open_seed] = f"{why}, status {status}"
        found.outcomes["died"] += 1
        at = open_seed + 1
    return at


COUNTS = {"tiles": 300, "headers": 300, "manifests": 300, "instruments": 20}


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_give_results_or_errors_of_the_user(kind: str, tmp_path: Path) -> None:
    found = fuzz(kind, range(COUNTS[kind]), tmp_path)
    assert found.faults == {}
    assert found.outcomes.total() == COUNTS[kind]
    assert len(found.outcomes) > 1, "errors of the user"
    assert found.outcomes["result"] > 0, "and files that are not damaged much"


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files_give_results_or_errors_of_the_user(kind: str, tmp_path: Path) -> None:
    found = fuzz(kind, range(LONG), tmp_path)
    assert found.faults == {}
    assert found.outcomes.total() == LONG
