"""A blind set on disk: its folders, its seals, and the function that makes its cases.

DIR/set.json                  the plan of the set: seed, sizes, number of cases
DIR/cases/NNNN/transit/       the input of the diagnosis of case NNNN
DIR/cases/NNNN/expected/      images without noise, the input of the bound; the diagnosis does not see them
DIR/cases/NNNN/report.json    the report of this diagnosis (gap/3)
DIR/cases/NNNN/bound.json     what a Bayes observer could know (gap-bound/1)
DIR/cases/NNNN/run.json       time and memory of the diagnosis, and the reason if it gave no report
DIR/truth/NNNN.json           salt and truth
DIR/seals.jsonl               one line for each case: {"case", "sha256"}
DIR/score.json, score.txt     the score as JSON and as a table; each run writes them again
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing import get_context, parent_process
from pathlib import Path

from psfcore.arrays import array_sha256
from psfcore.blind.cases import DRAW, SetPlan, draw_case
from psfcore.blind.effects.effect import Plane
from psfcore.blind.make_case import make
from psfcore.errors import DataError
from psfcore.files import write_whole

Progress = Callable[[str], None]

LOCK = "lock"  # the file by which a run locks the folder of its set


@dataclass(frozen=True)
class BlindSet:
    """The folder of a set, and the paths in it."""

    folder: Path

    def case_folder(self, number: int) -> Path:
        """The folder of a case, which contains its transit and, after the diagnosis, its report."""
        return self.folder / "cases" / f"{number:04d}"

    def transit(self, number: int) -> Path:
        """The folder with the transit of a case, the input of the diagnosis."""
        return self.case_folder(number) / "transit"

    def report(self, number: int) -> Path:
        """The file with the report of a case."""
        return self.case_folder(number) / "report.json"

    def expected(self, number: int) -> Path:
        """The folder with the noise-free transits of a case."""
        return self.case_folder(number) / "expected"

    def bound(self, number: int) -> Path:
        """The file that states what a Bayes observer could know about a case."""
        return self.case_folder(number) / "bound.json"

    def truth_file(self, number: int) -> Path:
        """The file with salt and truth of a case."""
        return self.folder / "truth" / f"{number:04d}.json"

    @property
    def seals_file(self) -> Path:
        """The file with the seals of all cases."""
        return self.folder / "seals.jsonl"

    def seals(self) -> dict[int, str]:
        """The seal (SHA-256) of each case, by number. Raises DataError "bad-seals"."""
        if not self.seals_file.is_file():
            return {}
        found: dict[int, str] = {}
        for line in self.seals_file.read_text("utf-8").splitlines():
            try:
                entry = json.loads(line)
                number, seal = int(entry["case"]), str(entry["sha256"])
            except (ValueError, KeyError, TypeError) as error:
                raise DataError(
                    "bad-seals",
                    f"expected lines with a case and its sha256 in {self.seals_file.name}; got {line!r:.60}: make the "
                    "set again in another folder",
                ) from error
            if found.setdefault(number, seal) != seal:
                raise DataError(
                    "bad-seals",
                    f"expected one seal per case; got two for case {number:04d}: make the set again in another folder",
                )
        return found

    def keep_truth(self, number: int, truth: dict[str, object]) -> str:
        """Write the truth of a case with a random salt. Returns its seal."""
        salt = secrets.token_hex(16)
        write_whole(self.truth_file(number), json.dumps({"salt": salt, "truth": truth}, allow_nan=False))
        return _seal_of(salt, truth)

    def keep_seal(self, number: int, seal: str) -> None:
        """Add the seal of a case to the seals, which are replaced as a whole."""
        text = self.seals_file.read_text("utf-8") if self.seals_file.is_file() else ""
        write_whole(self.seals_file, text + json.dumps({"case": number, "sha256": seal}) + "\n")

    def truth(self, number: int) -> dict[str, object]:
        """The truth of a case, after its seal was checked. Raises DataError "broken-seal", "bad-seals"."""
        seal = self.seals().get(number)
        try:
            content = json.loads(self.truth_file(number).read_text("utf-8"))
            salt, truth = str(content["salt"]), dict(content["truth"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(
                "broken-seal", f"case {number:04d}: expected salt and truth; got {error!s:.100}"
            ) from error
        if seal is None or _seal_of(salt, truth) != seal:
            raise DataError(
                "broken-seal",
                f"case {number:04d}: expected a truth with the hash {seal}; this truth was changed after it was "
                "sealed, or it was never sealed",
            )
        return truth

    def is_made(self, number: int) -> bool:
        """Whether a case was made and sealed. Its transit may be missing, because it is deleted after the diagnosis.

        Raises DataError "bad-seals".
        """
        return self.truth_file(number).is_file() and number in self.seals()


def make_set(
    folder: Path,
    plan: SetPlan,
    *,
    scenes: Sequence[Plane] = (),
    processes: int = 1,
    progress: Progress = lambda line: None,
) -> tuple[BlindSet, dict[int, str]]:
    """Make and seal the missing cases of a set. Two results: the set, and for each case that could not be made, the
    reason.

    Raises DataError "other-set" if the folder contains a set that was made with another plan or other scenes,
    "bad-seals", and the errors of `draw_case`: all before the first case is made.

    Parameters
    ----------
    scenes
        Images [y, x] in DN/s, from which scenes are cut.
    """
    blind_set = BlindSet(folder)
    _remember(blind_set, plan, scenes)
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    missing = [number for number in range(plan.cases) if not blind_set.is_made(number)]
    for number in missing:
        draw_case(plan, number)
    not_made: dict[int, str] = {}
    for done, (number, seal, why_not, seconds) in enumerate(
        _attempts(blind_set, plan, missing, scenes, processes), 1
    ):
        so_far = f"in {seconds:.1f} s ({done} of {len(missing)})"
        if why_not:
            not_made[number] = why_not
            progress(f"could not make case {number:04d} {so_far}: {why_not}")
        else:
            blind_set.keep_seal(number, seal)
            progress(f"made case {number:04d} {so_far}")
    return blind_set, not_made


Attempt = tuple[int, str, str, float]  # number of the case; its seal, or why it could not be made; seconds


def _attempts(
    blind_set: BlindSet, plan: SetPlan, numbers: Sequence[int], scenes: Sequence[Plane], processes: int
) -> Iterator[Attempt]:
    """Make cases. The attempts are yielded in the order in which they end."""
    if processes <= 1 or len(numbers) <= 1:
        yield from (_attempt(blind_set, plan, number, scenes) for number in numbers)
        return
    # With the start method "fork", the child processes would inherit locks that threads of this process hold.
    with ProcessPoolExecutor(
        processes, mp_context=get_context("spawn"), initializer=_end_with_parent
    ) as pool:
        waiting = [pool.submit(_attempt, blind_set, plan, number, scenes) for number in numbers]
        for future in as_completed(waiting):
            yield future.result()


def _attempt(blind_set: BlindSet, plan: SetPlan, number: int, scenes: Sequence[Plane]) -> Attempt:
    started = time.perf_counter()
    shutil.rmtree(blind_set.case_folder(number), ignore_errors=True)  # an interrupted run may have left it
    seal, why_not = "", ""
    try:
        truth = make(draw_case(plan, number), blind_set.transit(number), blind_set.expected(number), scenes)
        seal = blind_set.keep_truth(number, truth)
    except DataError as error:
        why_not = f"{error.code}: {error.message}"
    return number, seal, why_not, time.perf_counter() - started


def _end_with_parent() -> None:
    """End this process of the pool when its parent ends. Otherwise it would continue after the parent was killed."""

    def wait() -> None:
        parent = parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _remember(blind_set: BlindSet, plan: SetPlan, scenes: Sequence[Plane]) -> None:
    """Write the plan of the set; if the folder contains a set, check that it has the same plan."""
    own = {"scenes": [array_sha256(scene) for scene in scenes], "draw": DRAW}
    about, file = json.loads(json.dumps(asdict(plan) | own)), blind_set.folder / "set.json"
    if file.is_file():
        before = json.loads(file.read_text("utf-8"))
        if any(before.get(key) != value for key, value in about.items() if key != "cases"):
            raise DataError(
                "other-set",
                f"expected an empty folder, or a set that was made with {about}; {blind_set.folder} contains a set "
                f"that was made with {before}. Choose another folder",
            )
    elif blind_set.folder.is_dir() and (
        others := {path.name for path in blind_set.folder.iterdir()} - {LOCK}
    ):
        raise DataError(
            "other-set",
            f"expected an empty folder, or the folder of a set; {blind_set.folder} contains other files, such as "
            f"{min(others)}, which a set could replace. Choose another folder",
        )
    blind_set.folder.mkdir(parents=True, exist_ok=True)
    write_whole(file, json.dumps(about, indent=1) + "\n")


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Lock the set in this folder against other processes. Raises DataError "set-in-use" if another process uses it."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("w") as held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DataError(
                "set-in-use",
                f"expected a folder that no other run uses; another run uses {folder}: wait until it ends",
            ) from error
        yield


def _seal_of(salt: str, truth: dict[str, object]) -> str:
    """SHA-256 (hex) of a salt and the canonical JSON of a truth."""
    canonical = json.dumps(truth, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256((salt + canonical).encode()).hexdigest()
