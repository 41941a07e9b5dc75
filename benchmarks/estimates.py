"""What jobs need, beside what workers/estimates.py says of them before they are taken.

    python -m benchmarks.estimates [--full]

Each case is a process of its own with one thread, whose processor time and peak of memory are taken. --full: also
studies of a transit of 512 px, an image of 4096 px and one with an ERROR plane: some twenty minutes more.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

METHODS = (
    "richardson-lucy",
    "richardson-lucy-accelerated",
    "richardson-lucy-extended",
    "richardson-lucy-total-variation",
    "basic-iterative",
    "linear",
)
# psf: edge of a PSF with little light far out, or "hri" for HRI_EUV's, which has most.
QUICK: list[dict[str, Any]] = [
    *(
        {"kind": "deconvolve", "px": 1024, "psf": "hri", "method": {"name": name, "steps": 20}}
        for name in METHODS
    ),
    {"kind": "deconvolve", "px": 512, "psf": 512, "method": {"name": "richardson-lucy", "steps": 20}},
    {"kind": "deconvolve", "px": 2048, "psf": 2048, "method": {"name": "richardson-lucy", "steps": 20}},
    {"kind": "deconvolve", "px": 2048, "psf": 2048, "method": {"name": "richardson-lucy", "steps": 60}},
    {
        "kind": "deconvolve",
        "px": 2048,
        "psf": "hri",
        "method": {"name": "richardson-lucy-extended", "steps": 20},
    },
    {"kind": "psf-build", "instrument": "hri_euv", "size": 256},
    {"kind": "psf-build", "instrument": "aia_171", "size": 2048},
    {"kind": "psf-build", "instrument": "hri_euv", "size": 4096},
    {"kind": "psf-tables", "psf": 2048},
    *({"kind": kind, "px": 128, "images": 12} for kind in ("psf-fit", "report", "gap-diagnose")),
    {"kind": "cross-validate", "px": 256, "images": 18, "runs": 10},
    {"kind": "psf-fit", "px": 256, "images": 18},
]
FULL: list[dict[str, Any]] = [
    {"kind": "deconvolve", "px": 4096, "psf": 2048, "method": {"name": "richardson-lucy", "steps": 10}},
    {"kind": "deconvolve", "px": 1024, "psf": "hri", "error_draws": 4, "noise": True},
    *({"kind": kind, "px": 512, "images": 30} for kind in ("psf-fit", "report", "gap-diagnose")),
    {"kind": "cross-validate", "px": 512, "images": 30, "runs": 10},
    {"kind": "cross-validate", "px": 128, "images": 12, "runs": 2, "scheme": "exact"},
    {"kind": "psf-fit", "px": 256, "images": 18, "as_published": True},
]
STUDIES = ("psf-fit", "report", "gap-diagnose", "cross-validate")


def main() -> None:
    """Run the cases and print a line for each."""
    if len(sys.argv) > 2:
        measure(json.loads(sys.argv[1]), Path(sys.argv[2]))
        return
    one_thread = os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    print(f"{'measured':>20}{'said':>20}")
    with TemporaryDirectory(prefix="heliopsf-estimates-") as folder:
        for case in QUICK + (FULL if "--full" in sys.argv else []):
            subprocess.run(
                [sys.executable, "-m", "benchmarks.estimates", json.dumps(case), folder], env=one_thread
            )


def measure(case: dict[str, Any], folder: Path) -> None:
    """One case in this process; what files it needs are made in the folder once."""
    from service.local import LocalService
    from workers.catalogue.tables import DEFAULT_OWNER
    from workers.intake import estimates
    from workers.settings import Settings

    with TemporaryDirectory(dir=folder) as data:
        service = LocalService(Settings.apart(Path(data)).model_copy(update={"worker_threads": 1}))
        kind, parameters = case["kind"], asked(case, folder, service)
        job = service.submit(kind, **parameters)
        said = estimates.estimate(kind, job["parameters"], service._catalogue, DEFAULT_OWNER, threads=1)
        started = time.process_time()
        service.wait(job)
        took_s, peak = time.process_time() - started, peak_mib()
        service.close()
    name = " ".join(str(value.get("name") if isinstance(value, dict) else value) for value in case.values())
    print(
        f"{took_s:8.1f} s {peak:6.0f} MiB {said.seconds:8.1f} s {said.memory_mib:6d} MiB   {name}", flush=True
    )


def asked(case: dict[str, Any], folder: Path, service: Any) -> dict[str, Any]:
    """A job's parameters; what it needs is uploaded."""
    from tests.conftest import write_image

    if case["kind"] == "psf-build":
        return {"instrument": case["instrument"], "size": case["size"]}
    if case["kind"] in STUDIES:
        given = {key: case[key] for key in ("runs", "scheme", "as_published") if key in case}
        return {"transit_id": service.upload_transit(transit(case, folder))["id"], **given}
    psf_id = service.upload_psf(psf_file(case["psf"], folder))["id"]
    if case["kind"] == "psf-tables":
        return {"psf_id": psf_id}
    image = folder / f"image-{case['px']}.fits"
    if not image.exists():
        write_image(image, shape=(case["px"], case["px"]))
    wanted = {key: case[key] for key in ("method", "error_draws") if key in case}
    if case.get("noise"):
        wanted["noise"] = {"photon_gain_dn": 6.0, "read_noise_dn": 2.0}
    return {"image_id": service.upload_image(image)["id"], "psf_id": psf_id, **wanted}


def psf_file(which: int | str, folder: Path) -> Path:
    """A PSF's file, made where it is not there."""
    from tests.conftest import write_psf

    path = folder / f"psf-{which}.fits"
    if not path.exists() and isinstance(which, int):
        write_psf(path, size=which)
    elif not path.exists():
        subprocess.run(
            [*CLI, "psf", "build", "--instrument", "hri_euv", "-o", str(path), "--local"],
            check=True,
            stdout=subprocess.DEVNULL,
        )
    return path


def transit(case: dict[str, Any], folder: Path) -> Path:
    """A simulated transit's folder, made where it is not there."""
    path = folder / f"transit-{case['px']}"
    if not path.exists():
        sizes = ["--size", str(case["px"]), "--images", str(case["images"])]
        subprocess.run(
            [*CLI, "simulate", "transit", "-o", str(path), *sizes], check=True, stdout=subprocess.DEVNULL
        )
    return path


CLI = [sys.executable, "-m", "service.cli"]


def peak_mib() -> float:
    """The most memory that this process has had."""
    line = next(
        line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")
    )
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    main()
