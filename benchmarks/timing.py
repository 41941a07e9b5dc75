"""The unit of time of the benchmarks, the shortest time of several runs, the peak memory of a process, and work in
other processes.

The unit 1 F is the time of one 4096 x 4096 float32 rfft2 + irfft2 by SciPy with two workers, measured in the same run.
Other work on the machine slows this and the benchmark equally, so ratios are more reliable than seconds.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

THREADS = os.cpu_count() or 1


def seconds(
    work: Callable[[], object], repeats: int = 1, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Shortest time of several runs, in s."""
    times = []
    for _ in range(repeats):
        start = clock()
        work()
        times.append(clock() - start)
    return min(times)


def reference(clock: Callable[[], float] = time.perf_counter) -> float:
    """1 F, in s; by time.process_time: its processor time."""
    import scipy.fft

    field = np.random.default_rng(0).random((4096, 4096), dtype=np.float32)

    def pair() -> object:
        return scipy.fft.irfft2(scipy.fft.rfft2(field, workers=2), s=field.shape, workers=2)

    return seconds(pair, 5, clock)


def memory_bytes(name: str) -> int:
    """The memory of this process that Linux counts under this name, for example VmHWM (peak) or VmRSS (now), in
    bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(name)).split()[1])


def peak_gib() -> float:
    """Largest resident size of this process, in GiB. (getrusage would include the parent's memory at the fork.)"""
    return memory_bytes("VmHWM") / 2**30


def measured_process(command: Sequence[str], environment: Mapping[str, str]) -> tuple[float, float]:
    """Run a command; its wall time, s, and its largest resident memory, GiB. Raises SystemExit if it fails."""
    start = time.perf_counter()
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment, text=True
    )
    assert process.stdout is not None
    said = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)  # the memory of this process only
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(
            f"expected {' '.join(command)} to succeed; it ended with {process.returncode}: {said}"
        )
    return time.perf_counter() - start, usage.ru_maxrss / 2**20


def answer_of(
    module: str, *words: str, python: str = sys.executable, folder: Path | None = None, **environment: str
) -> Any:
    """The JSON in the last line that a module prints, run in a process of its own with these words.

    python: its interpreter. folder: its working folder. environment: further variables.
    """
    command = [python, "-m", module, *words]
    variables = os.environ | environment
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=folder, env=variables)
    return json.loads(done.stdout.splitlines()[-1])
