"""Plant 40 faults in the code, one at a time, and measure how many of them the tests find.

    python -m studies.planted [--only NAME ...] [--check] [--limit-s 600] [-o RESULT.json] [--compare RESULT.json]

A fault is a mistake that a reviewer would fear: a wrong sign, a lost condition, a unit, a limit that is off by one. It is a
patch of one or two lines. The study copies the checkout to a temporary folder, and changes only the copy. For each fault it
applies the patch there and runs the tests of the fault's room (and then, if these find nothing, further tests) until one
fails. Slow tests are not run. For each fault it prints one line: the state, the name, the first test that fails, and the
seconds.

The states: found: a test fails. not found: all tests pass. no answer: the tests took longer than the limit. error: the patch
does not apply exactly once, a test does not exist, no test ran, the tests could not be collected, or the test that fails also
fails without the fault. The exit status is 1 if a fault has the state error.

--check runs no tests: it verifies that every patch applies exactly once, and that all named tests exist. --compare names the
faults that were found in an earlier result and are not found now; the exit status is then 1.

The faults were chosen without regard to what the tests cover. Those that no test finds stay in the table. No fault is in a
file that defines kernels (`psfcore.compiled`), because all kernels would be compiled again.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from psfcore.whole_files import write_whole

ROOT = Path(__file__).parents[1]
SHARED = "HELIOPSF_SHARED"
LIMIT_S = 600.0
CONTROL_LIMIT_S = 3600.0
PATIENCE_S = 30.0  # after SIGINT, the tests may end their servers
FAILURE = re.compile(r"^(?:FAILED|ERROR) (\S+?::[^\[\n]+?(?:\[.*?\])?)(?: - .*)?$", re.MULTILINE)

State = Literal["found", "not found", "no answer", "error"]


@dataclass(frozen=True)
class Fault:
    """A mistake in one file.

    old: a text that occurs once in the file. new: the text in its place. tests: files and folders of tests of the room, which
    are run first. then: tests that are run if the first ones find nothing.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    then: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """The answer of the tests to a fault. test: the first test that fails; in the state error, the reason of the error."""

    state: State
    test: str
    seconds: float


