"""Pictures of a fit and of its cross-validation: the PSF with its errors, the residuals of every image, all fits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from psfcore.arrays import Kernel, Vector
from psfcore.drawing.plots import (
    FARTHEST_PX,
    INK,
    NEAREST_PX,
    along_distance,
    by_pointing,
    draw_band,
    draw_errors,
    draw_totals,
    draw_weights_of_shells,
    headed_figure,
    legend,
    marker_size,
    points,
    tidy,
    write_png,
)
from psfcore.psf import REACH_GRID_PX, cumulative_curve, radial_profile
from psfcore.scatter.as_published import Published
from psfcore.scatter.fit import TransitFit, fit_sentence
from psfcore.scatter.inversion import CONVERGED_POINTS
from psfcore.scatter.validation.cross_validation import LIMITS, Bands, FoldFit, ShellBands
from psfcore.transit.first_guess import ESTIMATORS

_DIFFUSE, _TOTAL, _FREE, _PUBLISHED = "#c77f00", "#111111", "#1f6fb4", "#b3261e"
_ESTIMATOR_STYLES = dict(zip(ESTIMATORS, "os^", strict=True))
_DASHES = (0, (5, 2))


def fit_png(fit: TransitFit, path: str | Path) -> None:
    """Write the figure of `fit_figure` as PNG."""
    write_png(fit_figure(fit), path)


def fit_figure(fit: TransitFit) -> Figure:
    """Draw six panels.

    The panels show the diffuse weight and the light beyond each distance, the first guess, the residuals by time and by
    position, and the convergence.
    """
    name = f"{fit.transit.instrument or 'Transit'}: {fit.inversion.shape.name.replace('-', ' ')}"
    figure = headed_figure(15.6, 10.2, name, fit_sentence(fit))
    charts = figure.subplots(2, 3)
    (weight, light, guess), (by_time, by_place, rounds) = charts
    _draw_weights(weight, fit)
    _draw_light(light, fit)
    _draw_first_guess(guess, fit)
    time_s = {frame.file: frame.time_s for frame in fit.transit.frames}
    frames = fit.inversion.frames
    residual = np.array([f.residual_pct for f in frames])
    noise = np.array([100 * f.noise / abs(f.observed) for f in frames])
    for axes, title, label, where in (
        (by_time, "time", "Time from the first image (min)", [time_s[f.file] / 60 for f in frames]),
        (by_place, "position", "Detector x of the occulter (px)", [f.found.place.x_px for f in frames]),
    ):
        draw_errors(axes, [f.pointing for f in frames], np.array(where), residual, noise)
        axes.set(xlabel=label, ylabel="Residual: simulated - observed (%)", title=f"Residuals by {title}")
    _draw_rounds(rounds, fit)
    tidy(list(charts.flat))
    return figure


def _draw_weights(axes: Axes, fit: TransitFit) -> None:
    """Draw the weight per pixel by distance: the fitted shape with its error, the free shells, the published power
    law.
    """
    radius, weight, sigma_of_log = _fitted_weights(fit)
    field_px = max(fit.transit.shape)
    if fit.free is not None:
        edges = np.array(fit.free.segments.edges_px)
        draw_weights_of_shells(axes, edges, fit.free.weights_pct(LIMITS), field_px, _FREE)
    low, high = weight * np.exp(-sigma_of_log), weight * np.exp(sigma_of_log)
    axes.fill_between(radius, low, high, color=_DIFFUSE, alpha=0.35, linewidth=0)
    axes.plot(radius, weight, color=_DIFFUSE, linewidth=2.0, label="fitted shape, ±1 σ")
    if fit.published is not None:
        law = fit.published
        within = radius[radius <= law.grid_px // 2]
        published = law.a * (law.b_px + within) ** -law.c
        axes.plot(within, published, color=_PUBLISHED, linewidth=1.6, linestyle=_DASHES, label="as published")
    axes.set(yscale="log", ylim=(0.2 * weight.min(), 40 * weight.max()))
    along_distance(axes, field_px)
    axes.set(ylabel="Diffuse weight (fraction per pixel)", title="Diffuse scatter by distance")
    legend(axes)


def _fitted_weights(fit: TransitFit) -> tuple[Vector, Vector, Vector]:
    """Three arrays: distance (px), mean weight in the ring at this distance, standard error of the logarithm of the
    weight.

    The error is computed to first order from the covariance of the fit.
    """
    shape, at = fit.inversion.shape, fit.inversion.coordinates

    def rings(kernel: Kernel) -> tuple[Vector, Vector]:
        radius, mean = radial_profile(kernel)
        shown = (radius >= 1) & (radius <= FARTHEST_PX)
        return radius[shown], mean[shown]

    radius, weight = rings(shape.kernel(at, REACH_GRID_PX))
    slopes = (rings(shape.slope(at, k, REACH_GRID_PX))[1] for k in range(at.size))
    s = np.stack([slope / weight for slope in slopes], axis=1)
    variance = np.einsum("rk,kl,rl->r", s, fit.covariance, s)
    return radius, weight, np.sqrt(np.maximum(variance, 0.0))


def _draw_light(axes: Axes, fit: TransitFit) -> None:
    """Draw C(R) of the total PSF and of the scatter kernel with errors, and both curves of the published recipe."""
    radii = np.geomspace(NEAREST_PX, FARTHEST_PX, 300)
    for kernel, curve, colour, name in (
        (fit.kernel, fit.curve, _TOTAL, "total"),
        (fit.scatter, fit.diffuse_curve, _DIFFUSE, "diffuse"),
    ):
        beyond = cumulative_curve(kernel, radii)
        sigma = np.interp(np.log(radii), np.log(curve.radii_px), curve.sigma)
        axes.fill_between(radii, beyond - sigma, beyond + sigma, color=colour, alpha=0.3, linewidth=0)
        axes.plot(radii, beyond, color=colour, linewidth=1.8, label=f"{name}, ±1 σ")
        axes.errorbar(curve.radii_px, curve.pct, curve.sigma, **points(colour, 3.5))
    if fit.published is not None:
        _draw_published_light(axes, fit.published)
    along_distance(axes, max(fit.transit.shape))
    axes.set(ylim=(0, None), ylabel="1 - encircled energy (%)", title="Light beyond a distance")
    legend(axes)


def _draw_published_light(axes: Axes, published: Published) -> None:
    axes.plot(
        published.radii_px,
        published.curve_pct,
        marker="D",
        markersize=4.5,
        markerfacecolor="white",
        linestyle=_DASHES,
        label="total, as published",
        color=_PUBLISHED,
        linewidth=1.5,
    )
    radii = np.geomspace(NEAREST_PX, published.grid_px / 2, 200)
    beyond = cumulative_curve(published.scatter, radii)
    axes.plot(
        radii, beyond, linestyle=(0, (1, 1.5)), label="diffuse, as published", color=_PUBLISHED, linewidth=1.5
    )


def _draw_rounds(axes: Axes, fit: TransitFit) -> None:
    """Draw the largest change of the curve in each round. Markers are filled for rounds that use all images."""
    rounds = fit.inversion.rounds
    number = np.arange(1, len(rounds) + 1)
    moved = np.array([max(r.moved_points, 1e-6) for r in rounds])
    whole = np.array([r.frames == max((s.frames for s in rounds), default=0) for r in rounds], dtype=bool)
    axes.plot(number, moved, color="#999999", linewidth=1.2, zorder=1)
    for here, face, name in ((whole, _TOTAL, "all images"), (~whole, "white", "some images (pilot rounds)")):
        if here.any():
            axes.scatter(number[here], moved[here], s=44, c=face, edgecolors=_TOTAL, zorder=2, label=name)
    axes.axhline(
        CONVERGED_POINTS, label="convergence limit", color=_PUBLISHED, linewidth=1.2, linestyle=_DASHES
    )
    low, high = min(moved.min(initial=1.0), CONVERGED_POINTS), max(moved.max(initial=0.1), CONVERGED_POINTS)
    axes.set(yscale="log", xlim=(0.5, len(rounds) + 0.5), ylim=(low / 3, high * 12))
    axes.xaxis.set_major_locator(MaxNLocator(12, integer=True))
    axes.set(
        xlabel="Round",
        ylabel="Largest change of the curve (percentage points)",
        title=f"Convergence ({'converged' if fit.inversion.converged else 'not converged'})",
    )
    legend(axes)


def _draw_first_guess(axes: Axes, fit: TransitFit) -> None:
    """Draw the first guess of the light beyond the disc's radius, by estimator and pointing, and the fitted value.

    The logarithmic axis cannot show ratios of 0 or less, so they are omitted.
    """
    guess = fit.first_guess
    time_min = np.array([f.time_s for f in guess.frames]) / 60
    ratios = {name: np.array([100 * f.ratio[name] for f in guess.frames]) for name in ESTIMATORS}
    size = marker_size(len(guess.frames))
    for _, of_pointing, colour in by_pointing([f.pointing for f in guess.frames]):
        for name, marker in _ESTIMATOR_STYLES.items():
            here = of_pointing & (ratios[name] > 0)
            axes.plot(
                time_min[here], ratios[name][here], marker, color=colour, markersize=size, markeredgewidth=0
            )
    for name, marker in _ESTIMATOR_STYLES.items():
        axes.plot(
            [],
            [],
            marker,
            color="#777777",
            label="relative to " + name.replace("_", " "),
            markersize=size,
            markeredgewidth=0,
        )
    fitted = float(cumulative_curve(fit.kernel, [guess.radius_px])[0])
    axes.axhline(
        fitted,
        label=f"fit: light beyond {guess.radius_px:.1f} px",
        color=_TOTAL,
        linewidth=1.4,
        linestyle=_DASHES,
    )
    shown = np.concatenate([r[np.isfinite(r) & (r > 0)] for r in ratios.values()] + [[fitted]])
    low, high = np.log(shown.min()), np.log(shown.max())
    room = max(high - low, 1.0)
    axes.set(yscale="log", ylim=(np.exp(low - 0.08 * room), np.exp(high + 0.3 * room)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set(
        xlabel="Time from the first image (min)",
        ylabel="Disc centre / solar intensity (%)",
        title="First guess, assuming a uniform Sun",
    )
    legend(axes, loc="upper left", ncols=2, columnspacing=1.2, handletextpad=0.4)


# --- cross-validation ---------------------------------------------------------------------------------------


def cross_validation_png(
    bands: Bands, fits: tuple[FoldFit, ...], fov_of: list[int], path: str | Path
) -> None:
    """Write a PNG with C(R), the totals of all fits, and the residuals of held-out images; bands of 1 and 2 sigma.

    If there is a free fit, an upper row of panels compares it with the formula: weights, diffuse light and excess.

    Parameters
    ----------
    fov_of
        The pointing of each image.
    """
    rows = 1 if bands.shells is None else 2
    figure = Figure(figsize=(15.6, 4.9 * rows), dpi=100, facecolor="white", layout="constrained")
    title = f"Cross-validation, {len(fits)} fits: medians, 1 and 2 sigma"
    figure.suptitle(title, fontsize=13, color=INK, weight="bold", x=0.01, ha="left")
    charts = figure.subplots(rows, 3, squeeze=False)
    if bands.shells is not None:
        _draw_shells(charts[0], bands.shells)
    curve, totals, held_out = charts[-1]
    draw_band(curve, bands.radii_px, bands.curve_pct, _DIFFUSE, "median", marker="o")
    curve.set(xscale="log", ylim=(0, None), xlabel="Distance (px)")
    curve.set(ylabel="1 - encircled energy (%)", title="Total PSF")
    draw_totals(totals, bands.totals, _DIFFUSE)
    totals.set(title="Scattered light, all fits")
    images = np.array(list(bands.held_out_pct))
    residuals = np.array(list(bands.held_out_pct.values()))
    draw_errors(held_out, [fov_of[n] for n in images], images, residuals, None)
    held_out.set(xlabel="Image", ylabel="Residual: simulated - observed (%)", title="Held-out images")
    tidy(list(charts.flat))
    write_png(figure, path)


def _draw_shells(charts: Sequence[Axes], shells: ShellBands) -> None:
    """Compare the free fits with the formula: weight per pixel, 1 - encircled energy of the scatter, and the excess
    within each distance (light of the free fits minus light of the formula) with its error.
    """
    weights, light, excess = charts
    middle = np.sqrt(shells.edges_px[1:] * shells.edges_px[:-1])
    draw_weights_of_shells(weights, shells.edges_px, shells.free_weight, np.inf, _FREE)
    draw_band(weights, middle, shells.law_weight, _DIFFUSE, "formula")
    weights.set(yscale="log", ylim=(0.1 * shells.law_weight.min(), None))
    weights.set(ylabel="Weight per pixel", title="Diffuse scatter")
    draw_band(light, shells.edges_px[:-1], shells.free_beyond_pct, _FREE, "free fit")
    draw_band(light, shells.edges_px[:-1], shells.law_beyond_pct, _DIFFUSE, "formula")
    light.set(ylim=(0, None), ylabel="1 - encircled energy (%)", title="Diffuse scatter")
    radius, sigma = shells.edges_px[1:], shells.excess_sigma
    excess.fill_between(
        radius,
        -sigma,
        sigma,
        color="#bbbbbb",
        alpha=0.5,
        linewidth=0,
        label="error: image noise and prior",
    )
    draw_band(excess, radius, shells.excess_pct, _FREE, "all fits")
    excess.axhline(0.0, color=INK, linewidth=0.8)
    near = shells.near_centre
    excess.set(
        ylabel="Light within distance: free - formula (%)",
        title=f"Within {near.within_px:g} px: {near.points:+.1f} ± {near.sigma:.1f} %",
    )
    for axes in charts:
        axes.set(xscale="log", xlabel="Distance (px)")
        legend(axes, loc="best")
