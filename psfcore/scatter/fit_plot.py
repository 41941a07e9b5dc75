"""Plot a fit to a transit: the PSF with its errors, the residuals of every image, and the convergence."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from psfcore.drawing.plots import INK, points, tidy, write_png
from psfcore.psf import REACH_GRID_PX, cumulative_curve, radial_profile
from psfcore.scatter.fit import Curve, ShellWeightFits, TransitFit
from psfcore.scatter.inversion import CONVERGED_POINTS
from psfcore.scatter.as_published import Published
from psfcore.scatter.report import fit_sentence
from psfcore.scatter.validation.cross_validation import ONE_SIGMA, TWO_SIGMA
from psfcore.transit.first_guess import ESTIMATORS

Vector = NDArray[np.float64]

_DIFFUSE, _TOTAL, _FREE, _PUBLISHED = "#c77f00", "#111111", "#1f6fb4", "#b3261e"
_POINTINGS = ("#1b4f8a", "#c2402f", "#2b8a6e", "#7b3fa0", "#8a6d00", "#5b5b5b")
_ESTIMATOR_STYLES = {"image_mean": "o", "image_median": "s", "shell": "^"}
_NEAREST_PX, _FARTHEST_PX = 0.5, REACH_GRID_PX / 2
_MANY_IMAGES = 60  # with this many images or more, markers are smaller
_TITLE_LETTERS = 175


def fit_png(fit: TransitFit, path: str | Path) -> None:
    """Write the figure of `fit_figure` as PNG."""
    write_png(fit_figure(fit), path)


def fit_figure(fit: TransitFit) -> Figure:
    """Draw six panels.

    The panels show the diffuse weight and the light beyond each distance, the first guess, the residuals by time and by
    position, and the convergence.
    """
    figure = Figure(
        figsize=(15.6, 10.2),
        dpi=100,
        facecolor="white",
        layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1, hspace=0.04),
    )
    name = f"{fit.transit.instrument or 'Transit'}: {fit.inversion.shape.name.replace('-', ' ')}"
    words = "\n".join(textwrap.wrap(fit_sentence(fit), _TITLE_LETTERS))
    # The layout reserves space for one title. Its first line is empty, and the name fills that line in bold.
    figure.suptitle(f"\n{words}", fontsize=11, color=INK, x=0.012, ha="left", linespacing=1.5)
    figure.text(0.012, 0.987, name, fontsize=14, color=INK, weight="bold", va="top")
    (weight, light, guess), (by_time, by_place, rounds) = figure.subplots(2, 3)
    _draw_weights(weight, fit)
    _draw_light(light, fit)
    _draw_first_guess(guess, fit)
    _draw_residuals(by_time, fit, _minutes(fit), "Time from the first image (min)", "Residuals by time")
    across = np.array([f.found.place.x_px for f in fit.inversion.frames])
    _draw_residuals(by_place, fit, across, "Detector x of the occulter (px)", "Residuals by position")
    _draw_rounds(rounds, fit)
    tidy([weight, light, guess, by_time, by_place, rounds])
    return figure


def _draw_weights(axes: Any, fit: TransitFit) -> None:
    """Draw the weight per pixel by distance: the fitted shape with its error, the free shells, the published power law."""
    radius, weight, sigma_of_log = _fitted_weights(fit)
    if fit.free is not None:
        _draw_free_weights(axes, fit.free, max(fit.transit.shape))
    axes.fill_between(
        radius,
        weight * np.exp(-sigma_of_log),
        weight * np.exp(sigma_of_log),
        color=_DIFFUSE,
        alpha=0.35,
        linewidth=0,
    )
    axes.plot(radius, weight, color=_DIFFUSE, linewidth=2.0, label="fitted shape, ±1 σ")
    if fit.published is not None:
        law = fit.published
        published = law.a * (law.b_px + radius) ** -law.c
        within = radius <= law.grid_px // 2
        axes.plot(
            radius[within],
            published[within],
            color=_PUBLISHED,
            linewidth=1.6,
            linestyle=(0, (5, 2)),
            label="as published",
        )
    axes.set(xscale="log", yscale="log", xlim=(_NEAREST_PX, _FARTHEST_PX))
    axes.set_ylim(0.2 * weight.min(), 40 * weight.max())
    _mark_field(axes, fit)
    axes.set(
        xlabel="Distance (px)",
        ylabel="Diffuse weight (fraction per pixel)",
        title="Diffuse scatter by distance",
    )
    axes.legend(fontsize=9, loc="upper right", frameon=False)


def _fitted_weights(fit: TransitFit) -> tuple[Vector, Vector, Vector]:
    """Three arrays: distance (px), mean weight in the ring at this distance, standard error of the logarithm of the
    weight.

    The error is computed to first order from the covariance of the fit.
    """
    shape, at = fit.inversion.shape, fit.inversion.coordinates

    def rings(kernel: Vector) -> tuple[Vector, Vector]:
        radius, mean = radial_profile(kernel)
        shown = (radius >= 1) & (radius <= _FARTHEST_PX)
        return radius[shown], mean[shown]

    radius, weight = rings(shape.kernel(at, REACH_GRID_PX))
    slopes = (rings(shape.slope(at, k, REACH_GRID_PX))[1] for k in range(at.size))
    s = np.stack([slope / weight for slope in slopes], axis=1)
    variance = np.einsum("rk,kl,rl->r", s, fit.covariance, s)
    return radius, weight, np.sqrt(np.maximum(variance, 0.0))


def _draw_free_weights(axes: Any, free: ShellWeightFits, field_px: int) -> None:
    """Draw the median and spread of the shells that begin within the field. No pixel constrains the other shells."""
    edges, shown = _shells_within(free, field_px)
    for percentiles, alpha, label in (
        (TWO_SIGMA, 0.14, "free shells, ±2 σ"),
        (ONE_SIGMA, 0.28, "free shells, ±1 σ"),
    ):
        low, high = free.weights_pct(percentiles)[:, shown]
        axes.fill_between(
            edges, *_stepped(low, high), step="post", color=_FREE, alpha=alpha, linewidth=0, label=label
        )
    median = free.weights_pct((50.0,))[0, shown]
    axes.stairs(median, edges, baseline=None, color=_FREE, linewidth=1.1, label="free shells, median")


def _shells_within(free: ShellWeightFits, field_px: int) -> tuple[Vector, NDArray[np.bool_]]:
    """Edges (n + 1) of the n shells that begin within the field, and a mask of those shells."""
    edges = np.array(free.segments.edges_px)
    shown = edges[:-1] < field_px
    return edges[: np.count_nonzero(shown) + 1], shown


def _stepped(low: Vector, high: Vector) -> tuple[Vector, Vector]:
    """Prepare both bounds for steps on a logarithmic axis: repeat the last value, and keep all values above 0."""
    return np.maximum(np.append(low, low[-1]), 1e-30), np.maximum(np.append(high, high[-1]), 1e-30)


def _draw_light(axes: Any, fit: TransitFit) -> None:
    """Draw C(R) of the total PSF and of the scatter kernel with errors, and both curves of the published recipe."""
    radii = np.geomspace(_NEAREST_PX, _FARTHEST_PX, 300)
    for kernel, curve, colour, name in (
        (fit.kernel, fit.curve, _TOTAL, "total"),
        (fit.scatter, fit.diffuse_curve, _DIFFUSE, "diffuse"),
    ):
        beyond = cumulative_curve(kernel, radii)
        sigma = _sigma_at(curve, radii)
        axes.fill_between(radii, beyond - sigma, beyond + sigma, color=colour, alpha=0.3, linewidth=0)
        axes.plot(radii, beyond, color=colour, linewidth=1.8, label=f"{name}, ±1 σ")
        axes.errorbar(curve.radii_px, curve.pct, curve.sigma, **points(colour, 3.5))
    if fit.published is not None:
        _draw_published_light(axes, fit.published)
    axes.set(xscale="log", xlim=(_NEAREST_PX, _FARTHEST_PX), ylim=(0, None))
    _mark_field(axes, fit)
    axes.set(xlabel="Distance (px)", ylabel="1 - encircled energy (%)", title="Light beyond a distance")
    axes.legend(fontsize=9, loc="upper right", frameon=False)


def _sigma_at(curve: Curve, radii: Vector) -> Vector:
    """The standard error of a curve, interpolated between its radii."""
    return np.asarray(np.interp(np.log(radii), np.log(curve.radii_px), curve.sigma))


def _draw_published_light(axes: Any, published: Published) -> None:
    style: dict[str, Any] = {"color": _PUBLISHED, "linewidth": 1.5}
    axes.plot(
        published.radii_px,
        published.curve_pct,
        linestyle=(0, (5, 2)),
        marker="D",
        markersize=4.5,
        markerfacecolor="white",
        label="total, as published",
        **style,
    )
    radii = np.geomspace(_NEAREST_PX, published.grid_px / 2, 200)
    beyond = cumulative_curve(published.scatter, radii)
    axes.plot(radii, beyond, linestyle=(0, (1, 1.5)), label="diffuse, as published", **style)


def _draw_residuals(axes: Any, fit: TransitFit, where: Vector, label: str, title: str) -> None:
    """Draw the residual of every image with its noise; the colour shows the pointing."""
    frames = fit.inversion.frames
    residual = np.array([f.residual_pct for f in frames])
    noise = np.array([100 * f.noise / abs(f.observed) for f in frames])
    fovs = np.array([f.pointing for f in frames])
    axes.axhline(0, color="#555555", linewidth=1.0)
    size = 5.5 if len(frames) < _MANY_IMAGES else 3.5
    for n, fov in enumerate(sorted(set(fovs.tolist()))):
        here = fovs == fov
        style = points(_POINTINGS[n % len(_POINTINGS)], size)
        axes.errorbar(where[here], residual[here], noise[here], label=f"pointing {fov}", **style)
    top = 1.12 * float((np.abs(residual) + noise).max(initial=1e-3))
    axes.set(ylim=(-top, 1.3 * top), xlabel=label, ylabel="Residual: simulated - observed (%)", title=title)
    axes.legend(fontsize=9, loc="upper right", frameon=False, ncols=3, columnspacing=1.0, handletextpad=0.3)


def _minutes(fit: TransitFit) -> Vector:
    """Time of each fitted image, in minutes from the first image of the transit."""
    time_s = {frame.file: frame.time_s for frame in fit.transit.frames}
    return np.array([time_s[f.file] for f in fit.inversion.frames]) / 60


def _draw_rounds(axes: Any, fit: TransitFit) -> None:
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
        CONVERGED_POINTS, color=_PUBLISHED, linewidth=1.2, linestyle=(0, (5, 2)), label="convergence limit"
    )
    axes.set_yscale("log")
    low, high = min(moved.min(initial=1.0), CONVERGED_POINTS), max(moved.max(initial=0.1), CONVERGED_POINTS)
    axes.set(xlim=(0.5, len(rounds) + 0.5), ylim=(low / 3, high * 12))
    axes.set_xticks(_whole_ticks(number))
    settled = "converged" if fit.inversion.converged else "not converged"
    axes.set(
        xlabel="Round",
        ylabel="Largest change of the curve (percentage points)",
        title=f"Convergence ({settled})",
    )
    axes.legend(fontsize=9, loc="upper right", frameon=False)


def _whole_ticks(number: NDArray[np.intp]) -> Sequence[int]:
    return [int(n) for n in number[:: max(1, -(-number.size // 12))]]


def _draw_first_guess(axes: Any, fit: TransitFit) -> None:
    """Draw the first guess of the light beyond the disc's radius, by estimator and pointing, and the fitted value.

    The logarithmic axis cannot show ratios of 0 or less, so they are omitted.
    """
    guess = fit.first_guess
    time_min = np.array([f.time_s for f in guess.frames]) / 60
    fovs = np.array([f.pointing for f in guess.frames])
    ratios = {name: np.array([100 * f.ratio[name] for f in guess.frames]) for name in ESTIMATORS}
    size = 5.0 if len(guess.frames) < _MANY_IMAGES else 3.2
    for n, fov in enumerate(sorted(set(fovs.tolist()))):
        colour = _POINTINGS[n % len(_POINTINGS)]
        for name, marker in _ESTIMATOR_STYLES.items():
            here = (fovs == fov) & (ratios[name] > 0)
            axes.plot(
                time_min[here], ratios[name][here], marker, color=colour, markersize=size, markeredgewidth=0
            )
    for name, marker in _ESTIMATOR_STYLES.items():
        label = "relative to " + name.replace("_", " ")
        axes.plot([], [], marker, color="#777777", markersize=5, label=label)
    fitted = float(cumulative_curve(fit.kernel, [guess.radius_px])[0])
    axes.axhline(
        fitted,
        color=_TOTAL,
        linewidth=1.4,
        linestyle=(0, (5, 2)),
        label=f"fit: light beyond {guess.radius_px:.1f} px",
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
    axes.legend(fontsize=9, loc="upper left", frameon=False, ncols=2, columnspacing=1.2, handletextpad=0.4)


def _mark_field(axes: Any, fit: TransitFit) -> None:
    """Shade distances beyond the field, where the PSF is an extrapolation of the fitted shape."""
    field = max(fit.transit.shape)
    if field < _FARTHEST_PX:
        axes.axvspan(field, _FARTHEST_PX, color="#f0f0f0", zorder=0, linewidth=0, label="beyond the field")
