"""Plot a cross-validation: free fit and formula with their bands, totals of all fits, residuals of held-out images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from psfcore.drawing.plots import INK, tidy, write_png
from psfcore.scatter.shapes import Vector
from psfcore.scatter.validation.cross_validation import Bands, FoldFit, ShellBands

FORMULA, FREE = "#2f6db0", "#2b8a4e"
_POINTINGS = ("#1b4f91", "#c73e2b", "#2b8a6e", "#e0a100", "#7b3fa0")


def cross_validation_png(
    bands: Bands, fits: tuple[FoldFit, ...], fov_of: list[int], path: str | Path
) -> None:
    """Write a PNG with C(R), the totals of all fits, and the residuals of held-out images; bands of 1 and 2 sigma.

    If there is a free fit, an upper row of panels compares it with the formula: weights, diffuse light and excess.
    fov_of: the pointing of each image.
    """
    rows = 1 if bands.shells is None else 2
    figure = Figure(figsize=(15.6, 4.9 * rows), dpi=100, facecolor="white", layout="constrained")
    figure.suptitle(
        f"Cross-validation, {len(fits)} fits: medians, 1 and 2 sigma",
        fontsize=13,
        color=INK,
        weight="bold",
        x=0.01,
        ha="left",
    )
    panels = figure.subplots(rows, 3, squeeze=False)
    if bands.shells is not None:
        draw_weights(panels[0, 0], bands.shells)
        draw_diffuse_light(panels[0, 1], bands.shells)
        draw_excess(panels[0, 2], bands.shells)
    draw_curve(panels[-1, 0], bands)
    draw_totals(panels[-1, 1], bands)
    draw_held_out(panels[-1, 2], bands, fov_of)
    tidy(list(panels.flat))
    write_png(figure, path)


def draw_weights(axes: Axes, shells: ShellBands) -> None:
    """Draw the weight per pixel of the diffuse scatter against distance, for the free fits and the formula."""
    radius = np.sqrt(shells.edges_px[1:] * shells.edges_px[:-1])
    lowest = 0.1 * float(shells.law_weight.min())
    _band(axes, radius, shells.law_weight, FORMULA, "formula")
    # The logarithmic axis cannot show a shell without light, so the median of such a shell is not drawn.
    free = np.maximum(shells.free_weight, lowest)
    free[2, shells.free_weight[2] < lowest] = np.nan
    _band(axes, radius, free, FREE, "free fit", marker="o", line="")
    axes.set(
        xscale="log",
        yscale="log",
        ylim=(lowest, None),
        xlabel="Distance (px)",
        ylabel="Weight per pixel",
        title="Diffuse scatter",
    )
    axes.legend(frameon=False)


def draw_diffuse_light(axes: Axes, shells: ShellBands) -> None:
    """Draw 1 - encircled energy of the scatter kernel, in percent of all light."""
    for name, limits, colour in (
        ("free fit", shells.free_beyond_pct, FREE),
        ("formula", shells.law_beyond_pct, FORMULA),
    ):
        _band(axes, shells.edges_px[:-1], limits, colour, name)
    axes.set(
        xscale="log",
        ylim=(0, None),
        xlabel="Distance (px)",
        ylabel="1 - encircled energy (%)",
        title="Diffuse scatter",
    )
    axes.legend(frameon=False)


def draw_excess(axes: Axes, shells: ShellBands) -> None:
    """Draw the excess within each distance (light of the free fit minus light of the formula), with its error."""
    radius, sigma = shells.edges_px[1:], shells.excess_sigma
    axes.fill_between(
        radius, -sigma, sigma, color="#bbbbbb", alpha=0.5, linewidth=0, label="error: image noise and prior"
    )
    _band(axes, radius, shells.excess_pct, FREE, "all fits")
    axes.axhline(0.0, color=INK, linewidth=0.8)
    near = shells.near_centre
    axes.set(
        xscale="log",
        xlabel="Distance (px)",
        ylabel="Light within distance: free - formula (%)",
        title=f"Within {near.within_px:g} px: {near.points:+.1f} ± {near.sigma:.1f} %",
    )
    axes.legend(frameon=False)


def draw_curve(axes: Axes, bands: Bands) -> None:
    """Draw 1 - encircled energy of the total PSF, percent."""
    _band(axes, bands.radii_px, bands.curve_pct, FORMULA, "median", marker="o")
    axes.set(
        xscale="log",
        xlabel="Distance (px)",
        ylabel="1 - encircled energy (%)",
        title="Total PSF",
        ylim=(0, None),
    )
    axes.legend(frameon=False)


def draw_totals(axes: Axes, bands: Bands) -> None:
    """Draw a histogram of the scatter totals (percent of all light) of all fits."""
    axes.hist(100 * bands.totals, bins=min(25, max(5, bands.totals.size // 4)), color=FORMULA)
    axes.set(
        xlabel="Diffusely scattered light (%)", ylabel="Number of fits", title="Scattered light, all fits"
    )


def draw_held_out(axes: Axes, bands: Bands, fov_of: list[int]) -> None:
    """Draw the residual of each held-out image, coloured by pointing. fov_of: the pointing of each image."""
    images = np.array(list(bands.held_out_pct))
    residual = np.array(list(bands.held_out_pct.values()))
    fov = np.array([fov_of[n] for n in images])
    for k, pointing in enumerate(np.unique(fov)):
        here = fov == pointing
        colour = _POINTINGS[k % len(_POINTINGS)]
        axes.plot(images[here], residual[here], "o", color=colour, markersize=4, label=f"pointing {pointing}")
    axes.axhline(0.0, color=INK, linewidth=0.8)
    axes.set(xlabel="Image", ylabel="Residual: simulated - observed (%)", title="Held-out images")
    axes.legend(frameon=False, ncols=3)


def _band(
    axes: Axes, x: Vector, limits: Vector, colour: str, name: str, *, marker: str = "", line: str = "-"
) -> None:
    """Draw a median and its bands of 1 and 2 sigma. limits: the rows -2 sigma, -1 sigma, median, +1 sigma, +2 sigma."""
    low_2, low_1, median, high_1, high_2 = limits
    axes.fill_between(x, low_2, high_2, color=colour, alpha=0.18, linewidth=0)
    axes.fill_between(x, low_1, high_1, color=colour, alpha=0.32, linewidth=0)
    axes.plot(x, median, line, color=colour, marker=marker, markersize=3, linewidth=1.4, label=name)
