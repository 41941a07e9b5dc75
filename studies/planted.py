"""Plant 40 faults in the code, one at a time, and measure how many of them the tests find.

    python -m studies.planted [--only NAME ...] [--check] [--limit-s 600] [-o RESULT.json] [--compare RESULT.json]

A fault is a mistake that a reviewer would fear: a wrong sign, a lost condition, a unit, a limit that is off by one. It
is a patch of one or two lines. The study copies the checkout to a temporary folder, and changes only the copy. For each
fault it applies the patch there and runs the tests of the folder of its file, and then, if these find nothing, of its
whole room, until one fails. Slow tests are not run. It prints the state, the name, the first test that fails, and the
seconds.

The states: found: a test fails. not found: all tests pass. no answer: the tests took longer than the limit. error: the
patch does not apply exactly once, no test ran, or the tests could not be collected. The exit status is 1 if a fault has
the state error.

--check runs no tests: it verifies that every patch applies exactly once. --compare names the faults that were found in
an earlier result and are not found now; the exit status is then 1.

The faults were chosen without regard to what the tests cover. Those that no test finds stay in the table. No fault is
in a file that defines kernels (`psfcore.compiled`), because all kernels would be compiled again.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from psfcore.files import write_whole

ROOT = Path(__file__).parents[1]
FAILURE = re.compile(r"^(?:FAILED|ERROR) (\S+?::[^\[\n]+?(?:\[.*?\])?)(?: - .*)?$", re.MULTILINE)


@dataclass(frozen=True)
class Fault:
    """A mistake in one file. old: a text that occurs once in the file. new: the text in its place."""

    name: str
    file: str
    old: str
    new: str

    @property
    def tests(self) -> list[str]:
        """The folders of tests to run, one after the other: that of the file's folder, and that of its room."""
        folder = Path("tests", self.file).parent
        return list(dict.fromkeys([str(folder), str(Path(*folder.parts[:2]))]))

    def problem(self, root: Path) -> str:
        """Why the fault cannot be planted in the sources below a folder; empty if it can."""
        path = root / self.file
        count = path.read_text("utf-8").count(self.old) if path.is_file() else 0
        return "" if count == 1 else f"expected the old text once in {self.file}; got it {count} times"


