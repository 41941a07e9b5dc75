"""A little of `make chaos`: jobs while what they need is killed, and while the network of a worker is cut."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from studies import chaos
from tests.whole.stack import Missing


@pytest.mark.slow
@pytest.mark.parametrize("redis_keeps", [False, True])
def test_nothing_is_lost_or_made_twice(redis_keeps: bool, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        chaos.run(20, 5, 128, seed=3, redis_keeps=redis_keeps)
    except Missing as missing:
        pytest.skip(str(missing))
    found = dict(line.rsplit(maxsplit=1) for line in capsys.readouterr().out.splitlines()[1:])
    assert found["  jobs"] == found["  products"] == "20"
    assert sum(int(count) for name, count in found.items() if name.startswith("  kills of ")) == 5


@pytest.mark.slow
def test_a_cut_network_and_clocks_apart_lose_nothing_and_repeat_nothing() -> None:
    """In a process of its own, which moves to another network namespace."""
    needed = [name for name in ("ip", "unshare", "cc", "redis-server") if shutil.which(name) is None]
    if sys.platform != "linux" or os.geteuid() != 0 or needed:
        pytest.skip(f"needs Linux, root, and the commands {needed or 'ip, unshare, cc, redis-server'}")
    if subprocess.run(["unshare", "--net", "true"], capture_output=True).returncode:
        pytest.skip("this machine allows no network namespaces")
    options = ["--jobs", "15", "--faults", "4", "--cuts", "1", "--cut-s", "20"]
    done = subprocess.run(
        [sys.executable, "-m", "studies.chaos_network", *options],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )
    if "Missing" in done.stderr:
        pytest.skip(done.stderr.splitlines()[-1])
    assert done.returncode == 0, done.stderr[-3000:]
    assert "products             15" in done.stdout
