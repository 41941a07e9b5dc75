"""A picture of a cross-validation: curve with bands, totals of all folds, held-out residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from psfcore.plots import INK
from psfcore.scatter.cross_validation import Bands, FoldFit

_POINTINGS = ("#1b4f91", "#c73e2b", "#2b8a6e", "#e0a100", "#7b3fa0")


def cross_validation_png(
    bands: Bands, fits: tuple[FoldFit, ...], fov_of: list[int], path: str | Path
) -> None:
    """Three panels: light beyond each distance with 1 and 2 sigma bands, histogram of totals, held-out residuals.

    fov_of: the pointing of each image.
    """
    figure = Figure(figsize=(15.6, 4.9), dpi=100, facecolor="white", layout="constrained")
    figure.suptitle(
        f"Cross-validation, {len(fits)} fits", fontsize=13, color=INK, weight="bold", x=0.01, ha="left"
    )
    curve, totals, held_out = figure.subplots(1, 3)
    low_2, low_1, median, high_1, high_2 = bands.curve_pct
    curve.fill_between(
        bands.radii_px, low_2, high_2, color="#9dbfe0", alpha=0.5, linewidth=0, label="2 sigma"
    )
    curve.fill_between(
        bands.radii_px, low_1, high_1, color="#4f8cc4", alpha=0.6, linewidth=0, label="1 sigma"
    )
    curve.semilogx(bands.radii_px, median, "o-", color=INK, markersize=3, linewidth=1.2, label="median")
    curve.set(
        xlabel="Distance (px)", ylabel="Light beyond the distance (%)", title="Total PSF", ylim=(0, None)
    )
    curve.legend(frameon=False)
    totals.hist(100 * bands.totals, bins=min(25, max(5, len(fits) // 4)), color="#4f8cc4")
    totals.set(xlabel="Diffusely scattered light (%)", ylabel="Fits", title="Totals of all fits")
    images = np.array(list(bands.held_out_pct))
    residual = np.array(list(bands.held_out_pct.values()))
    fov = np.array([fov_of[n] for n in images])
    for k, pointing in enumerate(np.unique(fov)):
        here = fov == pointing
        colour = _POINTINGS[k % len(_POINTINGS)]
        held_out.plot(
            images[here], residual[here], "o", color=colour, markersize=4, label=f"pointing {pointing}"
        )
    held_out.axhline(0.0, color=INK, linewidth=0.8)
    held_out.set(xlabel="Image", ylabel="Simulated - observed (% of observed)", title="Images held out")
    held_out.legend(frameon=False, ncols=3)
    for axes in (curve, totals, held_out):
        axes.grid(color="#dddddd", linewidth=0.7)
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    FigureCanvasAgg(figure).print_png(str(path))
