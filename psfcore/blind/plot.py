"""A picture of the score of a blind set: the confusion matrix, and the power.

The power is the fraction of cases in which the diagnosis notices, or names, the effect. The power is drawn against the
residual that the effect leaves in the discs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from psfcore.blind.cases import CLEAN, PAIR
from psfcore.blind.effects.registry import KNOWN
from psfcore.blind.score import Score
from psfcore.blind.scoring import INCONCLUSIVE, NONE, UNKNOWN_VERDICT
from psfcore.drawing.plots import INK, write_png

_VERDICTS = (NONE, UNKNOWN_VERDICT, INCONCLUSIVE)


def score_png(found: Score, path: str | Path) -> None:
    """Draw two panels: the truth against the first effect named, and the power with Wilson intervals. path: a PNG file."""
    figure = Figure(figsize=(17, 9.5), dpi=90, facecolor="white", layout="constrained")
    figure.suptitle(
        f"Blind set: {found.judged} cases judged, {len(found.failures)} failed",
        fontsize=13,
        color=INK,
        weight="bold",
        x=0.01,
        ha="left",
    )
    matrix, power = figure.subplots(1, 2, width_ratios=(1.9, 1))
    _matrix(matrix, found)
    _power(power, found)
    write_png(figure, path)


def _matrix(axes: Axes, found: Score) -> None:
    rows = list(found.confusion)
    said = {name for row in found.confusion.values() for name in row}
    columns = [name for name in (*_VERDICTS, *KNOWN) if name in said or name in _VERDICTS or name in rows]
    columns += sorted(said - set(columns))
    counts = np.array([[found.confusion[row].get(column, 0) for column in columns] for row in rows])
    if not counts.size:
        axes.text(0.5, 0.5, "no case was judged", ha="center", transform=axes.transAxes)
        return
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1.3, aspect="auto")
    for (row, column), count in np.ndenumerate(counts):
        if count:
            axes.text(column, row, str(count), ha="center", va="center", fontsize=9, color=INK)
    for row, name in enumerate(rows):  # frame the correct columns of each row
        right = _right_columns(name)
        for column in (n for n, label in enumerate(columns) if label in right):
            corner = (column - 0.5, row - 0.5)
            axes.add_patch(_frame(corner))
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize=9)
    axes.set_yticks(
        range(len(rows)), [f"{name} *" if _is_foreign(name) else name for name in rows], fontsize=9
    )
    axes.set(
        xlabel="first effect named, or verdict",
        ylabel="truth (* not in the library)",
        title="Number of cases; frames mark correct verdicts",
    )


def _right_columns(truth: str) -> tuple[str, ...]:
    if truth == "clean":
        return (NONE,)
    return (UNKNOWN_VERDICT, INCONCLUSIVE) if _is_foreign(truth) else (truth,)


def _is_foreign(truth: str) -> bool:
    """Whether a row is of an effect that is not in the library; a simulator may have effects with any names."""
    return truth not in (*KNOWN, CLEAN, PAIR)


def _frame(corner: tuple[float, float]):  # type: ignore[no-untyped-def]
    from matplotlib.patches import Rectangle

    return Rectangle(corner, 1, 1, fill=False, edgecolor="#c73e2b", linewidth=1.2, clip_on=False)


def _power(axes: Axes, found: Score) -> None:
    labels = []
    for bin_of in found.power:
        low, high = bin_of["left_after_refit_pct"]
        labels.append(f"{low:g} -\n{high:g}" if high is not None else f"> {low:g}")
    at = np.arange(len(labels))
    for offset, count, hits, interval, colour, name in (
        (-0.08, "n", "noticed", "noticed_wilson95", "#1b4f91", "noticed (the verdict is not “none”)"),
        (
            0.08,
            "n_known",
            "contains_truth",
            "contains_wilson95",
            "#2b8a6e",
            "the named effects include the true ones",
        ),
    ):
        shown = [n for n, row in enumerate(found.power) if row[count]]
        share = np.array([found.power[n][hits] / found.power[n][count] for n in shown])
        ends = np.array([found.power[n][interval] for n in shown]).reshape(-1, 2)
        errors = np.abs(np.stack([share - ends[:, 0], ends[:, 1] - share])) if shown else None
        axes.errorbar(at[shown] + offset, share, yerr=errors, fmt="o-", color=colour, capsize=3, label=name)
        for n, value in zip(shown, share, strict=True):
            axes.annotate(
                f"{found.power[n][hits]}/{found.power[n][count]}",
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
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
