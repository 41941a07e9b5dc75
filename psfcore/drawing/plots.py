"""Plots: an image before and after deconvolution, and a PSF.

Each plot has its own figure on the Agg canvas, so threads share no state. pyplot would keep a state that they share.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, LinearSegmentedColormap, LogNorm, Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from matplotlib.ticker import FixedFormatter, FuncFormatter
from numpy.typing import NDArray

from psfcore.drawing.thumbnail import EUV_POINTS, NO_DATA, block_means
from psfcore.psf import Psf, crop_centred, cumulative_curve, radial_profile

PANEL_PX = 640
CHANGE_LIMIT_PCT = 100.0
GOLD = LinearSegmentedColormap.from_list("euv_gold", EUV_POINTS).with_extremes(bad=NO_DATA)
CHANGE = LinearSegmentedColormap.from_list(
    "change", ["#123a7a", "#3f7fc1", "#b9d5ea", "#f7f7f4", "#f6c9a4", "#d5642f", "#7d1a12"]
).with_extremes(bad=NO_DATA)
# Colour, width and dashes of each component's curve; thin curves are drawn behind wide ones.
_CURVES: dict[str, tuple[str, float, Any]] = {
    "TOTAL": ("#111111", 2.4, "-"),
    "DIFFRACTION": ("#7b3fa0", 2.0, "-"),
    "SCATTER": ("#e0a100", 2.0, "-"),
    "ENTRANCE": ("#1f6fb4", 1.3, "-"),
    "ENTRANCE_MESH": ("#2b9a77", 1.3, "-"),
    "MOUNT": ("#d5642f", 1.3, "-"),
    "FILTER_WHEEL": ("#c24a8c", 1.3, "-"),
    "AIRY": ("#8a8a8a", 1.6, (0, (4, 2))),
}
_OTHER_CURVE = ("#2b8a6e", 1.3, "-")
INK = "#222222"

Plane = NDArray[np.floating]


def write_png(figure: Figure, target: str | Path | IO[bytes], **options: Any) -> None:
    """Draw a figure and write it as PNG. options: the options of ``FigureCanvasAgg.print_png``.

    Matplotlib reads a text between two dollar signs as a formula, and fails if it is not a formula. Titles and labels
    contain names from files, so they are drawn without this rule. Only the numbers at the axes are formulas, such as
    10^3.
    """
    for text in _plain_texts(figure):
        text.set_parse_math(False)
    FigureCanvasAgg(figure).print_png(target, **options)


def png_of(figure: Figure) -> bytes:
    """A figure as PNG."""
    out = BytesIO()
    write_png(figure, out)
    return out.getvalue()


def _plain_texts(artist: Artist) -> Iterator[Text]:
    """All texts of a figure except the numbers at its axes."""
    if isinstance(artist, Axis):
        yield artist.label
        if isinstance(artist.get_major_formatter(), FixedFormatter | FuncFormatter):
            yield from artist.get_ticklabels()
        return
    if isinstance(artist, Text):
        yield artist
    for child in artist.get_children():
        yield from _plain_texts(child)


def tidy(charts: Sequence[Any]) -> None:
    """Draw a light grid behind the data, and remove the top and right spines."""
    for axes in charts:
        axes.set_axisbelow(True)
        axes.grid(which="major", color="#e2e2e2", linewidth=0.7)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)


def points(colour: str, size: float) -> dict[str, Any]:
    """The style of points with bars, for ``errorbar``."""
    return {"fmt": "o", "color": colour, "markersize": size, "elinewidth": 1.0, "markeredgewidth": 0}


def preview_png(before: Plane, after: Plane, path: str | Path, *, title: str, unit: str) -> None:
    """Write the figure of `preview_figure` as PNG."""
    write_png(preview_figure(before, after, title=title, unit=unit), path, pil_kwargs={"compress_level": 3})


def preview_figure(before: Plane, after: Plane, *, title: str, unit: str) -> Figure:
    """Draw three panels [y, x], first row at the bottom: before, after (same stretch), change in percent.

    unit: unit of the pixels, see `psfcore.drawing.units`.
    """
    step = max(1, -(-max(before.shape) // PANEL_PX))
    small_before, small_after = binned(before, step), binned(after, step)
    stretch = square_root_stretch(small_before, small_after)
    change = change_pct(small_before, small_after)
    figure = Figure(figsize=(15.6, 5.55), dpi=100, facecolor="white")
    figure.text(0.045, 0.955, title, fontsize=13, color=INK, va="center", weight="bold")
    extent = (-0.5, before.shape[1] - 0.5, -0.5, before.shape[0] - 0.5)
    panels: list[tuple[str, Plane, Colormap, Normalize, str]] = [
        ("Before", small_before, GOLD, stretch, unit),
        ("After", small_after, GOLD, stretch, unit),
        ("Change", change, CHANGE, Normalize(-CHANGE_LIMIT_PCT, CHANGE_LIMIT_PCT), "% of before"),
    ]
    for index, (name, data, colours, norm, label) in enumerate(panels):
        axes = figure.add_axes((0.045 + 0.318 * index, 0.085, 0.266, 0.79))
        drawn = axes.imshow(
            data, origin="lower", cmap=colours, norm=norm, extent=extent, interpolation="nearest"
        )
        axes.set_title(f"{name} ({label})", fontsize=11, color=INK, loc="left")
        axes.set_xlabel("x (px)")
        if index == 0:
            axes.set_ylabel("y (px)")
        else:
            axes.set_yticks([])
        colourbar(figure, axes, drawn, beyond="both" if name == "Change" else "max")
    return figure


def psf_png(psf: Psf, path: str | Path) -> None:
    """Write the figure of `psf_figure` as PNG."""
    write_png(psf_figure(psf), path)


def psf_figure(psf: Psf) -> Figure:
    """Draw three panels: the centre on a logarithmic scale, mean weight by radius, 1 - encircled energy by radius.

    There is a curve for the total PSF and one for each component. The Airy pattern of the open aperture is a reference.
    """
    figure = Figure(
        figsize=(15.6, 5.6),
        dpi=100,
        facecolor="white",
        layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08),
    )
    heading = f"PSF {psf.name} {psf.version} ({psf.status}), sum {psf.total:.4f} on {psf.kernel.shape[1]} px"
    figure.suptitle(heading, fontsize=14, color=INK, weight="bold", x=0.01, ha="left")
    image_axes, profile_axes, curve_axes = figure.subplots(1, 3, width_ratios=(1.12, 1, 1))
    _draw_centre(figure, image_axes, psf)
    kernels = {"TOTAL": psf.kernel, **psf.components}
    lowest = []
    looks = {name: _CURVES.get(name, _OTHER_CURVE) for name in kernels}
    for name, (colour, width, dashes) in sorted(looks.items(), key=lambda look: look[1][1]):
        kernel = kernels[name]
        style: dict[str, Any] = {"color": colour, "linewidth": width, "linestyle": dashes}
        radius, weight = _smoothed_profile(kernel)
        profile_axes.loglog(radius, weight, **style)
        lowest.append(float(weight[-1]) if weight.size else 1.0)
        radii = np.geomspace(0.5, psf.reach_px, 400)
        label = name.capitalize().replace("_", " ") + (" (open aperture)" if name == "AIRY" else "")
        curve_axes.semilogx(radii, cumulative_curve(kernel, radii), label=label, **style)
    profile_axes.set(
        xlabel="Radius (px)", ylabel="Mean weight (fraction per pixel)", title="Mean weight by radius"
    )
    curve_axes.set(xlabel="Radius (px)", ylabel="1 - encircled energy (%)", title="Light beyond a radius")
    curve_axes.set_ylim(bottom=0)
    profile_axes.set_ylim(bottom=max(1e-13, 0.3 * min(lowest)), top=1.5)
    for axes in (profile_axes, curve_axes):
        axes.set_xlim(0.5, psf.reach_px)
        axes.grid(which="major", color="#dddddd", linewidth=0.7)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.legend(loc="outside lower center", ncols=len(kernels), frameon=False, reverse=True)
    return figure


def _smoothed_profile(kernel: Plane) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The radius (px) and the mean weight of rings. Up to 17 px a ring is 1 px wide, farther out 1/17 of its radius.

    The centre is drawn at half a pixel, because a logarithmic axis has no zero. Rings without light are left out.
    """
    ring, mean = radial_profile(np.asarray(kernel, dtype=np.float64))
    group = np.where(ring < 17, ring, 17 + np.floor(17 * np.log(np.maximum(ring, 17) / 17))).astype(int)
    pixels = np.maximum(ring, 0.5)  # proportional to the number of pixels of a ring
    light = np.bincount(group, weights=mean * pixels)
    count = np.bincount(group, weights=pixels)
    radius = np.bincount(group, weights=pixels**2)
    shown = light > 0
    return radius[shown] / count[shown], light[shown] / count[shown]


