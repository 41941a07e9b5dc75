"""Measures the time and memory of jobs, and compares them with the estimates of workers/intake/estimates.py.

    python -m benchmarks.estimates [--full] [--write]

Each case runs in its own process with one thread; its processor time and peak memory are measured. --full also measures
studies of a transit of 512 px, an image of 4096 px and an image with an ERROR plane (about twenty minutes more).
--write multiplies the times of each kind in estimates.json by the median ratio of measured to estimated time; each
method of deconvolution has a ratio of its own. Memory is only printed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.timing import memory_bytes
from psfcore.deconvolve.methods.registry import method_names

# psf: edge length of a PSF with little scattered light, or "hri" for the PSF of HRI_EUV, which scatters the most light.
QUICK: list[dict[str, Any]] = [
    *(
        {"kind": "deconvolve", "px": 1024, "psf": "hri", "method": {"name": name, "steps": 20}}
        for name in method_names()
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
    *({"kind": "psf-interpolate", "px": px} for px in (128, 2048)),
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
MEASURED = "measured.jsonl"
STUDIES = ("psf-fit", "report", "gap-diagnose", "cross-validate")


def main() -> None:
    """Run the cases and print a line for each."""
    if len(sys.argv) > 2 and not sys.argv[1].startswith("--"):
        measure(json.loads(sys.argv[1]), Path(sys.argv[2]))
        return
    one_thread = os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    print(f"{'measured':>20}{'estimated':>20}")
    with TemporaryDirectory(prefix="heliopsf-estimates-") as folder:
        for case in QUICK + (FULL if "--full" in sys.argv else []):
            subprocess.run(
                [sys.executable, "-m", "benchmarks.estimates", json.dumps(case), folder], env=one_thread
            )
        measured = Path(folder) / MEASURED
        if "--write" in sys.argv and measured.exists():
            write([json.loads(line) for line in measured.read_text().splitlines()])


def write(measured: list[dict[str, Any]]) -> None:
    """Correct the times in estimates.json by these measurements."""
    from workers.intake.costs import COSTS_FILE, Costs

    content = json.loads(COSTS_FILE.read_text("utf-8"))
    ratios: dict[tuple[str, str], list[float]] = defaultdict(list)
    for one in measured:
        ratios[one["kind"], one["method"]].append(one["took_s"] / one["estimated_s"])
    for (kind, method), found in ratios.items():
        times = content["kinds"][kind]
        if method:
            before = times["step_ns"].get(method, max(times["step_ns"].values()))
            times["step_ns"][method] = round(before * median(found), 3)
            continue
        for name, value in times.items():
            if name.endswith(("_s", "_ns")):
                times[name] = round(value * median(found), 3)
        for scheme, pair in times.get("run", {}).items():
            times["run"][scheme] = [round(value * median(found), 3) for value in pair]
    Costs.model_validate(content)
    Path(str(COSTS_FILE)).write_text(json.dumps(content, indent=2) + "\n", "utf-8")


def measure(case: dict[str, Any], folder: Path) -> None:
    """Measure one case in this process.

    The first case that needs a file makes it in the folder; later cases use it again.
    """
    from tests.in_process import InProcess
    from workers.catalogue.tables import DEFAULT_OWNER
    from workers.intake import estimates
    from workers.settings import Settings

    with TemporaryDirectory(dir=folder) as data:
        service = InProcess(Settings.apart(Path(data)).model_copy(update={"worker_threads": 1}))
        kind, parameters = case["kind"], asked(case, folder, service)
        job = service.submit(kind, **parameters)
        said = estimates.estimate(kind, job["parameters"], service.catalogue, DEFAULT_OWNER, threads=1)
        started = time.process_time()
        service.wait(job)
        took_s, peak = time.process_time() - started, memory_bytes("VmHWM") / 2**20
        service.close()
    record = {
        "kind": kind,
        "method": case.get("method", {}).get("name", ""),
        "took_s": took_s,
        "estimated_s": said.start_s,
    }
    with (folder / MEASURED).open("a") as lines:
        lines.write(json.dumps(record) + "\n")
    name = " ".join(str(value.get("name") if isinstance(value, dict) else value) for value in case.values())
    print(
        f"{took_s:8.1f} s {peak:6.0f} MiB {said.start_s:8.1f} s {said.memory_mib:6d} MiB   {name}", flush=True
    )


def asked(case: dict[str, Any], folder: Path, service: Any) -> dict[str, Any]:
    """Upload the inputs of a job; returns the parameters of the job."""
    from tests.conftest import write_image

    if case["kind"] == "psf-build":
        return {"instrument": case["instrument"], "size": case["size"]}
    if case["kind"] in STUDIES:
        given = {key: case[key] for key in ("runs", "scheme", "as_published") if key in case}
        return {"transit_id": service.upload_transit(transit(case, folder))["id"], **given}
    if case["kind"] == "psf-interpolate":
        return two_fitted(case["px"], folder, service)
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


def two_fitted(px: int, folder: Path, service: Any) -> dict[str, Any]:
    """Upload two fitted PSFs; returns the parameters of a job that interpolates between them."""
    from tests.fitted_psfs import EARLY, LATE, write_fitted

    early, late = (
        service.upload_psf(write_fitted(folder / f"fitted-{px}-{n}.fits", values, size=px))["id"]
        for n, values in enumerate((EARLY, LATE))
    )
    return {
        "before_psf_id": early,
        "before_time": "2022-01-01",
        "after_psf_id": late,
        "after_time": "2023-01-01",
        "time": "2022-06-01",
    }


def psf_file(which: int | str, folder: Path) -> Path:
    """The file of a PSF. It is made if it does not exist."""
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
    """The folder of a simulated transit. It is made if it does not exist."""
    path = folder / f"transit-{case['px']}"
    if not path.exists():
        sizes = ["--size", str(case["px"]), "--images", str(case["images"])]
        subprocess.run(
            [*CLI, "simulate", "transit", "-o", str(path), *sizes], check=True, stdout=subprocess.DEVNULL
        )
    return path


CLI = [sys.executable, "-m", "service.cli"]


if __name__ == "__main__":
    main()
