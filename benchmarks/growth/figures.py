"""The figures of growth: time and memory in logarithmic axes, with the exponents of a fit."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

FITTED_POINTS = 3  # the exponent is that of the largest points: constant terms hide the growth of small ones
TIME, MEMORY = "#123a7a", "#d5642f"


def exponent(n: list[float], values: list[float]) -> float | None:
    """p of values ~ n ** p, by least squares in logarithms through the last points; None for fewer than two points."""
    if len(n) < 2:
        return None
    last = slice(-FITTED_POINTS, None)
    return float(np.polyfit(np.log(n[last]), np.log(values[last]), 1)[0])


def figure_of(axis: dict[str, Any], machine: str) -> Figure:
    """The figure of an axis."""
    points = axis["points"]
    n = [point["n"] for point in points]
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    left = figure.subplots()
    series = [("seconds", "time (s)", TIME, left)]
    if all(point["mib"] is not None for point in points):
        series.append(("mib", axis.get("memory", "peak memory (MiB)"), MEMORY, left.twinx()))
    for key, label, colour, axes in series:
        values = [point[key] for point in points]
        power = exponent(n, values)
        axes.loglog(n, values, "o-", color=colour)
        # At least a decade, so that a quantity that hardly grows is shown as such.
        spread = max(10**0.5 / (max(values) / min(values)) ** 0.5, 1.3)
        axes.set_ylim(min(values) / spread, max(values) * spread)
        axes.set_ylabel(f"{label} ~ n^{power:.2f}", color=colour)
        axes.tick_params(axis="y", which="both", labelcolor=colour)
    left.set_xticks(n, [f"{value:g}" for value in n])
    left.minorticks_off()
    left.set_xlabel(f"n: {axis['label']}")
    left.set_title(f"{axis['what']}\n{machine}", fontsize="small")
    left.grid(alpha=0.3)
    return figure


def draw(path: Path, axis: dict[str, Any], machine: str) -> None:
    """Write the figure of an axis as SVG. Equal numbers give equal bytes."""
    figure, text = figure_of(axis, machine), io.StringIO()
    with rc_context({"svg.hashsalt": path.stem, "svg.fonttype": "path"}):
        FigureCanvasSVG(figure).print_svg(text, metadata={"Date": None})
    path.write_text(re.sub(r"[ \t]+$", "", text.getvalue(), flags=re.MULTILINE), "utf-8")
