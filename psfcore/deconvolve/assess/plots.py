"""Draw a page with six panels that show what a deconvolution changed in an image, and the main numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import Colormap, LogNorm, Normalize, SymLogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from psfcore.deconvolve.assess.changes import Changes, block_means
from psfcore.drawing.plots import (
    CHANGE,
    CHANGE_LIMIT_PCT,
    GOLD,
    INK,
    binned,
    change_pct,
    colourbar,
    square_root_stretch,
    write_png,
)

PANEL_PX = 640
_HISTOGRAM_BLOCK_PX = 4
_RATIO_MARKS = (0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0)
_BEFORE, _AFTER = "#1f6fb4", "#d5642f"

Plane = NDArray[np.float64]


def changes_png(
    before: Plane, after: Plane, changes: Changes, path: str | Path, *, title: str, unit: str
) -> None:
    """Draw before, after, change in percent, difference, ratio and histogram into a PNG file.

    before, after: pixels [y, x] in `unit`; row 0 is drawn at the bottom. changes: the numbers below the panels.
    """
    step = max(1, -(-max(before.shape) // PANEL_PX))
    old, new = binned(before, step), binned(after, step)
    stretch = square_root_stretch(old, new)
    difference = new - old
    limit = max(_largest(difference), 1e-12)
    ratio = np.divide(new, old, out=np.full(old.shape, np.nan), where=old > 0)
    ratio = np.where(ratio > 0, ratio, np.nan)
    span = max(1.1, 2 ** _largest(np.log2(ratio)))
    panels: list[tuple[str, Plane, Colormap, Normalize, str]] = [
        (f"Before ({unit})", old, GOLD, stretch, "max"),
        (f"After ({unit})", new, GOLD, stretch, "max"),
        ("Change (% of before)", change_pct(old, new), CHANGE, Normalize(-CHANGE_LIMIT_PCT, CHANGE_LIMIT_PCT), "both"),
        (f"After - before ({unit})", difference, CHANGE, SymLogNorm(limit / 30, vmin=-limit, vmax=limit), "both"),
        ("After / before", ratio, CHANGE, LogNorm(1 / span, span), "both"),
    ]  # fmt: skip
    figure = Figure(figsize=(15.6, 11.1), dpi=100, facecolor="white")
    figure.text(0.045, 0.977, title, fontsize=13, color=INK, va="center", weight="bold")
    extent = (-0.5, before.shape[1] - 0.5, -0.5, before.shape[0] - 0.5)
    for index, (name, data, colours, norm, beyond) in enumerate(panels):
        axes = figure.add_axes(_place(index))
        drawn = axes.imshow(
            data, origin="lower", cmap=colours, norm=norm, extent=extent, interpolation="nearest"
        )
        axes.set_title(name, fontsize=11, color=INK, loc="left")
        axes.set_xlabel("x (px)")
        if index % 3 == 0:
            axes.set_ylabel("y (px)")
        else:
            axes.set_yticks([])
        colourbar(figure, axes, drawn, beyond=beyond)
    marks = [mark for mark in _RATIO_MARKS if 1 / span <= mark <= span]
    ratio_bar = figure.axes[-1]
    ratio_bar.set_yticks(marks, [f"{mark:g}" for mark in marks])
    ratio_bar.set_yticks([], minor=True)
    left, bottom, width, height = _place(5)
    _draw_histogram(figure.add_axes((left + 0.02, bottom, width, height)), before, after, unit)
    figure.text(0.045, 0.022, _figures(changes), fontsize=10, color=INK, va="center")
    write_png(figure, path, pil_kwargs={"compress_level": 3})


def _place(index: int) -> tuple[float, float, float, float]:
    row, column = divmod(index, 3)
    return 0.045 + 0.318 * column, 0.555 - 0.465 * row, 0.266, 0.38


def _draw_histogram(axes: Any, before: Plane, after: Plane, unit: str) -> None:
    """Histogram of block means before and after, with logarithmic bins."""
    counted = np.isfinite(before) & np.isfinite(after)
    means = [block_means(plane, counted, _HISTOGRAM_BLOCK_PX) for plane in (before, after)]
    positive = [values[values > 0] for values in means]
    if min(values.size for values in positive) == 0:
        axes.set_axis_off()
        return
    low = min(float(np.percentile(values, 0.01)) for values in positive)
    bins = np.geomspace(low, max(float(values.max()) for values in positive) * 1.01, 121)
    for values, name, colour in zip(positive, ("before", "after"), (_BEFORE, _AFTER), strict=True):
        axes.hist(values, bins=bins, histtype="step", color=colour, linewidth=1.6, label=name)
        for level in np.percentile(values, [1, 99]):
            axes.axvline(level, color=colour, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set(
        xscale="log",
        yscale="log",
        xlabel=f"Mean of {_HISTOGRAM_BLOCK_PX} x {_HISTOGRAM_BLOCK_PX} px ({unit})",
    )
    axes.set_title("Blocks by brightness; dashed: percentiles 1, 99", fontsize=11, color=INK, loc="left")
    axes.tick_params(labelsize=8.5)
    axes.legend(frameon=False, loc="upper left")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _figures(changes: Changes) -> str:
    """The line of text below the panels, for blocks of 4 px and the brightest and darkest 1 % of them."""
    parts = [
        f"{row.kind} {row.tail_pct:g} % of {row.block_px} px blocks: {row.sum_pct:+.0f} %, up to {row.up_to_pct:+.0f} %"
        for row in changes.structures
        if (row.block_px, row.tail_pct) == (4, 1.0)
    ]
    parts += [
        f"dynamic range (percentile 99 / percentile 1): {_number(row.dynamic_before)} -> {_number(row.dynamic_after)}"
        for row in changes.ranges
        if (row.block_px, row.tail_pct) == (4, 1.0)
    ]
    parts.append(f"artefact score {changes.artefacts.score:.2f} (inspect from 1)")
    return "     ".join(parts)


def _number(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.1f}"


def _largest(plane: Plane) -> float:
    """99.5th percentile of the finite absolute values, or 0."""
    finite = np.abs(plane[np.isfinite(plane)])
    return float(np.percentile(finite, 99.5)) if finite.size else 0.0
