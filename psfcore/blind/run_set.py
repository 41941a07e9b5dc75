"""Diagnose a blind set. A separate process diagnoses each case and sees only a copy of its transit.

The copy is in a temporary folder whose name does not contain the number of the case. The process runs in this folder. Its
report is copied to the set when it is complete. A case that has a report is not diagnosed again. If a diagnosis fails, the
failure is written to run.json, and the next run tries the case again.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from psfcore.blind.case_set import BlindSet
from psfcore.blind.scoring import Judged
from psfcore.errors import DataError
from psfcore.whole_files import write_whole

REPORT_SCHEMA = "gap/1"
LONGEST_S = 1800.0
_KIB = 1024
_LAST_WORDS = 2000

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Run:
    """One diagnosis: its wall time, its largest memory and its exit status. error: the reason if it gave no report."""

    case: int
    wall_s: float
    peak_mib: float
    status: int
    error: str = ""

    @property
    def failed(self) -> bool:
        """Whether the diagnosis gave no report."""
        return self.status != 0 or bool(self.error)


def run_set(
    made: BlindSet,
    numbers: Sequence[int],
    command: Sequence[str],
    *,
    processes: int = 1,
    keep: bool = False,
    longest_s: float = LONGEST_S,
    progress: Progress = lambda line: None,
) -> list[Run]:
    """Diagnose the cases that have no report yet. Returns one run for each of these cases, in the order of `numbers`.

    command: a program and its arguments; {transit} and {report} stand for the paths. processes: number of diagnoses at the
    same time. keep: whether to keep a transit after its diagnosis. longest_s: a diagnosis that takes longer is killed.
    Raises DataError "bad-command", "bad-seals", and "not-sealed" if a case has no seal.
    """
    if not all(any(mark in part for part in command) for mark in ("{transit}", "{report}")):
        raise DataError(
            "bad-command", f"expected {{transit}} and {{report}} in the command; got {' '.join(command)}"
        )
    for number in numbers:
        if not made.is_made(number):
            raise DataError(
                "not-sealed",
                f"case {number:04d}: expected a truth that was sealed before the diagnosis; got no seal: make the case again",
            )
    missing = [number for number in numbers if not has_report(made, number)]

    def one(number: int) -> Run:
        run = _diagnose(made, number, command, longest_s)
        if not run.failed and not keep:
            shutil.rmtree(made.transit(number))
        what = f"failed: {run.error.splitlines()[-1]:.100}" if run.failed else "diagnosed"
        progress(f"case {number:04d} {what}, {run.wall_s:.1f} s, {run.peak_mib:.0f} MiB")
        return run

    with ThreadPoolExecutor(max(1, processes)) as pool:
        return list(pool.map(one, missing))


def has_report(made: BlindSet, number: int) -> bool:
    """Whether a case has a complete report."""
    try:
        report_of(made, number)
    except DataError:
        return False
    return True


def report_of(made: BlindSet, number: int) -> dict[str, Any]:
    """The report of a case. Raises DataError "bad-report" if it is missing or incomplete."""
    return _checked_report(made.report(number))


def run_of(made: BlindSet, number: int) -> Run | None:
    """The last diagnosis of a case; None if there was none."""
    file = made.case_folder(number) / "run.json"
    return Run(**json.loads(file.read_text("utf-8"))) if file.is_file() else None


def judged_cases(made: BlindSet, numbers: Sequence[int]) -> tuple[list[Judged], dict[int, str]]:
    """Two results: the cases that have a report; the reasons why the other cases have none, by number.

    Each truth is read, and its seal is checked.
    Raises DataError "broken-seal", "bad-seals".
    """
    judged, failures = [], {}
    for number in numbers:
        truth, run = made.truth(number), run_of(made, number)
        try:
            report = report_of(made, number)
        except DataError as error:
            failures[number] = run.error if run is not None and run.failed else error.message
            continue
        judged.append(Judged(number, truth, report, run.wall_s if run else 0.0))
    return judged, failures


def _checked_report(file: Path) -> dict[str, Any]:
    try:
        report = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(
            "bad-report", f"expected a report of schema {REPORT_SCHEMA}; got {error!s:.120}"
        ) from error
    if not isinstance(report, dict) or report.get("schema") != REPORT_SCHEMA or "verdict" not in report:
        raise DataError("bad-report", f"expected schema {REPORT_SCHEMA} and a verdict; got {report!s:.80}")
    return report


def _diagnose(made: BlindSet, number: int, command: Sequence[str], longest_s: float) -> Run:
    with tempfile.TemporaryDirectory(prefix="transit-") as temporary:
        transit, report = Path(temporary) / "transit", Path(temporary) / "report.json"
        shutil.copytree(made.transit(number), transit)
        filled = [
            part.replace("{transit}", str(transit)).replace("{report}", str(report)) for part in command
        ]
        status, wall_s, peak_mib, said = _watched(filled, Path(temporary), longest_s)
        error = ""
        if status:
            error = f"exit status {status}: {said}"
        else:
            try:
                _checked_report(report)
            except DataError as problem:
                error = problem.message
        run = Run(number, wall_s, peak_mib, status, error)
        folder = made.case_folder(number)
        write_whole(folder / "run.json", json.dumps(asdict(run), indent=1))
        if not run.failed:
            write_whole(made.report(number), report.read_text("utf-8"))
        return run


def _watched(command: Sequence[str], folder: Path, longest_s: float) -> tuple[int, float, float, str]:
    """Exit status, wall time (s), largest resident memory (MiB) and last output of a child process."""
    started = time.perf_counter()
    words = folder / "words.txt"
    with words.open("wb") as said:
        child = subprocess.Popen(command, cwd=folder, stdout=said, stderr=subprocess.STDOUT)
        late = threading.Timer(longest_s, child.kill)
        late.start()
        # wait4 returns the memory of this child; getrusage would return the maximum over all children.
        _, status, usage = os.wait4(child.pid, 0)
        late.cancel()
        child.returncode = os.waitstatus_to_exitcode(status)
    wall_s = time.perf_counter() - started
    text = words.read_text("utf-8", errors="replace")[-_LAST_WORDS:].strip()
    if wall_s >= longest_s:
        text = f"killed after {longest_s:.0f} s. {text}"
    return child.returncode, wall_s, usage.ru_maxrss / _KIB, text or "no output"
