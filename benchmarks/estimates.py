"""Time and memory of jobs, beside the estimates of workers/intake.

    python -m benchmarks.estimates [--full]

Each case runs in its own process with one thread; its processor time and peak memory are measured. --full also measures
studies of a transit of 512 px, an image of 4096 px and an image with an ERROR plane (about twenty minutes more).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.timing import answer_of, memory_bytes
from psfcore.deconvolve.methods.registry import method_names
from tests.conftest import write_image, write_psf
from tests.fitted_psfs import EARLY, LATE, write_fitted
from tests.in_process import InProcess
from workers.catalogue.tables import DEFAULT_OWNER
from workers.intake import estimates
from workers.settings import Settings

Case = dict[str, Any]
STUDIES = ("psf-fit", "report", "gap-diagnose", "cross-validate")
NOISE = {"photon_gain_dn": 6.0, "read_noise_dn": 2.0}


def deconvolved(px: int, psf: int | str, steps: int, method: str = "richardson-lucy", **more: Any) -> Case:
    """A deconvolution. psf: edge length of a PSF with little scattered light, or "hri_euv", which scatters the most
    light."""
    return {"kind": "deconvolve", "px": px, "psf": psf, "method": {"name": method, "steps": steps}} | more


QUICK: list[Case] = [
    *(deconvolved(1024, "hri_euv", 20, name) for name in method_names()),
    deconvolved(512, 512, 20),
    deconvolved(2048, 2048, 20),
    deconvolved(2048, 2048, 60),
    deconvolved(2048, "hri_euv", 20, "richardson-lucy-extended"),
    {"kind": "psf-build", "instrument": "hri_euv", "size": 256},
    {"kind": "psf-build", "instrument": "aia_171", "size": 2048},
    {"kind": "psf-build", "instrument": "hri_euv", "size": 4096},
    {"kind": "psf-tables", "psf": 2048},
    *({"kind": "psf-interpolate", "px": px} for px in (128, 2048)),
    *({"kind": kind, "px": 128, "images": 12} for kind in ("psf-fit", "report", "gap-diagnose")),
    {"kind": "cross-validate", "px": 256, "images": 18, "runs": 10},
    {"kind": "psf-fit", "px": 256, "images": 18},
]
FULL: list[Case] = [
    deconvolved(4096, 2048, 10),
    deconvolved(1024, "hri_euv", 20, error_draws=4, noise=NOISE),
    *({"kind": kind, "px": 512, "images": 30} for kind in ("psf-fit", "report", "gap-diagnose")),
    {"kind": "cross-validate", "px": 512, "images": 30, "runs": 10},
    {"kind": "cross-validate", "px": 128, "images": 12, "runs": 2, "scheme": "exact"},
    {"kind": "psf-fit", "px": 256, "images": 18, "as_published": True},
]


class Inputs:
    """The files that cases need, in one folder. A file is made when a case first needs it."""

    def __init__(self, folder: Path, service: InProcess) -> None:
        self._folder, self._service = folder, service

    def _made(self, name: str, command: Iterable[str]) -> Path:
        path = self._folder / name
        if not path.exists():
            words = [sys.executable, "-m", "service.cli", *command, "-o", str(path)]
            subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        return path

    def _psf(self, which: int | str) -> str:
        path = self._folder / f"psf-{which}.fits"
        if isinstance(which, int) and not path.exists():
            write_psf(path, size=which)
        built = self._made(path.name, ["psf", "build", "--instrument", str(which), "--local"])
        return str(self._service.upload_psf(built)["id"])

    def _fitted(self, px: int) -> dict[str, Any]:
        found: dict[str, Any] = {"time": "2022-06-01"}
        for name, values, at in (("before", EARLY, "2022-01-01"), ("after", LATE, "2023-01-01")):
            path = write_fitted(self._folder / f"{name}-{px}.fits", values, size=px)
            found |= {f"{name}_psf_id": self._service.upload_psf(path)["id"], f"{name}_time": at}
        return found

    def parameters(self, case: Case) -> dict[str, Any]:
        """The parameters of the job, whose inputs are then uploaded."""
        rest = {key: value for key, value in case.items() if key not in ("kind", "px", "psf", "images")}
        if case["kind"] in STUDIES:
            size = ["--size", str(case["px"]), "--images", str(case["images"])]
            transit = self._made(f"transit-{case['px']}", ["simulate", "transit", *size])
            return {"transit_id": self._service.upload_transit(transit)["id"]} | rest
        if case["kind"] == "psf-interpolate":
            return self._fitted(case["px"])
        if "psf" in case:
            rest["psf_id"] = self._psf(case["psf"])
        if case["kind"] == "deconvolve":
            image = self._folder / f"image-{case['px']}.fits"
            if not image.exists():
                write_image(image, shape=(case["px"], case["px"]))
            rest["image_id"] = self._service.upload_image(image)["id"]
        return rest


def measured(case: Case, folder: Path) -> dict[str, Any]:
    """The time and the memory of a case in this process, and the estimates."""
    with TemporaryDirectory(dir=folder) as data:
        service = InProcess(Settings.apart(Path(data)).model_copy(update={"worker_threads": 1}))
        job = service.submit(case["kind"], **Inputs(folder, service).parameters(case))
        said = estimates.estimate(
            case["kind"], job["parameters"], service.catalogue, DEFAULT_OWNER, threads=1
        )
        started = time.process_time()
        service.wait(job)
        took_s = time.process_time() - started
        service.close()
    return {
        "took_s": took_s,
        "estimated_s": said.start_s,
        "mib": memory_bytes("VmHWM") / 2**20,
        "estimated_mib": said.memory_mib,
    }


def main() -> None:
    """Run the cases and print a line for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        case, folder = chosen.one
        print(json.dumps(measured(json.loads(case), Path(folder))))
        return
    print(f"{'measured':>20}{'estimated':>20}")
    with TemporaryDirectory(prefix="heliopsf-estimates-") as folder:
        for case in QUICK + (FULL if chosen.full else []):
            words, one_thread = (
                ("--one", json.dumps(case), folder),
                {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            )
            found = answer_of("benchmarks.estimates", *words, **one_thread)
            times = f"{found['took_s']:8.1f} s {found['mib']:6.0f} MiB"
            said = f"{found['estimated_s']:8.1f} s {found['estimated_mib']:6d} MiB"
            name = " ".join(str(one.get("name") if isinstance(one, dict) else one) for one in case.values())
            print(f"{times} {said}   {name}", flush=True)


if __name__ == "__main__":
    main()
