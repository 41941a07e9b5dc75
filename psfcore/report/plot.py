"""Figures of a report on a PSF, as PNG, for a page about ten inches wide."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from psfcore.drawing.page import PLOT_DPI
from psfcore.drawing.plots import png_of, points, tidy
from psfcore.evaluation.evaluation import Evaluation, Superposed
from psfcore.evaluation.plot import (
    draw_absolute,
    draw_centres,
    draw_errors,
    draw_maps,
    draw_offsets,
    draw_slices,
    minutes_of,
    shown_slices,
)
from psfcore.psf import REACH_GRID_PX
from psfcore.report.report import CrossValidated, PsfReport
from psfcore.scatter.fit import RADII_PX, TransitFit
from psfcore.scatter.total_psf import DIFFRACTION, SCATTER
from psfcore.scatter.validation.cross_validation import ShellBands
from psfcore.scatter.validation.dark_offsets import DarkOffsetStudy
from psfcore.tables.make import TOTAL

Vector = NDArray[np.float64]

WIDTH_IN = 9.9
MOST_SLICES = 6
_NEAREST_PX, _FARTHEST_PX = 0.5, REACH_GRID_PX / 2
_COLOURS = {TOTAL: "#111111", DIFFRACTION: "#7b3fa0", SCATTER: "#c77f00"}
_NAMES = {TOTAL: "total", DIFFRACTION: "diffraction", SCATTER: "diffuse scatter"}
_FREE, _BAND = "#1f6fb4", "#4f8cc4"


def curves_png(report: PsfReport) -> bytes:
    """1 - encircled energy of the total PSF. For a fit, also of its diffuse scatter, with the uncertainties below."""
    if report.fit is None:
        figure, (total,) = _figure(5.6, 3.9, 1)
        _draw_curve(total, report, TOTAL)
        charts = [total]
    else:
        figure, charts = _figure(WIDTH_IN, 7.0, 2, 2, heights=(1.3, 1.0))
        for column, name in enumerate((TOTAL, SCATTER)):
            _draw_curve(charts[column], report, name)
            _draw_spread(charts[2 + column], report, name)
        if report.cross is not None and report.cross.bands.shells is not None:
            _draw_free(charts[1], charts[3], report, report.cross.bands.shells)
    for axes in charts:
        _mark_field(axes, report)
        axes.legend(fontsize=8, loc="upper right", frameon=False)
    for axes in charts[:2]:
        axes.set_ylim(0, None)
    for axes in charts[2:]:
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.45 * (high - low))  # room for the legend
        axes.legend(fontsize=7.5, loc="upper right", frameon=False, ncols=2)
    tidy(charts)
    return png_of(figure)


def _draw_curve(axes: Any, report: PsfReport, name: str) -> None:
    """Draw 1 - encircled energy of a component, with its error."""
    radii, beyond, sigma = beyond_of(report.tables, name)
    axes.fill_between(radii, beyond - sigma, beyond + sigma, color=_COLOURS[name], alpha=0.3, linewidth=0)
    axes.plot(radii, beyond, color=_COLOURS[name], linewidth=1.5, label=_NAMES[name])
    axes.set(xscale="log", xlim=(_NEAREST_PX, _FARTHEST_PX), ylim=(0, None))
    axes.set(xlabel="Distance R (px)", ylabel="1 - encircled energy (%)", title=_title(name))
    _plain_ticks(axes)


def _draw_spread(axes: Any, report: PsfReport, name: str) -> None:
    """Draw differences from the fitted curve of a component: bands of the folds, and bars for the error of the fit."""
    radii, _, sigma = beyond_of(report.tables, name)
    found = _folds_of(report, name)
    if found is not None:
        at, limits = found
        low_2, low_1, median, high_1, high_2 = limits
        axes.fill_between(at, low_2, high_2, color=_BAND, alpha=0.25, linewidth=0, label="folds, 2 sigma")
        axes.fill_between(at, low_1, high_1, color=_BAND, alpha=0.5, linewidth=0, label="folds, 1 sigma")
        axes.plot(at, median, color="#12407a", linewidth=1.2, label="folds, median")
    axes.axhline(0, color="#555555", linewidth=1.0)
    shown = np.searchsorted(radii, [r for r in RADII_PX if r < radii[-1]])
    axes.errorbar(
        radii[shown],
        np.zeros(shown.size),
        sigma[shown],
        label="fit to all images, ±1 σ",
        **points(_COLOURS[name], 3.0),
    )
    axes.set(xscale="log", xlim=(_NEAREST_PX, _FARTHEST_PX))
    axes.set(xlabel="Distance R (px)", ylabel="Difference from the fit (points)")
    _plain_ticks(axes)


def _folds_of(report: PsfReport, name: str) -> tuple[Vector, NDArray[np.float64]] | None:
    """Two arrays: radii, and the bands of the folds minus the fitted curve of a component.

    None if there is no cross-validation or it has no bands of this component.
    """
    if report.cross is None:
        return None
    bands = report.cross.bands
    if name == TOTAL:
        radii, beyond, _ = beyond_of(report.tables, name)
        return bands.radii_px, bands.curve_pct - np.interp(bands.radii_px, radii, beyond)
    if bands.shells is None:
        return None
    edges = bands.shells.edges_px[:-1]
    shown = edges >= _NEAREST_PX
    return edges[shown], bands.shells.law_beyond_pct[:, shown] - _from(report, name, edges[shown])


def _from(report: PsfReport, name: str, edges: Vector) -> Vector:
    """The percentage of light beyond each distance. Pixels exactly at the distance are included."""
    radii, beyond, _ = beyond_of(report.tables, name)
    just_below = edges * (1 - 1e-9)
    within = np.maximum(np.searchsorted(radii, just_below) - 1, 0)
    exact = just_below <= report.tables["exact_to_px"]  # up to this radius, the curve is a step function
    return np.asarray(np.where(exact, beyond[within], np.interp(just_below, radii, beyond)))


def _draw_free(curve: Any, spread: Any, report: PsfReport, shells: ShellBands) -> None:
    """Draw the diffuse light beyond the inner edge of each free shell within the field: median and spread of the folds."""
    edges = shells.edges_px[:-1]
    shown = (edges >= 1) & (edges < max(report.transit.shape))
    low_2, low_1, median, high_1, high_2 = shells.free_beyond_pct[:, shown]
    fitted = _from(report, SCATTER, edges[shown])
    for axes, middle in ((curve, median), (spread, median - fitted)):
        for low, high, width, label in (
            (low_2, high_2, 0.7, None),
            (low_1, high_1, 1.6, "free shells, 1 and 2 sigma"),
        ):
            span = np.maximum([median - low, high - median], 0.0)
            style = points(_FREE, 3.2) | {"elinewidth": width}
            axes.errorbar(edges[shown], middle, span, label=label, zorder=3, **style)


def _title(name: str) -> str:
    return {TOTAL: "Total PSF", SCATTER: "Diffuse scatter alone"}.get(name, name.lower())


def beyond_of(tables: dict[str, Any], name: str) -> tuple[Vector, Vector, Vector]:
    """Radii (px), 100 (1 - encircled energy) of a component at these radii, and its standard error (0: not known)."""
    radii = np.array(tables["radii_px"])
    encircled = np.array(tables["encircled"][name])
    changes = np.array(tables["encircled_changes"].get(name, np.zeros((1, radii.size))))
    near = radii < _NEAREST_PX
    # The curve begins at half a pixel. This radius encloses only the central pixel.
    shown = np.concatenate(([np.flatnonzero(near)[-1]], np.flatnonzero(~near)))
    r = np.where(near[shown], _NEAREST_PX, radii[shown])
    beyond = 100 * np.maximum(1 - encircled[shown], 0.0)
    return r, beyond, 100 * np.linalg.norm(changes[:, shown], axis=0)


def _mark_field(axes: Any, report: PsfReport) -> None:
    """Shade distances beyond the field, where the PSF is an extrapolation of the fitted shape."""
    field = max(report.transit.shape)
    if field < _FARTHEST_PX:
        axes.axvspan(field, _FARTHEST_PX, color="#efefef", zorder=0, linewidth=0, label="beyond the field")


def profile_png(report: PsfReport) -> bytes:
    """Mean weight per pixel by radius: diffraction, diffuse scatter and total PSF, with errors if they are known."""
    figure, (axes,) = _figure(7.2, 4.4, 1)
    profile = report.tables["profile"]
    radius = np.array(profile["radius_px"])
    at = np.maximum(radius, _NEAREST_PX)
    for name in (DIFFRACTION, SCATTER, TOTAL):
        if name not in profile["mean_weight"]:
            continue
        weight = np.array(profile["mean_weight"][name])
        there = weight > 0
        sigma = np.array(profile["sigma"].get(name, np.zeros(weight.size)))
        axes.fill_between(
            at[there],
            np.maximum(weight - sigma, 0.05 * weight)[there],
            (weight + sigma)[there],
            color=_COLOURS[name],
            alpha=0.3,
            linewidth=0,
        )
        axes.plot(at[there], weight[there], color=_COLOURS[name], linewidth=1.5, label=_NAMES[name])
    lowest = [np.array(w) for n, w in profile["mean_weight"].items() if n in (TOTAL, SCATTER)]
    floor = min(float(w[(w > 0) & (radius < _FARTHEST_PX)].min()) for w in lowest)
    axes.set(xscale="log", yscale="log", xlim=(_NEAREST_PX, _FARTHEST_PX), ylim=(floor / 5, 2))
    _mark_field(axes, report)
    axes.set(xlabel="Distance from the centre (px)", ylabel="Mean weight (fraction of the light per pixel)")
    _plain_ticks(axes)
    axes.legend(fontsize=9, loc="upper right", frameon=False)
    tidy([axes])
    return png_of(figure)


def weights_png(report: PsfReport, shells: ShellBands) -> bytes:
    """Diffuse weights by distance: the fitted shape, and free shells."""
    figure, (axes,) = _figure(7.2, 4.4, 1)
    shown = shells.edges_px[:-1] < max(report.transit.shape)
    edges = shells.edges_px[: np.count_nonzero(shown) + 1]
    low_2, low_1, median, high_1, high_2 = np.maximum(shells.free_weight[:, shown], 1e-30)
    for low, high, alpha, label in ((low_2, high_2, 0.14, "2 sigma"), (low_1, high_1, 0.3, "1 sigma")):
        steps = np.append(low, low[-1]), np.append(high, high[-1])
        style: dict[str, Any] = {"color": _FREE, "alpha": alpha, "linewidth": 0}
        axes.fill_between(edges, *steps, step="post", label=f"free shells, {label}", **style)
    axes.hlines(median, edges[:-1], edges[1:], color=_FREE, linewidth=1.4, label="free shells, median")
    profile = report.tables["profile"]
    radius, weight = np.array(profile["radius_px"]), np.array(profile["mean_weight"][SCATTER])
    there = (radius >= 1) & (radius <= _FARTHEST_PX)
    axes.plot(radius[there], weight[there], color=_COLOURS[SCATTER], linewidth=1.8, label="fitted shape")
    axes.set(xscale="log", xlim=(_NEAREST_PX, _FARTHEST_PX), xlabel="Distance (px)")
    axes.set(yscale="log", ylim=(0.2 * weight[there].min(), 20 * weight[there].max()))
    axes.set_ylabel("Diffuse weight (fraction of the light per pixel)")
    _mark_field(axes, report)
    _plain_ticks(axes)
    axes.legend(fontsize=9, loc="upper right", frameon=False)
    tidy([axes])
    return png_of(figure)


def totals_png(cross: CrossValidated, fit: TransitFit) -> bytes:
    """Histogram of the total diffuse scatter over the folds."""
    figure, (axes,) = _figure(6.4, 3.4, 1)
    totals = 100 * cross.bands.totals
    found, sigma = 100 * fit.inversion.values["total"], 100 * fit.value_sigma["total"]
    axes.axvspan(
        found - sigma, found + sigma, color="#c77f00", alpha=0.2, linewidth=0, label="error of that fit, ±1 σ"
    )
    axes.hist(totals, bins=min(25, max(5, totals.size // 4)), color=_BAND, label="folds")
    axes.axvline(found, color="#c77f00", linewidth=1.6, label="fit to all images")
    axes.set(xlabel="Diffusely scattered light (% of all light)", ylabel="Number of fits")
    axes.legend(fontsize=9, frameon=False)
    tidy([axes])
    return png_of(figure)


def slices_png(evaluation: Evaluation) -> bytes:
    """Slices through the centres of occulters: one image for each pointing, at most six images."""
    shown = shown_slices(evaluation, MOST_SLICES)
    across = min(len(shown), 3)
    rows = -(-len(shown) // across)
    figure, charts = _figure(WIDTH_IN * max(across, 2) / 3, 3.3 * rows, across, rows)
    for axes, frame in zip(charts, shown, strict=False):
        draw_slices(axes, frame)
        axes.legend(fontsize=7, loc="upper center", frameon=True, framealpha=0.85, edgecolor="none", ncols=2)
        axes.set_title(f"Pointing {frame.pointing}: {frame.file:.20}", fontsize=10)
    for axes in charts[len(shown) :]:
        axes.set_visible(False)
    tidy(charts)
    return png_of(figure)


def maps_png(maps: Superposed) -> bytes:
    """Maps of MPE and MAPE in the disc, with the maps of noise alone on the same scales."""
    figure, panels = _figure(8.2, 6.8, 2, 2)
    draw_maps(figure, panels, maps)
    return png_of(figure)


def residuals_png(evaluation: Evaluation) -> bytes:
    """Residuals of disc means and of centres by time, detector x and detector y, coloured by pointing."""
    frames = evaluation.frames
    figure, charts = _figure(WIDTH_IN, 6.2, 3, 2)
    where = {
        "Time from the first image (min)": minutes_of(frames),
        "Detector x of the occulter (px)": np.array([f.found.place.x_px for f in frames]),
        "Detector y of the occulter (px)": np.array([f.found.place.y_px for f in frames]),
    }
    rows = (("Disc mean", "residual_pct", "noise_pct"), ("Centre", "centre_pct", "centre_noise_pct"))
    for row, (name, value, noise) in enumerate(rows):
        values = np.array([getattr(f, value) for f in frames])
        sigma = np.array([getattr(f, noise) for f in frames])
        for column, (label, at) in enumerate(where.items()):
            axes = charts[3 * row + column]
            draw_errors(axes, frames, at, values, sigma)
            axes.legend().remove()
            axes.set(xlabel=label if row else "")
            if column == 0:
                axes.set_ylabel(f"{name}: residual (%)")
    handles, labels = charts[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, title="pointing", loc="outside upper center", ncols=8, fontsize=9, frameon=False
    )
    tidy(charts)
    return png_of(figure)


def intensities_png(evaluation: Evaluation) -> bytes:
    """Light at the centre of the occulter by time, and absolute error of the disc mean by detector x."""
    figure, charts = _figure(WIDTH_IN, 3.9, 2)
    draw_centres(charts[0], evaluation.frames)
    draw_absolute(charts[1], evaluation.frames)
    tidy(charts)
    return png_of(figure)


def offsets_png(study: DarkOffsetStudy) -> bytes:
    """Effect of wrong dark levels on diffuse weights and on 1 - encircled energy."""
    figure, charts = _figure(WIDTH_IN, 4.2, 2)
    draw_offsets(charts, study)
    charts[0].set_title("Diffuse weights")
    charts[1].set_title("1 - encircled energy")
    for axes in charts:
        axes.legend(fontsize=7.5, frameon=True, framealpha=0.85, edgecolor="none", ncols=2)
        _plain_ticks(axes)
    tidy(charts)
    return png_of(figure)


def _figure(
    width_in: float,
    height_in: float,
    across: int,
    rows: int = 1,
    *,
    heights: tuple[float, ...] | None = None,
) -> tuple[Any, list[Any]]:
    """A figure and its charts, row by row. heights: relative heights of the rows."""
    figure = Figure(figsize=(width_in, height_in), dpi=PLOT_DPI, facecolor="white", layout="constrained")
    charts = figure.subplots(rows, across, squeeze=False, height_ratios=heights)
    return figure, list(np.ravel(charts))


def _plain_ticks(axes: Any) -> None:
    """Label ticks as 1, 10, 100 instead of powers of ten."""
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