FAULTS = (
    # psfcore
    Fault("convolution-farthest-offset-lost", "psfcore/convolution/offsets.py",
          "min(kernel_size, centre + field_size)", "min(kernel_size, centre + field_size - 1)",
          ("tests/psfcore/convolution",)),
    Fault("convolution-centre-of-odd-kernels", "psfcore/convolution/convolver.py",
          "shift = p // 2 + q // 2 - n // 2", "shift = (p + q) // 2 - n // 2",
          ("tests/psfcore/convolution",), ("tests/psfcore/diffraction",)),
    Fault("deconvolve-edge-share-counts-own-pixel", "psfcore/deconvolve/edges.py",
          "beyond = line[centre + 1 :]", "beyond = line[centre:]",
          ("tests/psfcore/deconvolve/test_deconvolve.py",), ("tests/psfcore/deconvolve",)),
    Fault("deconvolve-read-noise-not-squared", "psfcore/deconvolve/stopping.py",
          "np.float32((read_noise / domain.scale) ** 2)", "np.float32(read_noise / domain.scale)",
          ("tests/psfcore/deconvolve/test_deconvolve.py",), ("tests/psfcore/deconvolve",)),
    Fault("deconvolve-same-noise-in-every-draw", "psfcore/deconvolve/assess/error_planes.py",
          "np.random.default_rng([seed, k])", "np.random.default_rng(seed)",
          ("tests/psfcore/deconvolve/assess/test_error_planes.py",), ("tests/psfcore/deconvolve",)),
    Fault("deconvolve-near-masked-radius-short", "psfcore/deconvolve/assess/quality.py",
          "if dy**2 + dx**2 <= radius_px**2", "if dy**2 + dx**2 < radius_px**2",
          ("tests/psfcore/deconvolve/assess/test_quality.py",), ("tests/psfcore/deconvolve",)),
    Fault("deconvolve-region-shares-inverted", "psfcore/deconvolve/region.py",
          "* light.kept - light.light) / light.shares", "* light.kept - light.light) * light.shares",
          ("tests/psfcore/deconvolve/test_region.py",), ("tests/service/api/test_products.py",)),
    Fault("fits-saturation-level-itself-unmasked", "psfcore/fits/saturation.py",
          "mask[image.pixels >= level]", "mask[image.pixels > level]",
          ("tests/psfcore/fits/test_saturation.py",), ("tests/psfcore/fits",)),
    Fault("fits-psf-centre-half-a-pixel-off", "psfcore/fits/psfs.py",
          "(size // 2 + 1.0, ", "(size / 2 + 0.5, ",
          ("tests/psfcore/fits/test_psfs.py",), ("tests/psfcore/fits", "tests/psfcore/test_build.py")),
    Fault("fits-short-file-accepted", "psfcore/fits/blocks.py",
          "there = self._left(count)", "there = count",
          ("tests/psfcore/fits/test_header.py", "tests/psfcore/fits/test_images.py"), ("tests/psfcore/fits",)),
    Fault("fits-size-limit-per-axis", "psfcore/fits/blocks.py",
          "if nx * ny > limits.max_pixels:", "if max(nx, ny) > limits.max_pixels:",
          ("tests/psfcore/fits/test_header.py", "tests/psfcore/fits/test_images.py"), ("tests/psfcore/fits", "tests/fuzz")),
    Fault("diffraction-weights-of-lines-ignored", "psfcore/diffraction/combined.py",
          "kernel = line.weight * kernel", "kernel = kernel / len(lines)",
          ("tests/psfcore/diffraction",), ("tests/psfcore/test_build.py",)),
    Fault("diffraction-mirror-path-not-doubled", "psfcore/diffraction/fresnel.py",
          "1j * sign * 4 * np.pi / grid.wavelength_mm", "1j * sign * 2 * np.pi / grid.wavelength_mm",
          ("tests/psfcore/diffraction/test_fresnel.py",)),
    Fault("scatter-weight-by-sigma-not-variance", "psfcore/scatter/reconstruction.py",
          "1 / transit.noise.variance(level, transit.frames[n].exposure_s)",
          "1 / np.sqrt(transit.noise.variance(level, transit.frames[n].exposure_s))",
          ("tests/psfcore/scatter/test_inversion.py",), ("tests/psfcore/scatter/test_fit.py", "tests/psfcore/scatter/validation")),
    Fault("scatter-interpolated-covariance-not-squared", "psfcore/scatter/interpolation.py",
          "(1 - weight) ** 2 * c0 + weight**2 * c1 + course", "(1 - weight) * c0 + weight * c1 + course",
          ("tests/psfcore/scatter/test_interpolation.py",)),
    Fault("transit-occulter-half-a-pixel-off", "psfcore/transit/occulter.py",
          "np.arange(columns.start, columns.stop + 1) - 0.5 - place.x_px",
          "np.arange(columns.start, columns.stop + 1) - place.x_px",
          ("tests/psfcore/transit/test_occulter.py",), ("tests/psfcore/transit",)),
    Fault("transit-member-climbs-later", "psfcore/transit/admission.py",
          'or ".." in parts\n', 'or ".." in parts[:1]\n',
          ("tests/psfcore/transit/test_archive.py",), ("tests/fuzz",)),
    Fault("transit-guard-one-image-short", "psfcore/transit/transit.py",
          "k > last + guard", "k >= last + guard",
          ("tests/psfcore/transit/test_transit.py",), ("tests/psfcore/scatter/validation",)),
    Fault("simulate-photons-counted-in-dn", "psfcore/noise.py",
          "rng.poisson(exposure_dn / self.photon_gain_dn) * self.photon_gain_dn", "rng.poisson(exposure_dn)",
          ("tests/psfcore/simulate/test_simulate.py",), ("tests/psfcore/simulate",)),
    Fault("flare-error-of-mean-not-of-count", "psfcore/flare/arm_profile.py",
          "np.sqrt(np.bincount(member, variance[rows, columns])) / count",
          "np.sqrt(np.bincount(member, variance[rows, columns]) / count)",
          ("tests/psfcore/flare/test_arm_profile.py",), ("tests/psfcore/flare",)),
    Fault("gap-sign-of-nonlinearity", "psfcore/gap/library/detector.py",
          "np.asarray(-images[n] * np.exp(", "np.asarray(images[n] * np.exp(",
          ("tests/psfcore/gap/library",), ("tests/psfcore/gap/test_diagnose.py",)),
    Fault("gap-closure-keeps-noise", "psfcore/gap/verdict/closure.py",
          "value = 1 - float((chi2_after - nu).sum()) / total", "value = 1 - float(chi2_after.sum()) / total",
          ("tests/psfcore/gap/verdict/test_closure.py",), ("tests/psfcore/gap/verdict", "tests/psfcore/gap/test_diagnose.py")),
    Fault("gap-prior-of-each-pair-undivided", "psfcore/gap/verdict/posterior.py",
          "math.log(PRIOR[kind] / max(count.get(kind, 1), 1))", "math.log(PRIOR[kind])",
          ("tests/psfcore/gap/verdict",), ("tests/psfcore/gap/test_diagnose.py",)),
    Fault("blind-half-of-a-pair-counts", "psfcore/blind/judged.py",
          "return self.required <= set(hypothesis) and", "return bool(self.required & set(hypothesis)) and",
          ("tests/psfcore/blind",)),
    Fault("built-damaged-psf-used", "psfcore/psf_cache.py",
          "if sha256_of(path) == sha256:", "if path.is_file():",
          ("tests/psfcore/test_psf_cache.py",)),
    # workers
    Fault("catalogue-claim-without-compare", "workers/catalogue/jobs.py",
          "update(JobRow).where(JobRow.id == job_id, JobRow.phase == Phase.QUEUED)", "update(JobRow).where(JobRow.id == job_id)",
          ("tests/workers/catalogue/test_catalogue.py",), ("tests/workers/catalogue", "tests/workers/run/test_equal_jobs.py")),
    Fault("run-heart-stops-after-one-database-error", "workers/run/attempt.py",
          'could not write the heartbeat: %s", self.lease.job_id, error)\n                continue',
          'could not write the heartbeat: %s", self.lease.job_id, error)\n                return',
          ("tests/workers/run",)),
    Fault("files-hash-not-compared", "workers/files/store.py",
          "found = sha256_of(path)\n", "found = path.name\n",
          ("tests/workers/files/test_store.py",), ("tests/service/test_disk.py",)),
    Fault("intake-end-of-validity-included", "workers/catalogue/psfs.py",
          "PsfRow.valid_to > filters.valid_at", "PsfRow.valid_to >= filters.valid_at",
          ("tests/workers/catalogue/test_psfs.py", "tests/workers/intake"), ("tests/service/api/test_psfs.py",)),
    Fault("bulk-image-of-a-living-worker-taken", "workers/catalogue/bulks.py",
          "BulkItemRow.state == ItemState.TAKEN, ~held.exists()", "BulkItemRow.state == ItemState.TAKEN",
          ("tests/workers/catalogue/test_bulks.py",), ("tests/workers/bulk",)),
    Fault("contract-diffraction-not-in-identity", "workers/contract/identities.py",
          '            "diffraction": diffraction_identity(request),\n', "",
          ("tests/workers/contract",), ("tests/workers/tasks/test_transit_jobs.py",)),
    Fault("broker-binding-lock-shared", "workers/broker/order.py",
          "fcntl.flock(held, fcntl.LOCK_EX)", "fcntl.flock(held, fcntl.LOCK_SH)",
          ("tests/workers/broker",)),
    # service
    Fault("http-job-of-any-owner", "service/api/jobs.py",
          "if row is None or row.owner != caller.owner:", "if row is None:",
          ("tests/service/http/test_owners.py",), ("tests/service/api/test_images_and_jobs.py",)),
    Fault("http-one-request-too-many-at-once", "service/http/rates.py",
          "if self._open[who] >= self._most:", "if self._open[who] > self._most:",
          ("tests/service/http/test_quotas.py", "tests/service/http/test_guard.py"), ("tests/service/api/test_events.py",)),
    Fault("pages-any-form-token-accepted", "service/http/callers.py",
          "if not hmac.compare_digest(sent.encode(), session.form_token.encode()):", "if not sent:",
          ("tests/service/pages/test_login.py",), ("tests/service/http/test_attacks.py",)),
    Fault("uws-zero-lifts-operators-limit", "service/vo/jobs.py",
          "return min(asked, most or MOST) if asked else most", "return min(asked, most or MOST) if asked else 0",
          ("tests/service/vo",)),
    Fault("cli-saturation-not-passed-on", "service/client/operations.py",
          "if name in Deconvolve.model_fields}", 'if name in Deconvolve.model_fields and name != "saturation_dn"}',
          ("tests/service/cli/test_deconvolve.py", "tests/service/cli/test_options.py"),
          ("tests/service/cli/test_outputs.py", "tests/whole/test_doors.py")),
    Fault("client-upload-resumes-at-first-byte", "service/client/resumable.py",
          "        file.seek(offset)\n", "",
          ("tests/service/api/test_resumable.py",), ("tests/service/client",)),
    Fault("vo-exposure-added-in-days", "service/vo/lists.py",
          "else start + exposure_s / DAY_S", "else start + exposure_s",
          ("tests/service/vo",), ("tests/whole/test_vo.py",)),
    # heliopsf
    Fault("heliopsf-axes-of-reference-pixel-swapped", "heliopsf/inputs.py",
          '(columns if name[5:6] == "1" else rows).start', '(rows if name[5:6] == "1" else columns).start',
          ("tests/heliopsf/test_forms.py",), ("tests/heliopsf",)),
)  # fmt: skip


