"""Diagnose a blind set. A separate process diagnoses each case and sees only a copy of its transit.

The copy is in a temporary folder whose name does not contain the number of the case. The process runs in this folder.
Its report is copied to the set when it is complete. A case that has a report is not diagnosed again. If a diagnosis
fails, the failure is written to run.json, and the next run tries the case again.

A further process computes the bound of the case, what a Bayes observer could know, from a copy of its images without
noise.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

from psfcore.blind.case_set import BlindSet, Progress
from psfcore.errors import DataError
from psfcore.files import write_whole

# For each schema, the keys that a complete result has.
REPORT_SCHEMA, BOUND_SCHEMA = "gap/3", "gap-bound/1"
_KEYS = {REPORT_SCHEMA: {"verdict", "causes"}, BOUND_SCHEMA: {"causes"}}
LONGEST_S = 1800.0
_KIB = 1024
_LAST_WORDS = 2000


@dataclass(frozen=True)
class Run:
    """One run of a program: its wall time, its largest memory and its exit status.

    Attributes
    ----------
    error
        The reason why the program gave no result; empty: the program gave one.
    """

    case: int
    wall_s: float
    peak_mib: float
    status: int
    error: str = ""


def run_set(
    blind_set: BlindSet,
    numbers: Sequence[int],
    diagnosis: Sequence[str],
    *,
    bound: Sequence[str] = (),
    processes: int = 1,
    keep: bool = False,
    longest_s: float = LONGEST_S,
    progress: Progress = lambda line: None,
) -> list[Run]:
    """Diagnose the cases that have no report yet. Returns one run for each of these cases, in the order of `numbers`.

    Raises DataError "bad-seals", and "not-sealed" if a case has no seal.

    Parameters
    ----------
    diagnosis
        The program that diagnoses a transit, and its first arguments. Two arguments are added: the folder of the
        transit, and the file into which the program writes the report.
    bound
        The program that computes the bound, and its first arguments. Two arguments are added: the folder of the images
        without noise, and the file into which the program writes the bound. If it fails, the diagnosis is not affected,
        and the next run tries it again. Empty: no bound is computed.
    processes
        Number of diagnoses at the same time.
    keep
        Whether to keep the images of a case after their use.
    longest_s
        The longest time of a program, s; a program that takes longer is killed.
    """
    for number in numbers:
        if not blind_set.is_made(number):
            raise DataError(
                "not-sealed",
                f"case {number:04d}: expected a truth that was sealed before the diagnosis; got no seal: make the "
                "case again",
            )

    def result(number: int, program: Sequence[str], folder: Path, file: Path, schema: str) -> Run | None:
        """Run a program if its result is missing. Its images are deleted after their use."""
        if not program or not folder.is_dir():
            return None
        run = None
        if result_in(file, schema) is None:
            run = _run(number, program, folder, file, schema, longest_s)
            what = f"no {file.stem}: {run.error.splitlines()[-1]:.100}" if run.error else f"{file.stem} made"
            progress(f"case {number:04d}: {what}, {run.wall_s:.1f} s, {run.peak_mib:.0f} MiB")
        if not keep and not (run and run.error):
            shutil.rmtree(folder)
        return run

    def one(number: int) -> Run | None:
        run = result(number, diagnosis, blind_set.transit(number), blind_set.report(number), REPORT_SCHEMA)
        if run is not None:
            write_whole(blind_set.case_folder(number) / "run.json", json.dumps(asdict(run), indent=1))
        result(number, bound, blind_set.expected(number), blind_set.bound(number), BOUND_SCHEMA)
        return run

    with ThreadPoolExecutor(max(1, processes)) as pool:
        return [run for run in pool.map(one, numbers) if run is not None]


def run_of(blind_set: BlindSet, number: int) -> Run | None:
    """The last diagnosis of a case; None if there was none."""
    file = blind_set.case_folder(number) / "run.json"
    return Run(**json.loads(file.read_text("utf-8"))) if file.is_file() else None


def result_in(file: Path, schema: str) -> dict[str, object] | None:
    """The complete result of this schema in a file; None if there is none.

    Parameters
    ----------
    schema
        The schema: REPORT_SCHEMA or BOUND_SCHEMA.
    """
    try:
        found = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    whole = isinstance(found, dict) and found.get("schema") == schema and found.keys() >= _KEYS[schema]
    return found if whole else None


def _run(number: int, program: Sequence[str], folder: Path, file: Path, schema: str, longest_s: float) -> Run:
    """Run a program on a copy of a folder of a case. If its result is complete, it is written to the file."""
    with tempfile.TemporaryDirectory(prefix=f"{folder.name}-") as temporary:
        source, result = Path(temporary) / folder.name, Path(temporary) / file.name
        shutil.copytree(folder, source)
        command = (*program, str(source), str(result))
        status, wall_s, peak_mib, said = _watched(command, Path(temporary), longest_s)
        error = f"exit status {status}: {said}" if status else ""
        if not error and result_in(result, schema) is None:
            text = result.read_text("utf-8", errors="replace") if result.is_file() else "no file"
            error = f"expected a result of schema {schema} with {' and '.join(sorted(_KEYS[schema]))}; got {text:.80}"
        if not error:
            write_whole(file, result.read_text("utf-8"))
        return Run(number, wall_s, peak_mib, status, error)


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