def _draw_centre(figure: Figure, axes: Any, psf: Psf) -> None:
    size = min(129, *psf.kernel.shape)
    centre = crop_centred(psf.kernel, (size, size))
    half = size // 2
    peak = float(centre.max())
    norm = LogNorm(max(float(centre.min()), peak * 1e-7), peak, clip=True)
    extent = (-half - 0.5, size - half - 0.5, -half - 0.5, size - half - 0.5)
    drawn = axes.imshow(
        centre, origin="lower", cmap="magma", norm=norm, extent=extent, interpolation="nearest"
    )
    axes.set(xlabel="x from centre (px)", ylabel="y from centre (px)", title=f"Central {size} px")
    figure.colorbar(drawn, ax=axes, label="Weight (fraction per pixel)", shrink=0.85)


def binned(plane: Plane, step: int) -> NDArray[np.float64]:
    """Means of the finite values of step x step pixels; NaN if no value is finite.

    Incomplete last blocks are left out.
    """
    rows, columns = (step * np.arange(side // step) for side in plane.shape)
    return block_means(plane[: step * rows.size, : step * columns.size], rows, columns)


def square_root_stretch(before: Plane, after: Plane) -> PowerNorm:
    """One square-root stretch for both images: from 0 to the larger of their 99.7th percentiles."""
    finite = [plane[np.isfinite(plane)] for plane in (before, after)]
    top = max((float(np.percentile(values, 99.7)) for values in finite if values.size), default=1.0)
    top = top if top > 0 else 1.0
    return PowerNorm(0.5, vmin=0.0, vmax=top, clip=True)


def change_pct(before: Plane, after: Plane) -> NDArray[np.float64]:
    """100 (after / before - 1); NaN where `before` is not positive."""
    ratio = np.full(before.shape, np.nan)
    np.divide(after, before, out=ratio, where=before > 0)
    return np.asarray(100 * (ratio - 1))


def colourbar(figure: Figure, axes: Any, drawn: Any, *, beyond: str) -> None:
    box = axes.get_position()
    width = 0.0085
    bar_axes = figure.add_axes((box.x1 + 0.006, box.y0, width, box.height))
    bar = figure.colorbar(drawn, cax=bar_axes, extend=beyond, extendfrac=0.02)
    bar.outline.set_linewidth(0.5)
    bar_axes.tick_params(labelsize=8.5)
    axes.tick_params(labelsize=8.5)