def copy_checkout(copy: Path) -> None:
    """Copy the tracked files, the untracked files that git does not ignore, and the compiled kernels.

    Times are kept, because a kernel is compiled again if the time of its source differs.
    """
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, check=True, text=True).stdout
    sources = [ROOT / name for name in listing.split("\0") if name]
    for source in (*sources, *ROOT.glob("psfcore/**/__pycache__/*.nbc")):
        if os.path.lexists(source):  # git also lists a file that was deleted but not committed
            target = copy / source.relative_to(ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target, follow_symlinks=False)


def environment_of(copy: Path) -> dict[str, str]:
    """The environment of the tests: Python imports the copy before the installed checkout."""
    environment = os.environ | {"PYTHONPATH": str(copy)}
    if (ROOT.parent / "shared").is_dir():
        environment.setdefault(SHARED, str(ROOT.parent / "shared"))
    return environment


def check_imports(copy: Path) -> None:
    """Raise RuntimeError if Python would not import all packages of the copy."""
    code = "import heliopsf, psfcore, service, workers; print(heliopsf.__file__, psfcore.__file__, service.__file__, workers.__file__)"
    command = [sys.executable, "-c", code]
    files = subprocess.run(
        command, cwd=copy, env=environment_of(copy), capture_output=True, check=True, text=True
    ).stdout.split()
    if not all(Path(file).resolve().is_relative_to(copy.resolve()) for file in files):
        raise RuntimeError(f"expected packages in {copy}; got {', '.join(files)}")


