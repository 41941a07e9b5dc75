"""A plot that compares a PSF with a flare: the image with the arm, the light along the arm, and the residuals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from psfcore.drawing.plots import INK, tidy, write_png
from psfcore.flare.arm_profile import BOX_PX, MATCHED_PX, FlareComparison, FlareFit

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
        words += f"; {_summary('diffraction alone', found.diffraction)}, {found.rms_factor:.1f} times the rms error of the total PSF"
    return words


def _summary(name: str, fit: FlareFit) -> str:
    chi2 = "" if fit.chi2_per_distance is None else f", chi2 per distance {fit.chi2_per_distance:.2f}"
    return f"{name} rms error {fit.rms_pct:.1f} %{chi2}"


def _draw_flare(
    figure: Any,
    axes: Any,
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


def _draw_profile(axes: Any, found: FlareComparison, unit: str) -> None:
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


def _draw_residuals(axes: Any, found: FlareComparison) -> None:
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
