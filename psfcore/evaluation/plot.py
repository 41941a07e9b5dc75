"""Plot an evaluation: slices through discs, and errors by position in the disc, time and position on the detector."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray

from psfcore.drawing.plots import CHANGE, INK, points, tidy, write_png
from psfcore.evaluation.evaluation import Evaluation, FrameEvaluation, Slice, Superposed
from psfcore.evaluation.report import sentence
from psfcore.scatter.validation.dark_offsets import DarkOffsetStudy

Vector = NDArray[np.float64]

_OBSERVED, _SIMULATED = "#444444", "#c2402f"
_POINTINGS = ("#1b4f8a", "#c2402f", "#2b8a6e", "#7b3fa0", "#8a6d00", "#5b5b5b")
_OFFSETS = ("#12407a", "#5b9bd5", "#e39a5c", "#a3301b", "#6f4a9e", "#5b5b5b")
_SLICES = 3
_MANY_IMAGES = 60  # with this many images or more, markers are smaller
_TITLE_LETTERS = 190


def evaluation_png(
    evaluation: Evaluation, path: str | Path, *, title: str, study: DarkOffsetStudy | None = None
) -> None:
    """Write a PNG with three rows of panels. If `study` is given, a fourth row shows the dark offsets.

    title: the name of the evaluated PSF or fit.
    """
    rows = 3 if study is None else 4
    figure = Figure(
        figsize=(16.0, 3.7 * rows + 0.9),
        dpi=100,
        facecolor="white",
        layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1, hspace=0.03, wspace=0.03),
    )
    # The layout reserves space for one title. Its first line is empty, and the name fills that line in bold.
    words = "\n".join(textwrap.wrap(sentence(evaluation), _TITLE_LETTERS))
    figure.suptitle(f"\n{words}", fontsize=11, color=INK, x=0.012, ha="left", linespacing=1.5)
    figure.text(0.012, 0.992, title, fontsize=14, color=INK, weight="bold", va="top")
    bands: Any = figure.subfigures(rows, 1)

    def panels(row: int, count: int) -> list[Any]:
        return list(bands[row].subplots(1, count))

    *slices, by_centre = panels(0, 4)
    shown = shown_slices(evaluation, _SLICES)
    for axes, frame in zip(slices, shown, strict=False):
        draw_slices(axes, frame)
    for axes in slices[len(shown) :]:
        axes.set_visible(False)
    draw_centres(by_centre, evaluation.frames)
    maps = panels(1, 4)
    draw_maps(bands[1], maps, evaluation.superposed)
    lines = panels(2, 4)
    draw_residuals(lines[0], evaluation.frames, minutes_of(evaluation.frames), "Time (min)", "by time")
    for axes, along in zip(lines[1:3], ("x", "y"), strict=True):
        where = np.array([getattr(f.found.place, f"{along}_px") for f in evaluation.frames])
        draw_residuals(axes, evaluation.frames, where, f"Detector {along} (px)", f"by detector {along}")
    draw_absolute(lines[3], evaluation.frames)
    charts = [*slices, by_centre, *lines]
    if study is not None:
        offsets = panels(3, 2)
        draw_offsets(offsets, study)
        charts += offsets
    tidy(charts)
    write_png(figure, path)


def shown_slices(evaluation: Evaluation, most: int) -> list[FrameEvaluation]:
    """One image for each pointing: the middle one of the images with slices. At most `most` images."""
    kept = [f for f in evaluation.frames if f.along_x is not None]
    fovs = sorted({f.pointing for f in kept})
    by_fov = [[f for f in kept if f.pointing == fov] for fov in fovs]
    return [frames[len(frames) // 2] for frames in by_fov][:most]


def draw_slices(axes: Any, frame: FrameEvaluation) -> None:
    """Draw the observed and simulated intensity along x (circles, solid line) and along y (squares, dashed line)."""
    assert frame.along_x is not None and frame.along_y is not None
    dark = frame.along_x.dark
    if dark.any():
        inside = frame.along_x.offset_px[dark]
        axes.axvspan(inside.min() - 0.5, inside.max() + 0.5, color="#eeeeee", linewidth=0, zorder=0)
    _draw_slice(axes, frame.along_x, "along x", "o", _OBSERVED, "-", _SIMULATED)
    _draw_slice(axes, frame.along_y, "along y", "s", "#7d9cc0", (0, (4, 2)), "#1b4f8a")
    # The axis is scaled to the light in the disc, because the light outside may be a hundred times brighter.
    middle = np.concatenate([s.observed[np.abs(s.offset_px) <= 14] for s in (frame.along_x, frame.along_y)])
    inner = np.concatenate([s.simulated[s.dark] for s in (frame.along_x, frame.along_y)])
    top = min(float(middle.max()), 4 * float(inner.max(initial=1e-9)))
    axes.set(
        xlim=(-20.5, 20.5),
        ylim=(min(0.0, float(middle.min())) - 0.05 * top, 1.45 * top),
        xlabel="Offset from the centre of the occulter (px)",
        ylabel="Intensity (DN/s)",
        title=f"Pointing {frame.pointing}: {frame.file:.24}, {frame.time_s / 60:.0f} min",
    )
    axes.title.set_fontsize(11)
    axes.legend(fontsize=8.5, loc="upper center", frameon=True, framealpha=0.85, edgecolor="none", ncols=2)


def _draw_slice(axes: Any, along: Slice, name: str, marker: str, face: str, dashes: Any, line: str) -> None:
    axes.plot(
        along.offset_px,
        along.observed,
        marker,
        color=face,
        markersize=3.4,
        label=f"observed {name}",
        zorder=2,
    )
    axes.plot(
        along.offset_px,
        along.simulated,
        color=line,
        linestyle=dashes,
        linewidth=1.6,
        label=f"simulated {name}",
    )


def draw_centres(axes: Any, frames: Sequence[FrameEvaluation]) -> None:
    """Draw the observed and simulated light at the centre, by time."""
    minutes = minutes_of(frames)
    observed, simulated = np.array([f.centre_dn_s for f in frames]).T
    error = np.array([f.centre_noise_dn_s for f in frames])
    axes.errorbar(minutes, observed, error, label="observed", **points(_OBSERVED, _size(frames)))
    axes.plot(minutes, simulated, "x", color=_SIMULATED, markersize=6, markeredgewidth=1.4, label="simulated")
    known = np.concatenate([v[np.isfinite(v) & (v > 0)] for v in (observed, simulated)])
    if known.size:
        axes.set(yscale="log", ylim=(0.6 * known.min(), 2.5 * known.max()))
    axes.set(xlabel="Time (min)", ylabel="Intensity (DN/s)", title="Light at the centre of the occulter")
    axes.legend(fontsize=9, loc="upper left", frameon=False)


def draw_maps(band: Any, panels: Sequence[Any], maps: Superposed) -> None:
    """Draw maps of the MPE and the MAPE. Beside each map is the map of noise alone, on the same scale."""
    mpe_top = max(maps.mpe_largest_pct, 1e-3)
    mape_top = max(float(np.nanmax([maps.mape_pct, maps.noise_mape_pct])), 1e-3)
    half = maps.half_px + 0.5
    for axes, values, title, limits, colours in (
        (panels[0], maps.mpe_pct, "MPE", (-mpe_top, mpe_top), CHANGE.with_extremes(bad="white")),
        (panels[1], maps.noise_mpe_pct, "σ of the MPE, noise alone", (0.0, mpe_top), "viridis"),
        (panels[2], maps.mape_pct, "MAPE", (0.0, mape_top), "viridis"),
        (panels[3], maps.noise_mape_pct, "MAPE, noise alone", (0.0, mape_top), "viridis"),
    ):
        drawn = axes.imshow(
            values,
            origin="lower",
            extent=(-half, half, -half, half),
            cmap=colours,
            vmin=limits[0],
            vmax=limits[1],
            interpolation="nearest",
        )
        axes.set(xlabel="x from centre (px)", ylabel="y from centre (px)", title=title)
        axes.title.set_fontsize(11)
        band.colorbar(drawn, ax=axes, label="% of the disc's mean", shrink=0.8)


def draw_residuals(
    axes: Any, frames: Sequence[FrameEvaluation], where: Vector, label: str, title: str
) -> None:
    """Draw residuals with their noise; the colour shows the pointing.

    where: abscissa of each image. label: label of the horizontal axis.
    """
    values = np.array([f.residual_pct for f in frames])
    noise = np.array([f.noise_pct for f in frames])
    draw_errors(axes, frames, where, values, noise)
    axes.set(xlabel=label, ylabel="Residual: simulated - observed (%)", title=f"Residual {title}")


def draw_absolute(axes: Any, frames: Sequence[FrameEvaluation]) -> None:
    """Draw the absolute errors by detector x.

    The vertical scale is linear near 0 and logarithmic beyond, so that it shows bright and faint discs.
    """
    values = np.array([f.error_dn_s for f in frames])
    noise = np.array([f.noise_dn_s for f in frames])
    where = np.array([f.found.place.x_px for f in frames])
    draw_errors(axes, frames, where, values, noise)
    span = np.abs(values) + noise
    linear = 10.0 ** np.ceil(
        np.log10(max(float(np.median(span)), 1e-6))
    )  # a power of ten, so that the end of the linear range has a tick label
    top = 4 * max(float(span.max()), linear)
    axes.set_yscale("symlog", linthresh=linear, linscale=1.0)
    axes.set(
        ylim=(-top, 2 * top),
        xlabel="Detector x (px)",
        ylabel="Simulated - observed (DN/s)",
        title="Absolute error by detector x",
    )


def draw_errors(
    axes: Any, frames: Sequence[FrameEvaluation], where: Vector, values: Vector, noise: Vector
) -> None:
    """Draw the errors of images with their noise; the colour shows the pointing. Values of nan are not drawn."""
    fovs = np.array([f.pointing for f in frames])
    axes.axhline(0, color="#555555", linewidth=1.0)
    for n, fov in enumerate(sorted(set(fovs.tolist()))):
        here = fovs == fov
        style = points(_POINTINGS[n % len(_POINTINGS)], _size(frames))
        axes.errorbar(where[here], values[here], noise[here], label=f"{fov}", **style)
    span = np.abs(values) + noise
    top = 1.12 * float(span[np.isfinite(span)].max(initial=1e-3))
    axes.set_ylim(-top, 1.35 * top)
    axes.legend(
        title="pointing",
        title_fontsize=9,
        fontsize=9,
        loc="upper center",
        frameon=False,
        ncols=6,
        columnspacing=1.0,
        handletextpad=0.2,
    )


def draw_offsets(panels: Sequence[Any], study: DarkOffsetStudy) -> None:
    """Draw the effect of dark offsets: relative change of the weights, and change of C(R) in percentage points."""
    weights, curve = panels
    for axes in panels:
        axes.axhline(0, color="#555555", linewidth=1.0)
    for n, offset in enumerate(study.offsets):
        style: dict[str, Any] = {"color": _OFFSETS[n % len(_OFFSETS)], "linewidth": 1.8}
        name = f"{offset.offset_dn:+g} DN"
        weights.plot(study.radii_px, offset.weight_change_pct, label=name, **style)
        curve.plot(study.curve_radii_px, offset.curve_change_points, label=f"{name}, diffuse", **style)
        curve.plot(study.curve_radii_px, offset.total_curve_change_points, linestyle=(0, (1, 1.5)), **style)
    curve.plot([], [], color="#777777", linestyle=(0, (1, 1.5)), label="total PSF (dotted)")
    weights.set(
        ylabel="Change of the diffuse weight (%)",
        title=f"Dark offsets: weights change by at most {study.largest_weight_change_pct:.1f} %",
    )
    curve.set(
        ylabel="Change of 1 - encircled energy (points)",
        title="Dark offsets: 1 - encircled energy changes by at most "
        f"{study.largest_curve_change_points:.2f} points",
    )
    for axes in panels:
        axes.set(xscale="log", xlabel="Distance (px)")
        axes.legend(fontsize=9, frameon=True, framealpha=0.85, edgecolor="none", ncols=2)


def minutes_of(frames: Sequence[FrameEvaluation]) -> Vector:
    """Time of each image in minutes from the first image of the transit."""
    return np.array([f.time_s for f in frames]) / 60


def _size(frames: Sequence[FrameEvaluation]) -> float:
    return 5.0 if len(frames) < _MANY_IMAGES else 3.2
