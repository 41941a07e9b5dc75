"""Plots of flares: a PSF compared with the light along an arm, and measured arms with cuts along each arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from scipy import ndimage

from psfcore.drawing.plots import INK, tidy, write_png
from psfcore.flare.arm_profile import BOX_PX, MATCHED_PX, FlareComparison, FlareFit
from psfcore.flare.arms import ArmMeasurement

_OBSERVED, _TOTAL, _ALONE = "#6d6d6d", "#c2402f", "#7b3fa0"


def flare_png(
    difference: NDArray[np.float64],
    usable: NDArray[np.bool_],
    found: FlareComparison,
    path: str | Path,
    *,
    unit: str,
) -> None:
    """Plot the difference [y, x] around the flare with the arm, the profile along the arm, and the residuals."""
    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.06)
    figure = Figure(figsize=(15.6, 6.2), dpi=100, facecolor="white", layout=layout)
    figure.suptitle(_heading(found), x=0.01, ha="left", weight="bold", color=INK)
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.45), height_ratios=(2.2, 1))
    _draw_flare(figure, figure.add_subplot(grid[:, 0]), difference, usable, found, unit)
    above = figure.add_subplot(grid[0, 1])
    below = figure.add_subplot(grid[1, 1], sharex=above)
    above.tick_params(labelbottom=False)
    _draw_profile(above, found, unit)
    _draw_residuals(below, found)
    for axes in (above, below):
        axes.axvspan(*MATCHED_PX, color="#eeeae0", zorder=0)
    tidy([above, below])
    write_png(figure, path)


def _heading(found: FlareComparison) -> str:
    words = f"Arm at {found.profile.arm_deg:.2f} degrees: {_summary('total PSF', found.total)}"
    if found.diffraction is not None:
        words += (
            f"; {_summary('diffraction alone', found.diffraction)}, {found.rms_factor:.1f} times the rms error "
            "of the total PSF"
        )
    return words


def _summary(name: str, fit: FlareFit) -> str:
    chi2 = "" if fit.chi2_per_distance is None else f", chi2 per distance {fit.chi2_per_distance:.2f}"
    return f"{name} rms error {fit.rms_pct:.1f} %{chi2}"


def _draw_flare(
    figure: Figure,
    axes: Axes,
    difference: NDArray[np.float64],
    usable: NDArray[np.bool_],
    found: FlareComparison,
    unit: str,
) -> None:
    profile = found.profile
    x, y = profile.centre_xy
    reach = int(profile.distance_px[-1]) + 8
    shown = np.where(usable, difference, np.nan)
    top = 5 * float(np.max(profile.observed))
    norm = SymLogNorm(top / 300, vmin=-top / 300, vmax=top)
    drawn = axes.imshow(shown, origin="lower", cmap="magma", norm=norm, interpolation="nearest")
    angle = np.deg2rad(profile.arm_deg)
    ends = profile.distance_px[[0, -1]]
    axes.plot(x + ends * np.cos(angle), y + ends * np.sin(angle), color="#4fc3d9", linewidth=1.4, label="arm")
    corner = (x - BOX_PX / 2, y - BOX_PX / 2)
    axes.add_patch(Rectangle(corner, BOX_PX, BOX_PX, fill=False, edgecolor="#4fc3d9", label="box"))
    axes.set(
        xlim=(max(-0.5, x - reach), min(difference.shape[1] - 0.5, x + reach)),
        ylim=(max(-0.5, y - reach), min(difference.shape[0] - 0.5, y + reach)),
        xlabel="x (px)",
        ylabel="y (px)",
        title="Flare minus the image before (white: unusable)",
    )
    axes.legend(loc="upper right", fontsize=9)
    figure.colorbar(drawn, ax=axes, shrink=0.8, label=unit)


def _draw_profile(axes: Axes, found: FlareComparison, unit: str) -> None:
    profile = found.profile
    axes.errorbar(
        profile.distance_px,
        profile.observed,
        yerr=profile.sigma,
        fmt="o",
        markersize=3.5,
        color=_OBSERVED,
        elinewidth=0.9,
        label="observed",
    )
    for name, fit, colour in _fits(found):
        axes.plot(profile.distance_px, fit.simulated, color=colour, linewidth=1.6, label=name)
    lit = profile.observed[profile.observed > 0]
    floor = min(float(lit.min()), float(found.total.simulated[found.total.simulated > 0].min()))
    axes.set(
        yscale="log",
        ylim=(max(0.5 * floor, 1e-3 * float(lit.max())), 2 * float(lit.max())),
        ylabel=f"Light along the arm ({unit})",
    )
    axes.legend(frameon=False)


def _draw_residuals(axes: Axes, found: FlareComparison) -> None:
    """Draw simulated minus observed, divided by the noise, or by the observed light if the noise is unknown."""
    profile = found.profile
    unit = np.maximum(profile.observed, 1e-300) / 100 if profile.sigma is None else profile.sigma
    residuals = [((fit.simulated - profile.observed) / unit, colour) for _, fit, colour in _fits(found)]
    for residual, colour in residuals:
        axes.plot(profile.distance_px, residual, color=colour, linewidth=1.2)
    limit = min(100.0, 1.2 * float(np.percentile(np.abs(np.concatenate([r for r, _ in residuals])), 98)))
    axes.axhline(0, color="#999999", linewidth=0.8)
    axes.set(
        xlabel="Distance from the flare along the arm (px); shaded: matched distances",
        ylabel="Simulated - observed\n(% of observed)"
        if profile.sigma is None
        else "Simulated - observed\n(sigma)",
        ylim=(-limit, limit),
    )


def _fits(found: FlareComparison) -> list[tuple[str, FlareFit, str]]:
    fits = [] if found.diffraction is None else [("diffraction alone", found.diffraction, _ALONE)]
    return [*fits, ("total PSF", found.total, _TOTAL)]


_COLOURS = ("#c2402f", "#1b4f8a", "#2b8a6e", "#e0a100", "#7b3fa0", "#1b1b1b")


def arms_png(image: NDArray[np.float64], found: ArmMeasurement, path: str | Path, *, unit: str) -> None:
    """Draw the image [y, x] in `unit` with the fitted orders, and a cut along each arm, into a PNG file."""
    layout = ConstrainedLayoutEngine(w_pad=0.08)
    figure = Figure(figsize=(15.6, 6.2), dpi=100, facecolor="white", layout=layout)
    spacing = f"{found.spacing_px:.4f} ± {found.spacing_sigma_px:.4f} px"
    figure.suptitle(
        f"Order spacing {spacing}, {len(found.peaks)} orders fitted, reduced chi2 {found.reduced_chi2:.2f}",
        x=0.01,
        ha="left",
        weight="bold",
    )
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.35))
    _draw_image(figure, left, image, found, unit)
    _draw_cuts(right, image, found)
    write_png(figure, path)


def _draw_image(
    figure: Figure, axes: Axes, image: NDArray[np.float64], found: ArmMeasurement, unit: str
) -> None:
    lit = np.abs(found.model[found.fitted])
    top = float(np.percentile(lit, 99.5)) * 3 if lit.size else 1.0
    norm = SymLogNorm(top / 100, vmin=-top / 100, vmax=top)
    drawn = axes.imshow(image, origin="lower", cmap="magma", norm=norm, interpolation="nearest")
    for arm, angle in enumerate(found.angles_deg):
        x = [peak.x_px for peak in found.peaks if peak.arm == arm]
        y = [peak.y_px for peak in found.peaks if peak.arm == arm]
        name = f"{angle:.3f} ± {found.angles_sigma_deg[arm]:.3f} deg"
        colour = _COLOURS[arm % len(_COLOURS)]
        axes.plot(x, y, "o", markersize=6, markerfacecolor="none", color=colour, label=name)
    axes.set(xlabel="x (px)", ylabel="y (px)")
    axes.legend(fontsize=9, loc="upper right")
    figure.colorbar(drawn, ax=axes, shrink=0.8, label=unit)


def _draw_cuts(axes: Axes, image: NDArray[np.float64], found: ArmMeasurement) -> None:
    """Draw image and fit along each arm at the fitted pixels. The curves of the arms are drawn one above the other."""
    reach = max((abs(peak.order) for peak in found.peaks), default=1) * found.spacing_px + 5
    along = np.arange(-reach, reach, 0.25)
    clean = np.nan_to_num(image)
    for arm, angle in enumerate(np.deg2rad(found.angles_deg)):
        where = (
            found.centre_xy[1] + along * np.sin(angle),
            found.centre_xy[0] + along * np.cos(angle),
        )
        data = ndimage.map_coordinates(clean, where, order=1, mode="nearest")
        model = ndimage.map_coordinates(found.model, where, order=1)
        shown = ndimage.map_coordinates(found.fitted.astype(np.float64), where, order=1) > 0.99
        if not shown.any():
            continue
        height = 1.3 * float(np.percentile(np.abs(data[shown]), 99)) or 1.0
        colour = _COLOURS[arm % len(_COLOURS)]
        axes.plot(along, np.where(shown, data / height, np.nan) + arm, color="#888888", linewidth=2.2)
        axes.plot(along, np.where(shown, model / height, np.nan) + arm, color=colour, linewidth=1.1)
    axes.set(
        xlabel="Distance from the centre along the arm (px)",
        ylabel="Image (grey) and fit (colour), one curve per arm",
    )
    axes.set_yticks([])
    axes.spines[["top", "right", "left"]].set_visible(False)