FAULTS = (
    Fault("convolution-farthest-offset-lost", "psfcore/convolution/offsets.py",
          'min(kernel_size, centre + field_size)', 'min(kernel_size, centre + field_size - 1)'),
    Fault("convolution-centre-of-odd-kernels", "psfcore/convolution/convolver.py",
          'shift = p // 2 + q // 2 - n // 2', 'shift = (p + q) // 2 - n // 2'),
    Fault("deconvolve-edge-share-counts-own-pixel", "psfcore/deconvolve/edges.py",
          'beyond = line[centre + 1 :]', 'beyond = line[centre:]'),
    Fault("deconvolve-read-noise-not-squared", "psfcore/deconvolve/problem.py",
          'np.float32((read_noise / domain.scale) ** 2)', 'np.float32(read_noise / domain.scale)'),
    Fault("deconvolve-same-noise-in-every-draw", "psfcore/deconvolve/assess/error_planes.py",
          'np.random.default_rng([seed, k])', 'np.random.default_rng(seed)'),
    Fault("deconvolve-near-masked-radius-short", "psfcore/deconvolve/assess/quality.py",
          'if dy**2 + dx**2 <= radius_px**2', 'if dy**2 + dx**2 < radius_px**2'),
    Fault("deconvolve-region-shares-inverted", "psfcore/deconvolve/work.py",
          '* light.kept - light.light) / light.shares', '* light.kept - light.light) * light.shares'),
    Fault("fits-saturation-level-itself-unmasked", "psfcore/fits/saturation.py",
          'mask[image.pixels >= level]', 'mask[image.pixels > level]'),
    Fault("fits-psf-centre-half-a-pixel-off", "psfcore/fits/psfs.py",
          '(size // 2 + 1.0, ', '(size / 2 + 0.5, '),
    Fault("fits-short-file-accepted", "psfcore/fits/blocks.py",
          'there = self._there(count)', 'there = count'),
    Fault("fits-size-limit-per-axis", "psfcore/fits/blocks.py",
          'if nx * ny > limits.max_pixels:', 'if max(nx, ny) > limits.max_pixels:'),
    Fault("diffraction-weights-of-lines-ignored", "psfcore/diffraction/combined.py",
          'kernel = line.weight * one if len(lines) > 1 else one', 'kernel = one / len(lines)'),
    Fault("diffraction-mirror-path-not-doubled", "psfcore/diffraction/fresnel.py",
          '1j * sign * 4 * np.pi / grid.wavelength_mm', '1j * sign * 2 * np.pi / grid.wavelength_mm'),
    Fault("scatter-weight-by-sigma-not-variance", "psfcore/scatter/reconstruction.py",
          '1 / self.transit.noise.variance(level, self.transit.frames[n].exposure_s)',
          '1 / np.sqrt(self.transit.noise.variance(level, self.transit.frames[n].exposure_s))'),
    Fault("scatter-interpolated-covariance-not-squared", "psfcore/scatter/interpolation.py",
          '(1 - weight) ** 2 * c0 + weight**2 * c1 + course', '(1 - weight) * c0 + weight * c1 + course'),
    Fault("transit-occulter-half-a-pixel-off", "psfcore/transit/occulter.py",
          'np.arange(columns.start, columns.stop + 1) - 0.5 - place.x_px',
          'np.arange(columns.start, columns.stop + 1) - place.x_px'),
    Fault("transit-member-climbs-later", "psfcore/transit/admission.py",
          'or ".." in parts\n', 'or ".." in parts[:1]\n'),
    Fault("transit-guard-one-image-short", "psfcore/transit/transit.py",
          'k > last + guard', 'k >= last + guard'),
    Fault("simulate-photons-counted-in-dn", "psfcore/noise.py",
          'rng.poisson(exposure_dn / self.photon_gain_dn) * self.photon_gain_dn', 'rng.poisson(exposure_dn)'),
    Fault("flare-error-of-mean-not-of-count", "psfcore/flare/arm_profile.py",
          'np.sqrt(np.bincount(member, variance[rows, columns])) / count',
          'np.sqrt(np.bincount(member, variance[rows, columns]) / count)'),
    Fault("gap-sign-of-nonlinearity", "psfcore/gap/library/detector.py",
          'np.asarray(-images[n] * np.exp(', 'np.asarray(images[n] * np.exp('),
    Fault("gap-closure-keeps-noise", "psfcore/gap/verdict/closure.py",
          'value = 1 - float((chi2_after - nu).sum()) / total', 'value = 1 - float(chi2_after.sum()) / total'),
    Fault("gap-prior-of-each-form-undivided", "psfcore/gap/verdict/answer.py",
          '0.5 / alike[form.family, form.field is None] / len(families)', '0.5 / len(families)'),
    Fault("blind-half-of-a-pair-counts", "psfcore/blind/judge.py",
          'if all(self.matches(one, level)', 'if any(self.matches(one, level)'),
    Fault("built-damaged-psf-used", "psfcore/psf_cache.py",
          'if _whole(path):', 'if path.is_file():'),
    Fault("catalogue-claim-without-compare", "workers/catalogue/jobs.py",
          'update(JobRow).where(JobRow.id == job_id, JobRow.phase == Phase.QUEUED)',
          'update(JobRow).where(JobRow.id == job_id)'),
    Fault("run-heart-stops-after-one-database-error", "workers/run/attempt.py",
          'could not write the heartbeat: %r", self.lease.job_id, error)\n                continue',
          'could not write the heartbeat: %r", self.lease.job_id, error)\n                return'),
    Fault("files-hash-not-compared", "workers/files/store.py",
          'found = sha256_of(path)\n', 'found = path.name\n'),
    Fault("intake-end-of-validity-included", "workers/catalogue/psfs.py",
          'PsfRow.valid_to > filters.valid_at', 'PsfRow.valid_to >= filters.valid_at'),
    Fault("bulk-image-of-a-living-worker-taken", "workers/catalogue/bulks.py",
          'BulkItemRow.state == ItemState.TAKEN, ~_IN_WORK)', 'BulkItemRow.state == ItemState.TAKEN)'),
    Fault("contract-diffraction-not-in-identity", "workers/contract/identities.py",
          '            "diffraction": diffraction_identity(request),\n', ''),
    Fault("broker-binding-lock-shared", "workers/broker/order.py",
          'fcntl.flock(held, fcntl.LOCK_EX)', 'fcntl.flock(held, fcntl.LOCK_SH)'),
    Fault("http-job-of-any-owner", "service/api/jobs.py",
          'if row is None or row.owner != caller.owner:', 'if row is None:'),
    Fault("http-one-request-too-many-at-once", "service/http/rates.py",
          'if self._open[who] >= self._most:', 'if self._open[who] > self._most:'),
    Fault("pages-any-form-token-accepted", "service/http/callers.py",
          'if not hmac.compare_digest(sent.encode(), session.form_token.encode()):', 'if not sent:'),
    Fault("uws-zero-lifts-operators-limit", "service/vo/jobs.py",
          'return min(asked, most or MOST) if asked else most', 'return min(asked, most or MOST) if asked else 0'),
    Fault("cli-saturation-not-passed-on", "service/client/operations.py",
          'if name in Deconvolve.model_fields}', 'if name in Deconvolve.model_fields and name != "saturation_dn"}'),
    Fault("client-upload-resumes-at-first-byte", "service/client/connection.py",
          '        file.seek(offset)\n', ''),
    Fault("vo-exposure-added-in-days", "service/vo/lists.py",
          'else start + exposure_s / DAY_S', 'else start + exposure_s'),
    Fault("heliopsf-axes-of-reference-pixel-swapped", "heliopsf/inputs.py",
          '(columns if name[5:6] == "1" else rows).start', '(rows if name[5:6] == "1" else columns).start'),
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


def run_tests(copy: Path, tests: str, limit_s: float) -> tuple[str, str]:
    """Run tests in the copy until one fails. Returns the state, and the first failing test or the reason of an
    error."""
    environment = os.environ | {
        "PYTHONPATH": str(copy)
    }  # Python imports the copy before the installed checkout
    if (ROOT.parent / "shared").is_dir():
        environment.setdefault("HELIOPSF_SHARED", str(ROOT.parent / "shared"))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", "not slow", tests]
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as output:
        streams = {"stdout": output, "stderr": subprocess.STDOUT}
        process = subprocess.Popen(  # type: ignore[call-overload]
            command, cwd=copy, env=environment, start_new_session=True, **streams
        )
        status: int | None = None
        with suppress(subprocess.TimeoutExpired):
            try:
                status = process.wait(max(limit_s, 1.0))
            finally:
                with suppress(ProcessLookupError):  # the tests, and the servers of their process group
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        output.seek(0)
        said = output.read()
    failure, last = FAILURE.search(said), (said.strip().splitlines() or ["no output"])[-1]
    if status is None:
        return "no answer", ""
    if status == 1 and failure is not None:
        return "found", failure[1]
    if status == 0 and " passed" in last:
        return "not found", ""
    return "error", f"pytest ended with status {status}: {last:.200}"


def outcome_of(fault: Fault, copy: Path, limit_s: float) -> dict[str, str | float]:
    """Plant a fault in the copy, run its tests, and restore the file."""
    path, began = copy / fault.file, time.monotonic()
    state, test = "error", fault.problem(copy)
    if not test:
        text, before = path.read_text("utf-8"), path.stat()
        try:
            path.write_text(text.replace(fault.old, fault.new), "utf-8")
            for tests in fault.tests:
                state, test = run_tests(copy, tests, limit_s - (time.monotonic() - began))
                if state != "not found":
                    break
        finally:
            path.write_text(text, "utf-8")
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    return {"state": state, "test": test, "seconds": round(time.monotonic() - began, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", nargs="+", default=[""], metavar="NAME", help="names of faults, or parts of names"
    )
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--limit-s", type=float, default=600.0, help="longest time of the tests of a fault")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--compare", type=Path, metavar="RESULT.json")
    chosen = parser.parse_args()
    faults = [one for one in FAULTS if any(part in one.name for part in chosen.only)]
    if chosen.check:
        problems = [f"{fault.name}: {said}" for fault in faults if (said := fault.problem(ROOT))]
        print("\n".join([*problems, f"{len(faults) - len(problems)} of {len(faults)} faults can be planted"]))
        sys.exit(bool(problems))
    outcomes: dict[str, dict[str, str | float]] = {}
    with tempfile.TemporaryDirectory(prefix="heliopsf-planted-") as folder:
        copy = Path(folder) / "checkout"
        copy_checkout(copy)
        for fault in faults:
            one = outcomes[fault.name] = outcome_of(fault, copy, chosen.limit_s)
            print(f"{one['state']:<10} {fault.name:<48} {one['test']:.140} {one['seconds']} s", flush=True)
            if chosen.output is not None:
                write_whole(chosen.output, json.dumps(outcomes, indent=1) + "\n")
    print(dict(Counter(one["state"] for one in outcomes.values())))
    before = json.loads(chosen.compare.read_text("utf-8")) if chosen.compare else {}
    found = {name for name, one in before.items() if one["state"] == "found"}
    lost = [name for name, one in outcomes.items() if name in found and one["state"] != "found"]
    for name in lost:
        print(f"found earlier, and not now: {name}")
    sys.exit(bool(lost) or any(one["state"] == "error" for one in outcomes.values()))


if __name__ == "__main__":
    main()
