"""Plots of the Fresnel study, and of a design study of meshes.

Each plot has its own figure on the Agg canvas, so threads share no state. pyplot would keep a state that they share.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from psfcore.diffraction.design_study import DesignStudy, MeshDesign
from psfcore.diffraction.fresnel_study import DistanceResult, FresnelStudy
from psfcore.drawing.plots import write_png

SHOWN_PX = 30
_FRESNEL, _COMBINED, _DIFFERENCE, _INK = "#1f6fb4", "#e0761a", "#2b8a4e", "#222222"

_COLOURS = ("#1b4f8a", "#7b3fa0", "#c2402f", "#e0a100", "#2b8a6e", "#1b1b1b")
_Number = Callable[[MeshDesign], float | None]


def fresnel_png(study: FresnelStudy, path: str | Path) -> None:
    """Draw three panels: the centre of the PSF, 1 - encircled energy with the difference, and all distances.

    The first two panels show the distance of the study that is nearest to the printed distance.
    """
    shown = min(study.distances, key=lambda result: abs(result.distance_mm - study.printed_distance_mm))
    figure = Figure(
        figsize=(15.6, 5.4), dpi=100, facecolor="white", layout=ConstrainedLayoutEngine(w_pad=0.1)
    )
    heading = (
        f"{study.instrument}: Fresnel and simplified-combined in one dimension, "
        f"filter wheel {shown.distance_mm:g} mm from the detector"
    )
    focus = study.focus
    below = (
        f"best focus: mirror separation {focus.separation_mm:.2f} mm ({focus.shift_mm:+.2f} mm from the printed "
        f"value), focal length {focus.focal_length_mm:.0f} mm; mean of {study.phases} mesh phases; series of "
        f"{study.windows} windows"
    )
    figure.suptitle(f"{heading}\n{below}", fontsize=11.5, color=_INK, x=0.01, ha="left")
    centre_axes, curve_axes, distance_axes = figure.subplots(1, 3)
    _draw_centre(centre_axes, shown, study.reach_px)
    _draw_curves(curve_axes, shown, study)
    _draw_distances(distance_axes, study)
    for axes in (centre_axes, curve_axes, distance_axes):
        axes.grid(which="major", color="#dddddd", linewidth=0.7)
        axes.spines["top"].set_visible(False)
    write_png(figure, path)


def _draw_centre(axes: Axes, shown: DistanceResult, centre: int) -> None:
    offsets = np.arange(-SHOWN_PX, SHOWN_PX + 1)
    near = slice(centre - SHOWN_PX, centre + SHOWN_PX + 1)
    # Where the two curves agree, the wider curve is visible on both sides of the thinner curve.
    for line, colour, width, label in (
        (shown.combined_line, _COMBINED, 3.2, "Simplified-combined"),
        (shown.fresnel_line, _FRESNEL, 1.2, "Fresnel"),
    ):
        axes.semilogy(offsets, line[near], color=colour, label=label, drawstyle="steps-mid", linewidth=width)
    axes.set(xlabel="Offset (px)", ylabel="Weight (fraction per pixel)", title="Centre of the PSF")
    axes.legend(frameon=False, loc="upper right")


def _draw_curves(axes: Axes, shown: DistanceResult, study: FresnelStudy) -> None:
    # The central pixel, radius 0, is drawn at half a pixel, because a logarithmic axis has no zero.
    radii_px = np.maximum(study.radii_px, 0.5)
    axes.semilogx(
        radii_px, shown.combined_beyond_pct, color=_COMBINED, linewidth=3.2, label="Simplified-combined"
    )
    axes.semilogx(radii_px, shown.fresnel_beyond_pct, color=_FRESNEL, linewidth=1.2, label="Fresnel")
    axes.semilogx(
        radii_px, shown.difference_points, color=_DIFFERENCE, label="Difference (percentage points)"
    )
    axes.fill_between(
        radii_px,
        shown.phase_lowest_points,
        shown.phase_highest_points,
        color=_DIFFERENCE,
        alpha=0.2,
        linewidth=0,
        label="Difference, single phases",
    )
    axes.axhline(0, color=_INK, linewidth=0.7)
    title = f"Light beyond a distance: largest difference {shown.largest_points:.2f} points"
    axes.set(xlabel="Distance (px)", ylabel="1 - encircled energy (%)", title=title)
    axes.legend(frameon=False, loc="upper right")


def _draw_distances(axes: Axes, study: FresnelStudy) -> None:
    distances_mm = [result.distance_mm for result in study.distances]
    singles = np.array([result.phase_largest_points for result in study.distances])
    axes.vlines(
        distances_mm,
        singles.min(axis=1),
        singles.max(axis=1),
        color=_DIFFERENCE,
        alpha=0.4,
        linewidth=5,
        label="Single phases, lowest to highest",
    )
    means = [result.largest_points for result in study.distances]
    axes.plot(distances_mm, means, "o-", color=_DIFFERENCE, label="Mean over phases")
    axes.axhline(1.0, color=_INK, linewidth=0.8, linestyle=":", label="1 percentage point")
    axes.axvline(study.printed_distance_mm, color="#888888", linewidth=0.8)
    axes.set(
        xlabel="Filter wheel to detector (mm)",
        ylabel="Largest difference (percentage points)",
        title="Largest difference by distance",
    )
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False, loc="upper right")


def design_png(study: DesignStudy, path: str | Path) -> None:
    """Draw each quantity against the pitch, one curve per wire width; a star marks the flown mesh."""
    panels: list[tuple[str, str, _Number]] = [
        ("All diffracted light", "% of all light", lambda row: row.diffracted_pct),
        ("Light beyond 10 px", "1 - encircled energy (%)", lambda row: row.beyond_10_px_pct),
        ("Light beyond 100 px", "1 - encircled energy (%)", lambda row: row.beyond_100_px_pct),
        (
            f"Contrast of the orders, flare of {study.flare_px} px",
            "contrast",
            lambda row: row.peak_visibility,
        ),
    ]
    if all(row.peak_over_scatter is not None for row in study.rows):
        panels.append(("Order divided by scatter, 50 to 150 px", "ratio", lambda row: row.peak_over_scatter))
    layout = ConstrainedLayoutEngine(w_pad=0.08, wspace=0.04)
    figure = Figure(figsize=(4.1 * len(panels), 4.6), dpi=100, facecolor="white", layout=layout)
    figure.suptitle(
        f"Entrance mesh of {study.instrument}: effect of pitch and wire width",
        x=0.01,
        ha="left",
        weight="bold",
    )
    for axes, (title, label, value) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        _panel(axes, study, value)
        axes.set_title(title, fontsize=11, loc="left")
        axes.set(xlabel="Pitch (um)", ylabel=label)
    figure.axes[0].legend(frameon=False, fontsize=9)
    write_png(figure, path)


def _panel(axes: Axes, study: DesignStudy, value: _Number) -> None:
    wires = sorted({row.wire_um for row in study.rows})
    for index, wire in enumerate(wires):
        rows = [row for row in study.rows if row.wire_um == wire]
        axes.plot(
            [row.pitch_um for row in rows],
            np.array([value(row) for row in rows], dtype=np.float64),
            color=_COLOURS[index % len(_COLOURS)],
            marker="o",
            markersize=3,
            linewidth=1.5,
            label=f"wire {wire:g} um",
        )
    if study.flown is not None:
        axes.plot(
            [study.flown.pitch_um],
            np.array([value(study.flown)], dtype=np.float64),
            marker="*",
            markersize=13,
            color="#1b1b1b",
            linestyle="none",
            label=f"flown: pitch {study.flown.pitch_um:g}, wire {study.flown.wire_um:g} um",
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_ylim(bottom=0)
    axes.grid(which="major", color="#dddddd", linewidth=0.7)
    axes.spines[["top", "right"]].set_visible(False)
