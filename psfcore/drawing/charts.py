"""Parts that several charts of fits and evaluations share: headings, bands, errors by pointing, distances on a log axis."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from psfcore.drawing.plots import INK, points
from psfcore.psf import REACH_GRID_PX

Vector = NDArray[np.float64]

NEAREST_PX, FARTHEST_PX = 0.5, REACH_GRID_PX / 2
POINTINGS = ("#1b4f8a", "#c2402f", "#2b8a6e", "#7b3fa0", "#8a6d00", "#5b5b5b")
_MANY_IMAGES = 60  # with this many images or more, markers are smaller
_LETTERS_AN_INCH = 11.5


def headed_figure(width_in: float, height_in: float, name: str, sentence: str) -> Figure:
    """An empty figure with a name in bold and a sentence below it."""
    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1, hspace=0.03, wspace=0.03)
    figure = Figure(figsize=(width_in, height_in), dpi=100, facecolor="white", layout=layout)
    # The layout reserves space for one title. Its first line is empty, and the name fills that line in bold.
    words = "\n".join(textwrap.wrap(sentence, int(_LETTERS_AN_INCH * width_in)))
    figure.suptitle(f"\n{words}", fontsize=11, color=INK, x=0.012, ha="left", linespacing=1.5)
    figure.text(0.012, 1 - 0.12 / height_in, name, fontsize=14, color=INK, weight="bold", va="top")
    return figure


def legend(axes: Any, size: float = 9, loc: str = "upper right", **options: Any) -> None:
    """Draw a legend without a frame."""
    axes.legend(fontsize=size, loc=loc, frameon=False, **options)


def boxed_legend(axes: Any, size: float = 9, loc: str = "best") -> None:
    """Draw a legend of two columns on a white ground, for charts that are full of lines."""
    axes.legend(fontsize=size, loc=loc, frameon=True, framealpha=0.85, edgecolor="none", ncols=2)


def marker_size(images: int) -> float:
    """The size of the markers of a chart with one point for each image."""
    return 5.0 if images < _MANY_IMAGES else 3.2


def by_pointing(pointings: Sequence[int]) -> list[tuple[int, NDArray[np.bool_], str]]:
    """Each pointing with a mask of its images and its colour. pointings: the pointing of each image."""
    of_images = np.array(pointings)
    return [
        (one, of_images == one, POINTINGS[n % len(POINTINGS)]) for n, one in enumerate(sorted(set(pointings)))
    ]


def draw_errors(
    axes: Any, pointings: Sequence[int], where: Vector, values: Vector, noise: Vector | None
) -> None:
    """Draw the errors of images, with their noise if it is known. Values of nan are not drawn.

    The colour shows the pointing. pointings, where: pointing and abscissa of each image.
    """
    axes.axhline(0, color="#555555", linewidth=1.0)
    for pointing, here, colour in by_pointing(pointings):
        bars = None if noise is None else noise[here]
        style = points(colour, marker_size(len(pointings)))
        axes.errorbar(where[here], values[here], bars, label=f"{pointing}", **style)
    span = np.abs(values) + (0.0 if noise is None else noise)
    top = 1.12 * float(span[np.isfinite(span)].max(initial=1e-3))
    axes.set_ylim(-top, 1.35 * top)
    short = {"columnspacing": 1.0, "handletextpad": 0.2}
    legend(axes, loc="upper center", title="pointing", title_fontsize=9, ncols=6, **short)


def draw_band(
    axes: Any, x: Vector, limits: NDArray[np.float64], colour: str, name: str, *, marker: str = ""
) -> None:
    """Draw a median and its bands of 1 and 2 sigma. limits: the rows -2 sigma, -1 sigma, median, +1 sigma, +2 sigma."""
    low_2, low_1, median, high_1, high_2 = limits
    axes.fill_between(x, low_2, high_2, color=colour, alpha=0.18, linewidth=0)
    axes.fill_between(x, low_1, high_1, color=colour, alpha=0.32, linewidth=0)
    axes.plot(x, median, color=colour, marker=marker, markersize=3, linewidth=1.4, label=name)


def draw_weights_of_shells(
    axes: Any, edges_px: Vector, limits: NDArray[np.float64], field_px: float, colour: str
) -> None:
    """Draw the weights of the free shells that begin within the field as steps: medians, bands of 1 and 2 sigma.

    No pixel constrains the other shells. limits: as for `draw_band`, one column for each shell. The axis is logarithmic,
    so weights of 0 are drawn as very small ones.
    """
    shown = edges_px[:-1] < field_px
    edges = edges_px[: np.count_nonzero(shown) + 1]
    low_2, low_1, median, high_1, high_2 = np.maximum(limits[:, shown], 1e-30)
    for low, high, alpha, name in ((low_2, high_2, 0.14, "±2 σ"), (low_1, high_1, 0.28, "±1 σ")):
        steps = np.append(low, low[-1]), np.append(high, high[-1])
        style: dict[str, Any] = {"color": colour, "alpha": alpha, "linewidth": 0}
        axes.fill_between(edges, *steps, step="post", label=f"free shells, {name}", **style)
    axes.stairs(median, edges, baseline=None, color=colour, linewidth=1.1, label="free shells, median")


def draw_totals(axes: Any, totals: Vector, colour: str) -> None:
    """Draw a histogram of the total scatter of all fits. totals: fractions of all light."""
    axes.hist(100 * totals, bins=min(25, max(5, totals.size // 4)), color=colour, label="folds")
    axes.set(xlabel="Diffusely scattered light (% of all light)", ylabel="Number of fits")


def along_distance(axes: Any, field_px: float, label: str = "Distance (px)") -> None:
    """Make the x axis a logarithmic axis of distances, with ticks such as 1, 10, 100.

    Distances beyond the field are shaded, because the PSF there is an extrapolation of the fitted shape.
    """
    axes.set(xscale="log", xlim=(NEAREST_PX, FARTHEST_PX), xlabel=label)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    if field_px < FARTHEST_PX:
        shade: dict[str, Any] = {"color": "#efefef", "zorder": 0, "linewidth": 0}
        axes.axvspan(field_px, FARTHEST_PX, label="beyond the field", **shade)
