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

LONG = 20_000
COUNTS = {"tiles": 200, "headers": 200, "manifests": 200, "instruments": 20}


def outcomes(kind: str, count: int, folder: Path) -> Counter[str]:
    """Read the inputs of the first seeds in a process of its own.

    Fails with the first input that is a fault, or that ended the process; the input is kept in ``folder``.
    """
    tunables = {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=0"}  # so that all fresh memory is filled
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.child", kind, str(count), str(folder)],
        cwd=REPOSITORY,
        env=os.environ | tunables | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=60 + count,  # guards against a hang
    )
    found = Counter[str]()
    for seed, line in enumerate(done.stdout.splitlines()):
        if line.startswith("fault "):
            (folder / f"{kind}-{seed}").write_bytes(KINDS[kind][0](seed))
            pytest.fail(f"seed {seed}: {json.loads(line.removeprefix('fault '))}")
        found[line] += 1
    if found.total() < count:
        (folder / f"{kind}-{found.total()}").write_bytes(KINDS[kind][0](found.total()))
        pytest.fail(f"seed {found.total()} ended the process, status {done.returncode}: {done.stderr}")
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_give_results_or_errors_of_the_user(kind: str, tmp_path: Path) -> None:
    found = outcomes(kind, COUNTS[kind], tmp_path)
    assert len(found) > 1, "errors of the user"
    assert found["result"] > 0, "and files that are not damaged much"


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files_give_results_or_errors_of_the_user(kind: str, tmp_path: Path) -> None:
    outcomes(kind, LONG, tmp_path)
