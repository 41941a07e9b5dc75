"""Figures of a report on a PSF, as PNG, for a page about ten inches wide."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from psfcore.arrays import Matrix, Vector
from psfcore.drawing.page import PLOT_DPI
from psfcore.drawing.plots import (
    FARTHEST_PX,
    NEAREST_PX,
    along_distance,
    boxed_legend,
    draw_band,
    draw_errors,
    draw_totals,
    draw_weights_of_shells,
    legend,
    png_of,
    points,
    tidy,
)
from psfcore.evaluation.evaluation import Evaluation, Superposed
from psfcore.evaluation.plots import (
    draw_absolute,
    draw_centres,
    draw_maps,
    draw_offsets,
    draw_slices,
    pointings,
    positions,
    shown_slices,
)
from psfcore.evaluation.report import each
from psfcore.report.report import CrossValidated, PsfReport
from psfcore.scatter.fit import RADII_PX, TransitFit
from psfcore.scatter.total_psf import DIFFRACTION, SCATTER
from psfcore.scatter.validation.cross_validation import ShellBands
from psfcore.scatter.validation.robustness import DarkOffsetStudy
from psfcore.tables.lookup import TOTAL, Tables

WIDTH_IN = 9.9
MOST_SLICES = 6
_COLOURS = {TOTAL: "#111111", DIFFRACTION: "#7b3fa0", SCATTER: "#c77f00"}
_NAMES = {TOTAL: "total", DIFFRACTION: "diffraction", SCATTER: "diffuse scatter"}
_FREE, _BAND = "#1f6fb4", "#4f8cc4"


def curves_png(report: PsfReport) -> bytes:
    """1 - encircled energy of the total PSF. For a fit, also of its diffuse scatter, with the uncertainties below."""
    if report.fit is None:
        figure, charts = _figure(5.6, 3.9, 1)
        _draw_curve(charts[0], report, TOTAL, "Total PSF")
        legend(charts[0], 8)
    else:
        figure, charts = _figure(WIDTH_IN, 7.0, 2, 2, heights=(1.3, 1.0))
        for axes, name, title in zip(
            charts, (TOTAL, SCATTER), ("Total PSF", "Diffuse scatter alone"), strict=False
        ):
            _draw_curve(axes, report, name, title)
        for axes, name in zip(charts[2:], (TOTAL, SCATTER), strict=True):
            _draw_spread(axes, report, name)
        if report.cross is not None and report.cross.bands.shells is not None:
            _draw_free(charts[1], charts[3], report, report.cross.bands.shells)
        for axes in charts[:2]:
            axes.set_ylim(0, None)
            legend(axes, 8)
        for axes in charts[2:]:
            low, high = axes.get_ylim()
            axes.set_ylim(low, high + 0.45 * (high - low))  # room for the legend
            legend(axes, 7.5, ncols=2)
    return _tidy_png(figure, charts)


def _draw_curve(axes: Axes, report: PsfReport, name: str, title: str) -> None:
    """Draw 1 - encircled energy of a component, with its error."""
    radii, beyond, sigma = beyond_of(report.tables, name)
    axes.fill_between(radii, beyond - sigma, beyond + sigma, color=_COLOURS[name], alpha=0.3, linewidth=0)
    axes.plot(radii, beyond, color=_COLOURS[name], linewidth=1.5, label=_NAMES[name])
    axes.set(ylim=(0, None), ylabel="1 - encircled energy (%)", title=title)
    along_distance(axes, max(report.transit.shape), "Distance R (px)")


def _draw_spread(axes: Axes, report: PsfReport, name: str) -> None:
    """Draw differences from the fitted curve of a component: bands of the folds, and bars for the error of the fit."""
    radii, _, sigma = beyond_of(report.tables, name)
    found = _folds_of(report, name)
    if found is not None:
        draw_band(axes, *found, _BAND, "folds: median, 1 and 2 sigma")
    axes.axhline(0, color="#555555", linewidth=1.0)
    shown = np.searchsorted(radii, [r for r in RADII_PX if r < radii[-1]])
    axes.errorbar(
        radii[shown],
        np.zeros(shown.size),
        sigma[shown],
        label="fit to all images, ±1 σ",
        **points(_COLOURS[name], 3.0),
    )
    axes.set(ylabel="Difference from the fit (points)")
    along_distance(axes, max(report.transit.shape), "Distance R (px)")


def _folds_of(report: PsfReport, name: str) -> tuple[Vector, Matrix] | None:
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
    shown = edges >= NEAREST_PX
    return edges[shown], bands.shells.law_beyond_pct[:, shown] - _scatter_from(report, edges[shown])


def _scatter_from(report: PsfReport, edges: Vector) -> Vector:
    """The percentage of scattered light beyond each distance. Pixels exactly at the distance are included."""
    radii, beyond, _ = beyond_of(report.tables, SCATTER)
    just_below = edges * (1 - 1e-9)
    within = np.maximum(np.searchsorted(radii, just_below) - 1, 0)
    exact = just_below <= report.tables["exact_to_px"]  # up to this radius, the curve is a step function
    return np.asarray(np.where(exact, beyond[within], np.interp(just_below, radii, beyond)))


def _draw_free(curve: Axes, spread: Axes, report: PsfReport, shells: ShellBands) -> None:
    """Draw the diffuse light beyond the inner edge of each free shell within the field: median and spread of the
    folds.
    """
    edges = shells.edges_px[:-1]
    shown = (edges >= 1) & (edges < max(report.transit.shape))
    low_2, low_1, median, high_1, high_2 = shells.free_beyond_pct[:, shown]
    fitted = _scatter_from(report, edges[shown])
    for axes, middle in ((curve, median), (spread, median - fitted)):
        for low, high, width, label in (
            (low_2, high_2, 0.7, None),
            (low_1, high_1, 1.6, "free shells, 1 and 2 sigma"),
        ):
            span = np.maximum([median - low, high - median], 0.0)
            style = points(_FREE, 3.2) | {"elinewidth": width}
            axes.errorbar(edges[shown], middle, span, label=label, zorder=3, **style)


def beyond_of(tables: Tables, name: str) -> tuple[Vector, Vector, Vector]:
    """Radii (px), 100 (1 - encircled energy) of a component at these radii, and its standard error (0: not known)."""
    radii = np.array(tables["radii_px"])
    encircled = np.array(tables["encircled"][name])
    changes = np.array(tables["encircled_changes"].get(name, np.zeros((1, radii.size))))
    near = radii < NEAREST_PX
    # The curve begins at half a pixel. This radius encloses only the central pixel.
    shown = np.concatenate(([np.flatnonzero(near)[-1]], np.flatnonzero(~near)))
    r = np.where(near[shown], NEAREST_PX, radii[shown])
    beyond = 100 * np.maximum(1 - encircled[shown], 0.0)
    return r, beyond, 100 * np.linalg.norm(changes[:, shown], axis=0)


def profile_png(report: PsfReport) -> bytes:
    """Mean weight per pixel by radius: diffraction, diffuse scatter and total PSF, with errors if they are known."""
    figure, (axes,) = _figure(7.2, 4.4, 1)
    profile = report.tables["profile"]
    radius = np.array(profile["radius_px"])
    lowest = []
    for name in (name for name in _COLOURS if name in profile["mean_weight"]):
        weight = np.array(profile["mean_weight"][name])
        lit = weight > 0
        sigma = np.array(profile["sigma"].get(name, np.zeros(weight.size)))[lit]
        at, mean = np.maximum(radius, NEAREST_PX)[lit], weight[lit]
        axes.fill_between(
            at,
            np.maximum(mean - sigma, 0.05 * mean),
            mean + sigma,
            color=_COLOURS[name],
            alpha=0.3,
            linewidth=0,
        )
        axes.plot(at, mean, color=_COLOURS[name], linewidth=1.5, label=_NAMES[name])
        if name != DIFFRACTION:
            lowest.append(float(mean[radius[lit] < FARTHEST_PX].min()))
    axes.set(yscale="log", ylim=(min(lowest) / 5, 2), ylabel="Mean weight (fraction of the light per pixel)")
    along_distance(axes, max(report.transit.shape), "Distance from the centre (px)")
    legend(axes)
    return _tidy_png(figure, [axes])


def weights_png(report: PsfReport, shells: ShellBands) -> bytes:
    """Diffuse weights by distance: the fitted shape, and free shells."""
    figure, (axes,) = _figure(7.2, 4.4, 1)
    field_px, profile = max(report.transit.shape), report.tables["profile"]
    draw_weights_of_shells(axes, shells.edges_px, shells.free_weight, field_px, _FREE)
    radius, weight = np.array(profile["radius_px"]), np.array(profile["mean_weight"][SCATTER])
    shown = (radius >= 1) & (radius <= FARTHEST_PX)
    axes.plot(radius[shown], weight[shown], color=_COLOURS[SCATTER], linewidth=1.8, label="fitted shape")
    axes.set(yscale="log", ylim=(0.2 * weight[shown].min(), 20 * weight[shown].max()))
    axes.set_ylabel("Diffuse weight (fraction of the light per pixel)")
    along_distance(axes, field_px)
    legend(axes)
    return _tidy_png(figure, [axes])


def totals_png(cross: CrossValidated, fit: TransitFit) -> bytes:
    """Histogram of the total diffuse scatter over the folds."""
    figure, (axes,) = _figure(6.4, 3.4, 1)
    total, sigma = 100 * fit.inversion.values["total"], 100 * fit.value_sigma["total"]
    axes.axvspan(
        total - sigma,
        total + sigma,
        color=_COLOURS[SCATTER],
        alpha=0.2,
        linewidth=0,
        label="error of that fit, ±1 σ",
    )
    draw_totals(axes, cross.bands.totals, _BAND)
    axes.axvline(total, color=_COLOURS[SCATTER], linewidth=1.6, label="fit to all images")
    legend(axes, loc="best")
    return _tidy_png(figure, [axes])


def slices_png(evaluation: Evaluation) -> bytes:
    """Slices through the centres of occulters: one image for each pointing, at most six images."""
    shown = shown_slices(evaluation, MOST_SLICES)
    across = min(len(shown), 3)
    rows = -(-len(shown) // across)
    figure, charts = _figure(WIDTH_IN * max(across, 2) / 3, 3.3 * rows, across, rows)
    draw_slices(charts, shown, 7)
    return _tidy_png(figure, charts)


def maps_png(maps: Superposed) -> bytes:
    """Maps of MPE and MAPE in the disc, with the maps of noise alone on the same scales."""
    figure, panels = _figure(8.2, 6.8, 2, 2)
    draw_maps(figure, panels, maps)
    return png_of(figure)


def residuals_png(evaluation: Evaluation) -> bytes:
    """Residuals of disc means and of centres by time, detector x and detector y, coloured by pointing."""
    frames = evaluation.frames
    figure, charts = _figure(WIDTH_IN, 6.2, 3, 2)
    for row, (name, key) in enumerate((("Disc mean", ""), ("Centre", "centre_"))):
        values = each(frames, f"{key or 'residual_'}pct")
        for axes, (label, at) in zip(charts[3 * row :], positions(frames).items(), strict=False):
            draw_errors(axes, pointings(frames), at, values, each(frames, f"{key}noise_pct"))
            shown = axes.get_legend()
            if shown is not None:
                shown.remove()
            axes.set(xlabel=label if row else "")
        charts[3 * row].set_ylabel(f"{name}: residual (%)")
    labelled = charts[0].get_legend_handles_labels()
    figure.legend(*labelled, title="pointing", loc="outside upper center", ncols=8, fontsize=9, frameon=False)
    return _tidy_png(figure, charts)


def intensities_png(evaluation: Evaluation) -> bytes:
    """Light at the centre of the occulter by time, and absolute error of the disc mean by detector x."""
    figure, charts = _figure(WIDTH_IN, 3.9, 2)
    draw_centres(charts[0], evaluation.frames)
    draw_absolute(charts[1], evaluation.frames)
    return _tidy_png(figure, charts)


def offsets_png(study: DarkOffsetStudy) -> bytes:
    """Effect of wrong dark levels on diffuse weights and on 1 - encircled energy."""
    figure, charts = _figure(WIDTH_IN, 4.2, 2)
    draw_offsets(charts, study)
    for axes, title in zip(charts, ("Diffuse weights", "1 - encircled energy"), strict=True):
        axes.set_title(title)
        boxed_legend(axes, 7.5)
    return _tidy_png(figure, charts)


def _tidy_png(figure: Figure, charts: list[Axes]) -> bytes:
    """A figure as PNG, with tidy charts."""
    tidy(charts)
    return png_of(figure)


def _figure(
    width_in: float,
    height_in: float,
    across: int,
    rows: int = 1,
    *,
    heights: tuple[float, ...] | None = None,
) -> tuple[Figure, list[Axes]]:
    """A figure and its charts, row by row.

    Parameters
    ----------
    heights
        Relative heights of the rows.
    """
    figure = Figure(figsize=(width_in, height_in), dpi=PLOT_DPI, facecolor="white", layout="constrained")
    charts = figure.subplots(rows, across, squeeze=False, height_ratios=heights)
    return figure, list(np.ravel(charts))
