"""What jobs cost: figures that were measured, which need no catalogue.

`python -m benchmarks.estimates` prints the measured times and memory beside the estimates. Times in seconds are
processor time on one core of a machine of 2026. A time here may be wrong by a factor of two: `workers.intake.estimates`
multiplies it by a factor that the service measures. The memory is an upper bound.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Cost:
    """The time and the memory that a kind of job needs.

    Attributes
    ----------
    base_s, pixel_ns
        Time of the job, s, and further time for each pixel that the job reads, ns.
    base_mib, pixel_bytes
        Memory of the job, MiB, and further memory for each pixel, bytes.
    times
        Factors of the time, by the names of the parameters that cause them if the request sets them.
    runs
        The share of the time that each run adds to it, by scheme.
    """

    base_s: float
    pixel_ns: float
    base_mib: float = 0.0
    pixel_bytes: float = 0.0
    times: Mapping[str, float] = field(default_factory=dict)
    runs: Mapping[str, float] = field(default_factory=dict)


WORKER_MIB = 400.0  # of a worker with its libraries, before its first job
OTHER = Cost(10.0, 2000.0, 200.0, 30.0)  # of kinds without an entry
COSTS = {
    "deconvolve": Cost(0.6, 750.0),
    "psf-tables": Cost(0.3, 200.0, 0.0, 16.0),
    "psf-interpolate": Cost(1.0, 1050.0, 66.0, 97.0),
    "psf-fit": Cost(8.3, 2200.0, 485.0, 12.0, times={"as_published": 7.0}),
    "cross-validate": Cost(2.9, 1600.0, 100.0, 20.0, runs={"shared": 0.08, "exact": 1.4}),
    "report": Cost(20.0, 10500.0, 505.0, 27.0, times={"shapes": 3.0}),
    "gap-diagnose": Cost(6.0, 10000.0, 505.0, 100.0),
}


def job_s(kind: str, parameters: Mapping[str, Any], pixels: float) -> float:
    """The estimated processor time of a job that reads this number of pixels, s; without the steps of a
    deconvolution.
    """
    cost = COSTS.get(kind, OTHER)
    cpu_s = cost.base_s + cost.pixel_ns * 1e-9 * pixels
    for parameter, factor in cost.times.items():
        cpu_s *= factor if parameters.get(parameter) else 1.0
    return float(cpu_s * (1 + cost.runs.get(parameters.get("scheme", ""), 0.0) * parameters.get("runs", 0)))
