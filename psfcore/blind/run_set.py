"""Diagnose a blind set. A separate process diagnoses each case and sees only a copy of its transit.

The copy is in a temporary folder whose name does not contain the number of the case. The process runs in this folder. Its
report is copied to the set when it is complete. A case that has a report is not diagnosed again. If a diagnosis fails, the
failure is written to run.json, and the next run tries the case again.

A further process computes what an ideal observer could know about the case, from its images without noise. These images stay
in the set; the diagnosis runs elsewhere and gets no path of the set.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from psfcore.blind.case_set import BlindSet
from psfcore.blind.scoring import Judged
from psfcore.errors import DataError
from psfcore.whole_files import write_whole

REPORT_SCHEMA = "gap/2"
IDEAL_SCHEMA = "gap-ideal/1"
LONGEST_S = 1800.0
_KIB = 1024
_LAST_WORDS = 2000

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Run:
    """One diagnosis: its wall time, its largest memory and its exit status. error: the reason if the diagnosis gave no
    report."""

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
    ideal: Sequence[str] = (),
    keep: bool = False,
    longest_s: float = LONGEST_S,
    progress: Progress = lambda line: None,
) -> list[Run]:
    """Diagnose the cases that have no report yet. Returns one run for each of these cases, in the order of `numbers`.

    command: a program and its arguments; {transit} and {report} stand for the paths. processes: number of diagnoses at
    the same time. ideal: a program and its arguments; it computes what an ideal observer could know. {expected} and
    {ideal} stand for the paths. If `ideal` is empty, no program is run. If the program fails, the diagnosis is not
    affected, and the next run tries the program again. keep: whether to keep the images of a case after their use.
    longest_s: a process that takes longer is killed. Raises DataError "bad-command", "bad-seals", and "not-sealed" if
    a case has no seal.
    """
    _check(command, ("{transit}", "{report}"))
    if ideal:
        _check(ideal, ("{expected}", "{ideal}"))
    for number in numbers:
        if not made.is_made(number):
            raise DataError(
                "not-sealed",
                f"case {number:04d}: expected a truth that was sealed before the diagnosis; got no seal: make the case again",
            )

    def one(number: int) -> Run | None:
        run = None if has_report(made, number) else _diagnose(made, number, command, longest_s)
        if run is not None:
            if not run.failed and not keep:
                shutil.rmtree(made.transit(number))
            what = f"failed: {run.error.splitlines()[-1]:.100}" if run.failed else "diagnosed"
            progress(f"case {number:04d} {what}, {run.wall_s:.1f} s, {run.peak_mib:.0f} MiB")
        if ideal and made.expected(number).is_dir():
            _compute_ideal(made, number, ideal, keep, longest_s, progress)
        return run

    with ThreadPoolExecutor(max(1, processes)) as pool:
        return [run for run in pool.map(one, numbers) if run is not None]


def _check(command: Sequence[str], marks: Sequence[str]) -> None:
    if not all(any(mark in part for part in command) for mark in marks):
        raise DataError(
            "bad-command", f"expected {' and '.join(marks)} in the command; got {' '.join(command)}"
        )


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


def ideal_of(made: BlindSet, number: int) -> dict[str, Any] | None:
    """What an ideal observer could know about a case (gap-ideal/1); None if it was not computed."""
    return _ideal_in(made.ideal(number))


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
        judged.append(Judged(number, truth, report, run.wall_s if run else 0.0, ideal_of(made, number)))
    return judged, failures


def _checked_report(file: Path) -> dict[str, Any]:
    try:
        report = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(
            "bad-report", f"expected a report of schema {REPORT_SCHEMA}; got {error!s:.120}"
        ) from error
    whole = isinstance(report, dict) and {"verdict", "set"} <= report.keys()
    if not whole or report.get("schema") != REPORT_SCHEMA:
        raise DataError(
            "bad-report", f"expected schema {REPORT_SCHEMA}, a verdict and a set; got {report!s:.80}"
        )
    return report


def _ideal_in(file: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("schema") == IDEAL_SCHEMA else None


def _diagnose(made: BlindSet, number: int, command: Sequence[str], longest_s: float) -> Run:
    with tempfile.TemporaryDirectory(prefix="transit-") as temporary:
        transit, report = Path(temporary) / "transit", Path(temporary) / "report.json"
        shutil.copytree(made.transit(number), transit)
        filled = _filled(command, {"{transit}": transit, "{report}": report})
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


def _compute_ideal(
    made: BlindSet, number: int, command: Sequence[str], keep: bool, longest_s: float, progress: Progress
) -> None:
    """Compute what an ideal observer could know about a case, if ideal.json is missing. Then remove the images without
    noise.

    keep: keep these images. If the computation fails, the images are kept too.
    """
    if ideal_of(made, number) is None:
        with tempfile.TemporaryDirectory(prefix="ideal-") as temporary:
            result = Path(temporary) / "ideal.json"
            paths = {"{expected}": made.expected(number).resolve(), "{ideal}": result}
            status, wall_s, _, said = _watched(_filled(command, paths), Path(temporary), longest_s)
            if status or _ideal_in(result) is None:
                progress(f"case {number:04d} has no ideal observer: {said.splitlines()[-1]:.100}")
                return
            write_whole(made.ideal(number), result.read_text("utf-8"))
            progress(f"case {number:04d}: ideal observer computed, {wall_s:.1f} s")
    if not keep:
        shutil.rmtree(made.expected(number))


def _filled(command: Sequence[str], paths: Mapping[str, Path]) -> list[str]:
    """Replace every mark in a command by its path. paths: the path for each mark."""
    filled = list(command)
    for mark, path in paths.items():
        filled = [part.replace(mark, str(path)) for part in filled]
    return filled


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
