"""Plot an evaluation: slices through discs, and errors by position in the disc, time and position on the detector."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from psfcore.arrays import Vector
from psfcore.drawing.plots import (
    CHANGE,
    boxed_legend,
    draw_errors,
    headed_figure,
    legend,
    marker_size,
    points,
    tidy,
    write_png,
)
from psfcore.evaluation.evaluation import Evaluation, FrameEvaluation, Superposed
from psfcore.evaluation.report import each, sentence
from psfcore.scatter.validation.robustness import DarkOffsetStudy

_OBSERVED, _SIMULATED = "#444444", "#c2402f"
_OFFSETS = ("#12407a", "#5b9bd5", "#e39a5c", "#a3301b", "#6f4a9e", "#5b5b5b")
_DOTS = (0, (1, 1.5))
_SLICES = 3


def evaluation_png(
    evaluation: Evaluation, path: str | Path, *, title: str, study: DarkOffsetStudy | None = None
) -> None:
    """Write a PNG with three rows of panels. If `study` is given, a fourth row shows the dark offsets.

    Parameters
    ----------
    title
        The name of the evaluated PSF or fit.
    """
    rows = 3 if study is None else 4
    figure = headed_figure(16.0, 3.7 * rows + 0.9, title, sentence(evaluation))
    bands = figure.subfigures(rows, 1, squeeze=False)[:, 0]
    *slices, by_centre = bands[0].subplots(1, 4)
    shown = shown_slices(evaluation, _SLICES)
    draw_slices(slices, shown, 8.5)
    draw_centres(by_centre, evaluation.frames)
    draw_maps(bands[1], list(bands[1].subplots(1, 4)), evaluation.superposed)
    frames, lines = evaluation.frames, bands[2].subplots(1, 4)
    for axes, (label, where) in zip(lines, positions(frames).items(), strict=False):
        draw_errors(axes, pointings(frames), where, each(frames, "residual_pct"), each(frames, "noise_pct"))
        axes.set(xlabel=label, ylabel="Residual: simulated - observed (%)", title="Residual")
    draw_absolute(lines[3], frames)
    charts = [*slices, by_centre, *lines]
    if study is not None:
        offsets = list(bands[3].subplots(1, 2))
        draw_offsets(offsets, study)
        for axes in offsets:
            boxed_legend(axes)
        charts += offsets
    tidy(charts)
    write_png(figure, path)


def pointings(frames: Sequence[FrameEvaluation]) -> list[int]:
    """The pointing of every image."""
    return [frame.pointing for frame in frames]


def positions(frames: Sequence[FrameEvaluation]) -> dict[str, Vector]:
    """The time of every image, and the position of its occulter on the detector, by the label of an axis."""
    return {
        "Time from the first image (min)": each(frames, "time_s") / 60,
        "Detector x of the occulter (px)": np.array([f.found.place.x_px for f in frames]),
        "Detector y of the occulter (px)": np.array([f.found.place.y_px for f in frames]),
    }


def shown_slices(evaluation: Evaluation, most: int) -> list[FrameEvaluation]:
    """One image for each pointing: the middle one of the images with slices. At most `most` images."""
    kept = [f for f in evaluation.frames if f.along_x is not None]
    by_fov = [[f for f in kept if f.pointing == fov] for fov in sorted(set(pointings(kept)))]
    return [frames[len(frames) // 2] for frames in by_fov][:most]


def draw_slices(charts: Sequence[Axes], frames: Sequence[FrameEvaluation], letters: float) -> None:
    """Draw the slices of each image on a chart, with a legend whose letters have this size. Hide the charts that are
    left.
    """
    for axes, frame in zip(charts, frames, strict=False):
        _draw_slices(axes, frame)
        boxed_legend(axes, letters, "upper center")
    for axes in charts[len(frames) :]:
        axes.set_visible(False)


def _draw_slices(axes: Axes, frame: FrameEvaluation) -> None:
    """Draw the observed and simulated intensity along x (circles, solid line) and along y (squares, dashed line)."""
    assert frame.along_x is not None and frame.along_y is not None
    dark = frame.along_x.dark
    if dark.any():
        inside = frame.along_x.offset_px[dark]
        axes.axvspan(inside.min() - 0.5, inside.max() + 0.5, color="#eeeeee", linewidth=0, zorder=0)
    for name, along, marker, face, dashes, line in (
        ("along x", frame.along_x, "o", _OBSERVED, "-", _SIMULATED),
        ("along y", frame.along_y, "s", "#7d9cc0", (0, (4, 2)), "#1b4f8a"),
    ):
        axes.plot(
            along.offset_px,
            along.observed_dn_s,
            marker,
            color=face,
            markersize=3.4,
            zorder=2,
            label=f"observed {name}",
        )
        axes.plot(
            along.offset_px,
            along.simulated_dn_s,
            color=line,
            linestyle=dashes,
            linewidth=1.6,
            label=f"simulated {name}",
        )
    # The axis is scaled to the light in the disc, because the light outside may be a hundred times brighter.
    middle = np.concatenate(
        [s.observed_dn_s[np.abs(s.offset_px) <= 14] for s in (frame.along_x, frame.along_y)]
    )
    inner = np.concatenate([s.simulated_dn_s[s.dark] for s in (frame.along_x, frame.along_y)])
    top = min(float(middle.max()), 4 * float(inner.max(initial=1e-9)))
    axes.set(
        xlim=(-20.5, 20.5),
        ylim=(min(0.0, float(middle.min())) - 0.05 * top, 1.45 * top),
        xlabel="Offset from the centre of the occulter (px)",
        ylabel="Intensity (DN/s)",
    )
    axes.set_title(f"Pointing {frame.pointing}: {frame.file:.20}, {frame.time_s / 60:.0f} min", fontsize=10)


def draw_centres(axes: Axes, frames: Sequence[FrameEvaluation]) -> None:
    """Draw the observed and simulated light at the centre, by time."""
    minutes = each(frames, "time_s") / 60
    observed, simulated = each(frames, "centre_dn_s").T
    axes.errorbar(
        minutes,
        observed,
        each(frames, "centre_noise_dn_s"),
        label="observed",
        **points(_OBSERVED, marker_size(len(frames))),
    )
    axes.plot(minutes, simulated, "x", color=_SIMULATED, markersize=6, markeredgewidth=1.4, label="simulated")
    known = np.concatenate([v[np.isfinite(v) & (v > 0)] for v in (observed, simulated)])
    if known.size:
        axes.set(yscale="log", ylim=(0.6 * known.min(), 2.5 * known.max()))
    axes.set(xlabel="Time (min)", ylabel="Intensity (DN/s)", title="Light at the centre of the occulter")
    legend(axes, loc="upper left")


def draw_maps(band: Figure | SubFigure, panels: Sequence[Axes], maps: Superposed) -> None:
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
            interpolation="nearest",
            cmap=colours,
            vmin=limits[0],
            vmax=limits[1],
        )
        axes.set(xlabel="x from centre (px)", ylabel="y from centre (px)")
        axes.set_title(title, fontsize=11)
        band.colorbar(drawn, ax=axes, label="% of the disc's mean", shrink=0.8)


def draw_absolute(axes: Axes, frames: Sequence[FrameEvaluation]) -> None:
    """Draw the absolute errors by detector x.

    The vertical scale is linear near 0 and logarithmic beyond, so that it shows bright and faint discs.
    """
    values, noise = each(frames, "error_dn_s"), each(frames, "noise_dn_s")
    label = "Detector x of the occulter (px)"
    draw_errors(axes, pointings(frames), positions(frames)[label], values, noise)
    span = np.abs(values) + noise
    # A power of ten, so that the end of the linear range has a tick label.
    linear = 10.0 ** np.ceil(np.log10(max(float(np.median(span)), 1e-6)))
    top = 4 * max(float(span.max()), linear)
    axes.set_yscale("symlog", linthresh=linear, linscale=1.0)
    axes.set(ylim=(-top, 2 * top), xlabel=label, ylabel="Simulated - observed (DN/s)", title="Absolute error")


def draw_offsets(panels: Sequence[Axes], study: DarkOffsetStudy) -> None:
    """Draw the effect of dark offsets: relative change of the weights, and change of C(R) in percentage points."""
    weights, curve = panels
    for axes in panels:
        axes.axhline(0, color="#555555", linewidth=1.0)
        axes.set(xscale="log", xlabel="Distance (px)")
    for n, offset in enumerate(study.offsets):
        colour = _OFFSETS[n % len(_OFFSETS)]
        name = f"{offset.offset_dn:+g} DN"
        weights.plot(study.radii_px, offset.weight_change_pct, label=name, color=colour, linewidth=1.8)
        curve.plot(
            study.curve_radii_px,
            offset.curve_change_points,
            label=f"{name}, diffuse",
            color=colour,
            linewidth=1.8,
        )
        curve.plot(
            study.curve_radii_px,
            offset.total_curve_change_points,
            linestyle=_DOTS,
            color=colour,
            linewidth=1.8,
        )
    curve.plot([], [], color="#777777", linestyle=_DOTS, label="total PSF (dotted)")
    weights.set(
        ylabel="Change of the diffuse weight (%)",
        title=f"Dark offsets: weights change by at most {study.largest('weight_change_pct'):.1f} %",
    )
    curve.set(
        ylabel="Change of 1 - encircled energy (points)",
        title=f"1 - encircled energy changes by at most {study.largest('curve_change_points'):.2f} points",
    )
