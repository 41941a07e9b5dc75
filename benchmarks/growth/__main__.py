"""Measure how time and memory grow with the size of the work; `docs/speed.md` shows the figures.

    python -m benchmarks.growth [NAME ...] [--most N] [--quick] [--write]
    python -m benchmarks.growth memory
    python -m benchmarks.growth figures

NAME: image, psf, steps, transit, catalogue or workers; default: all, about ten minutes on two cores. --quick measures
fewer and smaller points. --most leaves out the points above N. --write replaces the measured numbers in docs/growth/measured.json and their figures; without
it, the numbers are only printed. Exponents are fitted to the three largest points. memory: the peak of every method
at 2048 and 4096 px beside its estimate. figures: draw the figures again from the table.

Times are the shortest of several runs. They are also printed as ratios to 1 F (see benchmarks/timing.py), which is
measured before every axis: other work on the machine slows both.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.figures import kind_of_machine
from benchmarks.growth.axes import AXES, _deconvolved
from benchmarks.growth.figures import draw, exponent
from benchmarks.timing import reference
from psfcore.deconvolve.methods.registry import method_names

FOLDER = Path(__file__).parents[2] / "docs" / "growth"
TABLE = FOLDER / "measured.json"


def measured(name: str, quick: bool, most: float) -> dict[str, Any]:
    """Measure an axis, and print its points and exponents."""
    axis, f_s, points = AXES[name], reference(), []
    print(f"{axis.label}: {axis.what}; 1 F = {f_s:.3f} s", flush=True)
    for point in axis.points(quick, most):
        points.append(asdict(point))
        memory = "" if point.mib is None else f"{point.mib:8.0f} MiB"
        more = "".join(f"  {key} {value:.4g}" for key, value in point.more.items())
        print(
            f"{point.n:>10g} {point.seconds:10.4f} s {point.seconds / f_s:9.2f} F {memory}{more}", flush=True
        )
    n = [point["n"] for point in points]
    found = {"seconds": exponent(n, [point["seconds"] for point in points])}
    if all(point["mib"] is not None for point in points):
        found["mib"] = exponent(n, [point["mib"] for point in points])
    print(
        "exponents: " + ", ".join(f"{key} {value:.2f}" for key, value in found.items() if value is not None)
    )
    return {
        "label": axis.label,
        "what": axis.what,
        "memory": "size of the file (MiB)" if name == "catalogue" else "peak memory (MiB)",
        "f_s": f_s,
        "exponents": found,
        "points": points,
    }


def machine() -> str:
    """The machine and the date, for the figures."""
    load = os.getloadavg()[2]
    return f"{kind_of_machine()}, {time.strftime('%Y-%m-%d')}, load {load:.0f} in the last 15 minutes"


def memory() -> None:
    """Print the peak memory of every method beside its estimate."""
    print(
        "peak besides the image and the PSF; bytes for each pixel of the padded plane besides the result, too"
    )
    for size in (2048, 4096):
        for method in method_names():
            point = _deconvolved(size, size=size, method=method, steps=2)
            estimate = point.more["estimate_mib"]
            assert point.mib is not None
            print(
                f"{size} px {method:<32} {point.mib:6.0f} MiB, estimate {estimate:6.0f} MiB = {estimate / point.mib:.2f}; "
                f"{point.more['bytes_a_padded_px']:5.1f} bytes",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", choices=[*AXES, "memory", "figures", []], metavar="NAME")
    parser.add_argument("--most", type=float, default=math.inf, metavar="N")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    if asked.names == ["memory"]:
        memory()
        return
    table = json.loads(TABLE.read_text("utf-8")) if TABLE.exists() else {}
    if asked.names == ["figures"]:
        for name, axis in table.items():
            draw(FOLDER / f"{name}.svg", axis, axis["machine"])
        return
    for name in asked.names or AXES:
        table[name] = measured(name, asked.quick, asked.most) | {"machine": machine()}
        if asked.write:
            FOLDER.mkdir(exist_ok=True)
            TABLE.write_text(json.dumps(table, indent=1) + "\n", "utf-8")
            draw(FOLDER / f"{name}.svg", table[name], table[name]["machine"])


if __name__ == "__main__":
    main()
