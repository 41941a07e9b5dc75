"""A plot of measured arms: the image with the fitted orders, and cuts through the image and the fit along each arm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray
from scipy import ndimage

from psfcore.drawing.plots import write_png
from psfcore.flare.arms import ArmMeasurement

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
    figure: Figure, axes: Any, image: NDArray[np.float64], found: ArmMeasurement, unit: str
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


def _draw_cuts(axes: Any, image: NDArray[np.float64], found: ArmMeasurement) -> None:
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
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
