"""Plots of images and PSFs on axes of matplotlib. Every function takes axes, or makes new ones, and returns them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from heliopsf.outputs import Deconvolution, used_psf
from psfcore.drawing.plots import (
    CHANGE,
    CHANGE_LIMIT_PCT,
    GOLD,
    change_pct,
    curve_label,
    curves_of,
    preview_figure,
    square_root_stretch,
)
from psfcore.fits.units import unit_label
from psfcore.instruments.psf_statements import title
from psfcore.psf import Psf, crop_centred, cumulative_curve

if TYPE_CHECKING:
    from psfcore.scatter.fit import TransitFit  # needs packages that pictures do not need


def draw_psf(psf: Psf, axes: Axes | None, *, size: int) -> Axes:
    """Draw the central ``size`` px of a PSF on a logarithmic scale."""
    axes = _axes(axes)
    side = min(size, *psf.kernel.shape)
    centre = crop_centred(psf.kernel, (side, side))
    peak = float(centre.max())
    half = side // 2
    drawn = axes.imshow(
        centre,
        origin="lower",
        cmap="magma",
        norm=LogNorm(max(float(centre.min()), peak * 1e-7), peak, clip=True),
        extent=(-half - 0.5, side - half - 0.5, -half - 0.5, side - half - 0.5),
        interpolation="nearest",
    )
    axes.set(
        xlabel="x from centre (px)",
        ylabel="y from centre (px)",
        title=title(psf.name, psf.version, psf.status),
    )
    axes.figure.colorbar(drawn, ax=axes, label="Weight (fraction per pixel)")
    return axes


def draw_curves(psf: Psf, axes: Axes | None) -> Axes:
    """Draw the light beyond each radius, of a PSF and of its components."""
    axes = _axes(axes)
    radii = np.geomspace(0.5, psf.reach_px, 400)
    for names, kernel in curves_of(psf).items():
        axes.semilogx(radii, cumulative_curve(kernel, radii), label=curve_label(names), linewidth=1.5)
    axes.set(
        xlabel="Radius (px)",
        ylabel="1 - encircled energy (%)",
        title=title(psf.name, psf.version, psf.status),
        xlim=(0.5, psf.reach_px),
    )
    axes.set_ylim(bottom=0)
    if psf.components:
        axes.legend(frameon=False)
    return axes


def draw_image(result: Deconvolution, axes: Axes | None) -> Axes:
    """Draw a deconvolved image, with the stretch that fits the image before and after."""
    axes = _axes(axes)
    stretch = square_root_stretch(result.image.pixels, result.pixels)
    _draw(axes, result.pixels, GOLD, stretch, unit_label(result.image))
    axes.set_title(result.title(used_psf(result.psf)))
    return axes


def draw_change(result: Deconvolution, axes: Axes | None) -> Axes:
    """Draw the change of each pixel in percent of the input."""
    axes = _axes(axes)
    change = change_pct(result.image.pixels, result.pixels)
    _draw(axes, change, CHANGE, Normalize(-CHANGE_LIMIT_PCT, CHANGE_LIMIT_PCT), "Change (% of before)")
    axes.set_title(result.title(used_psf(result.psf)))
    return axes


def before_and_after(result: Deconvolution) -> Figure:
    """Three panels: before, after, change."""
    return preview_figure(
        result.image.pixels,
        result.pixels,
        title=result.title(used_psf(result.psf)),
        unit=unit_label(result.image),
    )


def draw_fit(fit: TransitFit, axes: Axes | None) -> Axes:
    """Draw the light beyond each radius that a fit finds, with its standard error."""
    axes = _axes(axes)
    for curve, name in ((fit.curve, "total"), (fit.diffuse_curve, "diffuse")):
        (line,) = axes.semilogx(curve.radii_px, curve.pct, label=name)
        low, high = curve.pct - curve.sigma, curve.pct + curve.sigma
        axes.fill_between(curve.radii_px, low, high, color=line.get_color(), alpha=0.25, linewidth=0)
    axes.set(xlabel="Radius (px)", ylabel="1 - encircled energy (%)", title=fit.inversion.shape.name)
    axes.legend(frameon=False)
    return axes


def _draw(axes: Axes, plane: NDArray[np.floating], colours: Colormap, norm: Normalize, label: str) -> None:
    drawn = axes.imshow(plane, origin="lower", cmap=colours, norm=norm, interpolation="nearest")
    axes.set(xlabel="x (px)", ylabel="y (px)")
    axes.figure.colorbar(drawn, ax=axes, label=label)


def _axes(axes: Axes | None) -> Axes:
    return pyplot.subplots()[1] if axes is None else axes
