"""Thousands of damaged files: each gives a result or an error of the user, within the memory of a small job."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.fuzz.child import KINDS

LONG = dict.fromkeys(KINDS, 20_000)
COUNTS = {"tiles": 40, "headers": 40, "contents": 40, "manifests": 40, "instruments": 6}


def outcomes(counts: dict[str, int], folder: Path) -> dict[str, Counter[str]]:
    """Read the inputs of the first seeds of each kind in a process of its own.

    Fails with the first input that is a fault, or that ended the process; the input is kept in ``folder``.
    """
    tunables = {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=0"}  # so that all fresh memory is filled
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.child", json.dumps(counts), str(folder)],
        cwd=REPOSITORY,
        env=os.environ | tunables | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=120 + sum(counts.values()),  # guards against a hang
    )
    lines = iter(done.stdout.splitlines())
    found = {kind: Counter[str]() for kind in counts}
    for kind, count in counts.items():
        for seed in range(count):
            outcome = next(lines, f"the process ended with {done.returncode}: {done.stderr}")
            if outcome.startswith(("fault ", "the process ")):
                (folder / f"{kind}-{seed}").write_bytes(KINDS[kind][0](seed))
                pytest.fail(f"{kind}, seed {seed}: {outcome}")
            found[kind][outcome] += 1
    return found


def test_damaged_files_give_results_or_errors_of_the_user(tmp_path: Path) -> None:
    for kind, found in outcomes(COUNTS, tmp_path).items():
        assert len(found) > 1, f"{kind}: errors of the user"
        assert found["result"] > 0, f"{kind}: and files that are not damaged much"


@pytest.mark.slow
def test_many_damaged_files_give_results_or_errors_of_the_user(tmp_path: Path) -> None:
    outcomes(LONG, tmp_path)
