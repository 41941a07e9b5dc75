"""Two bar charts of a gap report: the share of the gap along each axis, and the closure by each effect.

The named effects are those that the verdict names as the cause of the gap ("answer" in the report).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from psfcore.drawing.plots import INK, tidy
from psfcore.gap.report.report import fits_of, percent_words

Report = dict[str, Any]

MOST_EFFECTS = 10
CERTAIN_P = 1e-12  # a smaller p-value is written as "p < 1e-12"
_ANSWER, _OTHER = "#0072B2", "#9a9a9a"
# Smallest and largest closure that the chart shows; longer bars are cut.
_NO_CLOSURE, _MOST_CLOSURE = -0.35, 1.3


def draw_where(axes: Any, report: Report) -> None:
    """Draw one horizontal bar for each axis, with its p-value. The axes are in the order of the report; the first is at the top."""
    rows = report["where"]
    at = np.arange(len(rows))[::-1]
    shares = np.array([100 * row["share"] for row in rows])
    colours = [_ANSWER if n == 0 and report["verdict"] != "none" else _OTHER for n in range(len(rows))]
    axes.barh(at, shares, color=colours, height=0.7)
    for y, share, row in zip(at, shares, rows, strict=True):
        axes.annotate(
            p_words(row["p_value"]), (share, y), (4, 0), textcoords="offset points", va="center", fontsize=8.5
        )
    axes.set_yticks(at, [row["axis"].replace("_", " ") for row in rows])
    axes.set(xlim=(0, 1.3 * max(float(shares.max(initial=0.0)), 1.0)), xlabel="Share of the gap (%)")
    tidy([axes])


def p_words(p_value: float) -> str:
    """A p-value as text, for the label of a bar."""
    return f"p < {CERTAIN_P:.0e}" if p_value < CERTAIN_P else f"p = {p_value:.2g}"


def draw_effects(axes: Any, report: Report) -> None:
    """Draw the closure by each effect, with its 90 % interval and its probability. The named or tied effects are blue."""
    rows = fits_of(report)[:MOST_EFFECTS]
    at = np.arange(len(rows))[::-1]
    names = []
    for y, row in zip(at, rows, strict=True):
        chosen = _chosen(row, report)
        colour = _ANSWER if chosen else _OTHER
        _draw_closure(axes, float(y), row["closure"], colour)
        axes.text(1.52, y, percent_words(row["probability"]), va="center", ha="right", fontsize=9)
        mark = {"attributed": "named", "tie": "tied"}.get(report["verdict"], "") if chosen else ""
        names.append(row["name"].replace("_", " ") + (f"  ({mark})" if mark else ""))
    axes.text(
        1.52, at.max(initial=0) + 0.75, "probability", va="center", ha="right", fontsize=9, color="#555555"
    )
    axes.set_yticks(at, names)
    for tick, row in zip(axes.get_yticklabels(), rows, strict=True):
        if _chosen(row, report):
            tick.set_fontweight("bold")
    axes.axvline(0, color="#555555", linewidth=1.0)
    axes.axvline(1, color="#555555", linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set(xlim=(_NO_CLOSURE, 1.56), ylim=(-0.7, len(rows) + 0.2), xticks=(0, 0.25, 0.5, 0.75, 1.0))
    axes.set_xlabel("Closure of the gap on held-out images (0: no closure, 1: full closure)", x=0.45)
    tidy([axes])


def _chosen(row: Report, report: Report) -> bool:
    """Whether a row of the report is the fit of the named effects. For a tie: whether it is the fit of a tied
    hypothesis."""
    names, answer = set(row["name"].split(" + ")), set(report["answer"])
    if report["verdict"] != "tie":
        return names == answer
    return names <= answer and names in [set(member) for member in report["set"]["members"]]


def _draw_closure(axes: Any, y: float, closure: dict[str, Any] | None, colour: str) -> None:
    if closure is None:
        axes.text(0.02, y, "no gap to close", va="center", fontsize=8.5, color="#666666")
        return
    value, (low, high) = closure["value"], closure["ci90"]
    axes.barh(y, float(np.clip(value, _NO_CLOSURE, _MOST_CLOSURE)), color=colour, height=0.62)
    ends = np.clip([low, high], _NO_CLOSURE + 0.012, _MOST_CLOSURE)
    axes.plot(ends, [y, y], color=INK, linewidth=1.4)
    for end, beyond, cut in zip(ends, (low < ends[0], high > ends[1]), ("<", ">"), strict=True):
        axes.plot([end], [y], cut if beyond else "|", color=INK, markersize=5 if beyond else 8, clip_on=False)
    if value < _NO_CLOSURE:
        axes.text(_NO_CLOSURE + 0.03, y + 0.2, f"{value:.1f}", va="center", fontsize=7.5, color=INK)
