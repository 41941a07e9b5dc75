"""The picture of a score of a blind set: the confusion matrix, and the power against the residual that an effect leaves."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from psfcore.blind.cases import CLEAN, MIXED, PAIR
from psfcore.blind.effects.registry import KNOWN
from psfcore.drawing.plots import INK, write_png

_VERDICTS = ("none", "unknown", "inconclusive")


def score_png(found: Mapping[str, Any], path: str | Path) -> None:
    """Draw two panels: the truth against the first effect named, and the power with Wilson intervals.

    found: a score (gap-blind/1). path: a PNG file.
    """
    figure = Figure(figsize=(17, 9.5), dpi=90, facecolor="white", layout="constrained")
    title = f"Blind set: {found['judged']} cases judged, {len(found['failures'])} failed"
    figure.suptitle(title, fontsize=13, color=INK, weight="bold", x=0.01, ha="left")
    matrix, power = figure.subplots(1, 2, width_ratios=(1.9, 1))
    _draw_matrix(matrix, found["confusion"])
    _draw_power(power, found["power"])
    write_png(figure, path)


def _draw_matrix(axes: Axes, confusion: dict[str, dict[str, int]]) -> None:
    rows = list(confusion)
    said = {name for row in confusion.values() for name in row}
    columns = [name for name in (*_VERDICTS, *KNOWN) if name in said or name in _VERDICTS or name in rows]
    columns += sorted(said - set(columns))
    counts = np.array([[confusion[row].get(column, 0) for column in columns] for row in rows])
    if not counts.size:
        axes.text(0.5, 0.5, "no case was judged", ha="center", transform=axes.transAxes)
        return
    axes.imshow(counts / counts.sum(axis=1, keepdims=True), cmap="Blues", vmin=0, vmax=1.3, aspect="auto")
    for (row, column), count in np.ndenumerate(counts):
        if count:
            axes.text(column, row, str(count), ha="center", va="center", fontsize=9, color=INK)
        if columns[column] in _right_columns(rows[row]):
            corner = (column - 0.5, row - 0.5)
            frame = Rectangle(corner, 1, 1, fill=False, edgecolor="#c73e2b", linewidth=1.2, clip_on=False)
            axes.add_patch(frame)
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize=9)
    labels = [f"{name} *" if _is_foreign(name) else name for name in rows]
    axes.set_yticks(range(len(rows)), labels, fontsize=9)
    axes.set(
        xlabel="first effect named, or verdict",
        ylabel="truth (* not in the library)",
        title="Number of cases; frames mark correct verdicts",
    )


def _right_columns(truth: str) -> tuple[str, ...]:
    if truth == CLEAN:
        return ("none",)
    return ("unknown", "inconclusive") if _is_foreign(truth) else (truth,)


def _is_foreign(truth: str) -> bool:
    """Whether a row is of an effect that is not in the library; a simulator may have effects with any names."""
    return truth not in (*KNOWN, CLEAN, PAIR, MIXED)


def _draw_power(axes: Axes, power: list[dict[str, Any]]) -> None:
    edges = [one["left_after_refit_pct"] for one in power]
    labels = [f"> {low:g}" if high is None else f"{low:g} -\n{high:g}" for low, high in edges]
    at = np.arange(len(labels))
    for offset, count, hits, interval, colour, name in (
        (-0.08, "n", "noticed", "noticed_wilson95", "#1b4f91", "noticed (the verdict is not “none”)"),
        (0.08, "n_known", "contains_truth", "contains_wilson95", "#2b8a6e", "the named effects include the true ones"),
    ):  # fmt: skip
        shown = [n for n, row in enumerate(power) if row[count]]
        share = np.array([power[n][hits] / power[n][count] for n in shown])
        ends = np.array([power[n][interval] for n in shown]).reshape(-1, 2)
        errors = np.abs(np.stack([share - ends[:, 0], ends[:, 1] - share])) if shown else None
        axes.errorbar(at[shown] + offset, share, yerr=errors, fmt="o-", color=colour, capsize=3, label=name)
        for n, value in zip(shown, share, strict=True):
            axes.annotate(
                f"{power[n][hits]}/{power[n][count]}",
                (n + offset, value),
                textcoords="offset points",
                xytext=(-24 if offset < 0 else 6, 6),
                fontsize=8,
                color=colour,
            )
    axes.set_xticks(at, labels)
    axes.set(
        xlabel="residual left in the discs after the refit (%, rms over images)",
        ylabel="fraction of cases, with 95 % Wilson interval",
        ylim=(-0.03, 1.08),
    )
    axes.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.03), ncols=2)
    axes.grid(color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
