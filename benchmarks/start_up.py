"""Compare the times to import the packages and to start the command with their goals; part of `make bench`.

For each case, the processor time (user and system) is printed, and that of a bare Python interpreter.
The cases run in turn, several times, and the minimum of each is used, because another program on the machine can only
make a run slower. The first run of each case is not counted: it reads the files from disk and compiles the modules, as
after an installation.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from tempfile import TemporaryDirectory

from benchmarks.figures import tell
from benchmarks.timing import reference

RUNS = 7
BARE = "pass"
CODE = {
    "import heliopsf": "import heliopsf",
    "import service.app": "import service.app",
    "heliopsf --version": "from service.cli.main import main; main(['--version'])",
}


def processor_s(code: str, compiled: str) -> float:
    """The processor time, s, of a new interpreter that runs `code`. compiled: folder of the compiled modules."""
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": compiled, "PYTHONDONTWRITEBYTECODE": ""}
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"start_up: expected {code!r} to end well; it ended with {process.returncode}")
    return usage.ru_utime + usage.ru_stime


def minima(codes: list[str], runs: int) -> dict[str, float]:
    """The minimum of `processor_s` for each code."""
    best: dict[str, float] = {}
    with TemporaryDirectory(prefix="heliopsf-start-up-") as compiled:
        for run in range(runs + 1):
            for code in codes:
                took_s = processor_s(code, compiled)
                if run:
                    best[code] = min(took_s, best.get(code, took_s))
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=RUNS, help="timed runs of each")
    runs = parser.parse_args().runs
    best = minima([BARE, *CODE.values()], runs)
    print(f"a bare Python interpreter starts in {best[BARE]:.3f} s of processor time; minimum of {runs} runs")
    f_s = reference()
    for what, code in CODE.items():
        tell(what, best[code], f_s)


if __name__ == "__main__":
    main()