def problems(fault: Fault, root: Path) -> list[str]:
    """The reasons why a fault cannot be planted in the sources below a folder; empty if it can."""
    path = root / fault.file
    text = path.read_text("utf-8") if path.is_file() else ""
    count = text.count(fault.old)
    reasons = [] if count == 1 else [f"expected the old text once in {fault.file}; got it {count} times"]
    if count == 1:
        try:
            ast.parse(text.replace(fault.old, fault.new))
        except SyntaxError as error:
            reasons.append(f"expected Python in the new text; got: {error}")
    missing = [test for test in (*fault.tests, *fault.then) if not (root / test).exists()]
    return reasons + [f"expected tests at {test}; it does not exist" for test in missing]


def run_tests(
    copy: Path, tests: Iterable[str], limit_s: float, *, first_failure: bool = True
) -> tuple[int | None, str]:
    """Run tests in the copy; returns the exit status of pytest, and its output. The status is None after the limit."""
    options = ["-q", "-p", "no:cacheprovider", "-m", "not slow", *(["-x"] if first_failure else [])]
    command = [sys.executable, "-m", "pytest", *options, *tests]
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as output:
        process = subprocess.Popen(
            command,
            cwd=copy,
            env=environment_of(copy),
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        status: int | None = None
        with suppress(subprocess.TimeoutExpired):
            try:
                status = process.wait(max(limit_s, 1.0))
            finally:
                end(process)
        output.seek(0)
        return status, output.read()


def end(process: subprocess.Popen[bytes]) -> None:
    """End the tests if they still run, and the processes that they started in their group."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(PATIENCE_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def answer_of(status: int | None, output: str) -> tuple[State, str]:
    """The state of a fault, and the first test that fails or the reason of an error, from the result of `run_tests`."""
    last = (output.strip().splitlines() or ["no output"])[-1]
    failure = FAILURE.search(output)
    if status is None:
        return "no answer", ""
    if status == 1 and failure is not None:
        return "found", failure[1]
    if status == 0 and " passed" in last:
        return "not found", ""
    return "error", f"pytest ended with status {status}: {last:.200}"


def outcome_of(fault: Fault, copy: Path, limit_s: float) -> Outcome:
    """Plant a fault in the copy, run its tests, and restore the file."""
    reasons = problems(fault, copy)
    if reasons:
        return Outcome("error", "; ".join(reasons), 0.0)
    path, began = copy / fault.file, time.monotonic()
    text, before = path.read_text("utf-8"), path.stat()
    state: State
    try:
        path.write_text(text.replace(fault.old, fault.new), "utf-8")
        state, test = answer_of(*run_tests(copy, fault.tests, limit_s))
        if state == "not found" and fault.then:
            left_s = limit_s - (time.monotonic() - began)
            state, test = answer_of(*run_tests(copy, fault.then, left_s))
    finally:
        path.write_text(text, "utf-8")
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    return Outcome(state, test, round(time.monotonic() - began, 1))


def controlled(outcomes: dict[str, Outcome], copy: Path) -> dict[str, Outcome]:
    """The outcomes, after the tests that fail were run without any fault. If one fails again, it says nothing about its fault."""
    tests = sorted({outcome.test for outcome in outcomes.values() if outcome.state == "found"})
    if not tests:
        return outcomes
    status, output = run_tests(copy, tests, CONTROL_LIMIT_S, first_failure=False)
    if status not in (0, 1):
        print(f"could not run the tests without a fault: {answer_of(status, output)[1]}", flush=True)
    failures = set(FAILURE.findall(output))
    return {
        name: replace(one, state="error", test=f"{one.test} fails without the fault too")
        if one.state == "found" and one.test in failures
        else one
        for name, one in outcomes.items()
    }


def measure(faults: Sequence[Fault], limit_s: float, output: Path | None) -> dict[str, Outcome]:
    """The outcome of each fault, by its name. Prints each one at once, and writes the file `output` after each one."""
    outcomes: dict[str, Outcome] = {}

    def write() -> None:
        if output is not None:
            rows = {name: asdict(outcome) for name, outcome in outcomes.items()}
            write_whole(output, json.dumps(rows, indent=1) + "\n")

    with tempfile.TemporaryDirectory(prefix="heliopsf-planted-") as folder:
        copy = Path(folder) / "checkout"
        copy_checkout(copy)
        check_imports(copy)
        for fault in faults:
            outcome = outcomes[fault.name] = outcome_of(fault, copy, limit_s)
            line = f"{outcome.state:<10} {fault.name:<48} {outcome.test:.140} {outcome.seconds:.0f} s"
            print(line, flush=True)
            write()
        outcomes = controlled(outcomes, copy)
        write()
    return outcomes


def lost(earlier: Path, outcomes: dict[str, Outcome]) -> list[str]:
    """The faults that were found in an earlier result, and have another state now."""
    rows = json.loads(earlier.read_text("utf-8"))
    return [
        name
        for name, one in outcomes.items()
        if one.state != "found" and rows.get(name, {}).get("state") == "found"
    ]


def check(faults: Sequence[Fault]) -> int:
    """Print the faults that cannot be planted in this checkout; returns the exit status."""
    bad = {fault.name: reasons for fault in faults if (reasons := problems(fault, ROOT))}
    for name, reasons in bad.items():
        print(f"{name}: {'; '.join(reasons)}")
    print(f"{len(faults) - len(bad)} of {len(faults)} faults can be planted")
    return 1 if bad else 0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names of faults, or parts of names")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--limit-s", type=float, default=LIMIT_S, help="longest time of the tests of a fault")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--compare", type=Path, metavar="RESULT.json")
    asked = parser.parse_args()
    faults = [one for one in FAULTS if asked.only is None or any(part in one.name for part in asked.only)]
    if not faults:
        parser.error(f"--only: expected parts of the names of faults; got {' '.join(asked.only)}")
    if asked.check:
        sys.exit(check(faults))
    outcomes = measure(faults, asked.limit_s, asked.output)
    count = {state: sum(one.state == state for one in outcomes.values()) for state in get_args(State)}
    print(
        f"{count['found']} of {len(outcomes)} found, {count['not found']} not found, {count['error']} errors"
        + (f", {count['no answer']} without an answer" if count["no answer"] else "")
    )
    for name, one in outcomes.items():
        if one.state == "error":
            print(f"error: {name}: {one.test}")
    gone = lost(asked.compare, outcomes) if asked.compare is not None else []
    for name in gone:
        print(f"found earlier, and not now: {name}")
    sys.exit(1 if count["error"] or gone else 0)


if __name__ == "__main__":
    main()
