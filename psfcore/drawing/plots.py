"""Plots of an image before and after deconvolution and of a PSF, and the parts that the charts of fits and evaluations
share.

Each plot has its own figure on the Agg canvas, so threads share no state. pyplot would keep a state that they share.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import IO, Literal, NamedTuple, TypedDict

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, LogNorm, Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from matplotlib.ticker import FixedFormatter, FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from psfcore.drawing.field_plot import field_figure
from psfcore.drawing.thumbnail import EUV_POINTS, NO_DATA, block_means
from psfcore.instruments.psf_statements import curves_once, title
from psfcore.psf import REACH_GRID_PX, Kernel, Psf, crop_centred, cumulative_curve, radial_profile

PANEL_PX = 640
CHANGE_LIMIT_PCT = 100.0
GOLD = LinearSegmentedColormap.from_list("euv_gold", EUV_POINTS).with_extremes(bad=NO_DATA)
CHANGE = LinearSegmentedColormap.from_list(
    "change", ["#123a7a", "#3f7fc1", "#b9d5ea", "#f7f7f4", "#f6c9a4", "#d5642f", "#7d1a12"]
).with_extremes(bad=NO_DATA)
Dashes = str | tuple[float, Sequence[float]]
# Colour, width and dashes of each component's curve; thin curves are drawn behind wide ones.
_CURVES: dict[str, tuple[str, float, Dashes]] = {
    "TOTAL": ("#111111", 2.4, "-"),
    "DIFFRACTION": ("#7b3fa0", 2.0, "-"),
    "SCATTER": ("#e0a100", 2.0, "-"),
    "ENTRANCE": ("#1f6fb4", 1.3, "-"),
    "ENTRANCE_MESH": ("#2b9a77", 1.3, "-"),
    "MOUNT": ("#d5642f", 1.3, "-"),
    "FILTER_WHEEL": ("#c24a8c", 1.3, "-"),
    "AIRY": ("#8a8a8a", 1.6, (0, (4, 2))),
}
_OTHER_CURVE: tuple[str, float, Dashes] = ("#2b8a6e", 1.3, "-")
INK = "#222222"

Plane = NDArray[np.floating]
Vector = NDArray[np.float64]
LegendPlace = Literal["upper left", "upper center", "upper right", "best"]
AxesBounds = tuple[float, float, float, float]  # left, bottom, width and height, as fractions of the figure

NEAREST_PX, FARTHEST_PX = 0.5, REACH_GRID_PX / 2
POINTINGS = ("#1b4f8a", "#c2402f", "#2b8a6e", "#7b3fa0", "#8a6d00", "#5b5b5b")
_MANY_IMAGES = 60  # with this many images or more, markers are smaller
_LETTERS_AN_INCH = 11.5


class PointStyle(TypedDict):
    """The style of points with bars, for ``errorbar``."""

    fmt: str
    color: str
    markersize: float
    elinewidth: float
    markeredgewidth: float


class Panel(NamedTuple):
    """An image to draw.

    Attributes
    ----------
    beyond
        The ends of the colour bar beyond which there are values, as `Figure.colorbar` names them (``extend``): "max" or
        "both".
    """

    title: str
    pixels: Plane
    colours: Colormap
    norm: Normalize
    beyond: str


def write_png(
    figure: Figure, target: str | Path | IO[bytes], *, pil_kwargs: dict[str, int] | None = None
) -> None:
    """Draw a figure and write it as PNG.

    Matplotlib reads a text between two dollar signs as a formula, and fails if it is not a formula. Titles and labels
    contain names from files, so they are drawn without this rule. Only the numbers at the axes are formulas, such as
    10^3.

    Parameters
    ----------
    pil_kwargs
        Options of Pillow's writer of PNG.
    """
    for text in _plain_texts(figure):
        text.set_parse_math(False)
    FigureCanvasAgg(figure).print_png(target, pil_kwargs=pil_kwargs)


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


def tidy(charts: Sequence[Axes]) -> None:
    """Draw a light grid behind the data, and remove the top and right spines."""
    for axes in charts:
        axes.set_axisbelow(True)
        axes.grid(which="major", color="#e2e2e2", linewidth=0.7)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)


def points(colour: str, size: float) -> PointStyle:
    """The style of points with bars, for ``errorbar``."""
    return {"fmt": "o", "color": colour, "markersize": size, "elinewidth": 1.0, "markeredgewidth": 0}


def preview_png(before: Plane, after: Plane, path: str | Path, *, title: str, unit: str) -> None:
    """Write the figure of `preview_figure` as PNG."""
    write_png(preview_figure(before, after, title=title, unit=unit), path, pil_kwargs={"compress_level": 1})


def preview_figure(before: Plane, after: Plane, *, title: str, unit: str) -> Figure:
    """Draw three panels [y, x], first row at the bottom: before, after (same stretch), change in percent.

    Parameters
    ----------
    unit
        Unit of the pixels, see `psfcore.fits.units`.
    """
    figure = Figure(figsize=(15.6, 5.55), dpi=100, facecolor="white")
    figure.text(0.045, 0.955, title, fontsize=13, color=INK, va="center", weight="bold")
    places = [(0.045 + 0.318 * index, 0.085, 0.266, 0.79) for index in range(3)]
    draw_panels(figure, compared_panels(before, after, unit), places, before.shape)
    return figure


def compared_panels(before: Plane, after: Plane, unit: str) -> list[Panel]:
    """The panels of an image before and after (same stretch), and of the change in percent; each at most PANEL_PX
    wide.
    """
    step = max(1, -(-max(before.shape) // PANEL_PX))
    before, after = binned(before, step), binned(after, step)
    stretch = square_root_stretch(before, after)
    limits_pct = Normalize(-CHANGE_LIMIT_PCT, CHANGE_LIMIT_PCT)
    return [
        Panel(f"Before ({unit})", before, GOLD, stretch, "max"),
        Panel(f"After ({unit})", after, GOLD, stretch, "max"),
        Panel("Change (% of before)", change_pct(before, after), CHANGE, limits_pct, "both"),
    ]


def draw_panels(
    figure: Figure, panels: Sequence[Panel], places: Sequence[AxesBounds], shape: tuple[int, ...]
) -> None:
    """Draw panels, three in a row, each with a colour bar.

    Parameters
    ----------
    shape
        Shape of the image in pixels, for the axes.
    """
    extent = (-0.5, shape[1] - 0.5, -0.5, shape[0] - 0.5)
    for index, (panel, place) in enumerate(zip(panels, places, strict=True)):
        axes = figure.add_axes(place)
        drawn = axes.imshow(
            panel.pixels,
            origin="lower",
            cmap=panel.colours,
            norm=panel.norm,
            extent=extent,
            interpolation="nearest",
        )
        axes.locator_params(nbins=4)  # a preview is drawn for every product, and ticks take most of the time
        axes.set_title(panel.title, fontsize=11, color=INK, loc="left")
        axes.set_xlabel("x (px)")
        if index % 3 == 0:
            axes.set_ylabel("y (px)")
        else:
            axes.set_yticks([])
        colourbar(figure, axes, drawn, beyond=panel.beyond)


def psf_png(psf: Psf, path: str | Path) -> None:
    """Write the figure of `psf_figure` as PNG."""
    write_png(psf_figure(psf), path)


def psf_figure(psf: Psf) -> Figure:
    """Draw three panels: the centre on a logarithmic scale, mean weight by radius, 1 - encircled energy by radius.

    There is a curve for the total PSF and one for each component. The Airy pattern of the open aperture is a reference.
    Of a PSF that changes over the field: `field_figure`.
    """
    if psf.field_terms:
        return field_figure(psf)
    figure = Figure(
        figsize=(15.6, 5.6),
        dpi=100,
        facecolor="white",
        layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08),
    )
    heading = f"{title(psf.name, psf.version, psf.status)}, sum {psf.total:.4f} on {psf.kernel.shape[1]} px"
    figure.suptitle(heading, fontsize=14, color=INK, weight="bold", x=0.01, ha="left")
    image_axes, profile_axes, curve_axes = figure.subplots(1, 3, width_ratios=(1.12, 1, 1))
    _draw_centre(figure, image_axes, psf)
    curves = curves_of(psf)
    lowest = []
    looks = {names: _CURVES.get(names[0], _OTHER_CURVE) for names in curves}
    for names, (colour, width, dashes) in sorted(looks.items(), key=lambda look: look[1][1]):
        kernel = curves[names]
        radius, weight = _smoothed_profile(kernel)
        profile_axes.loglog(radius, weight, color=colour, linewidth=width, linestyle=dashes)
        lowest.append(float(weight[-1]) if weight.size else 1.0)
        radii = np.geomspace(0.5, psf.reach_px, 400)
        curve_axes.semilogx(
            radii,
            cumulative_curve(kernel, radii),
            label=curve_label(names).capitalize(),
            color=colour,
            linewidth=width,
            linestyle=dashes,
        )
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
    figure.legend(loc="outside lower center", ncols=len(curves), frameon=False, reverse=True)
    return figure


def curves_of(psf: Psf) -> dict[tuple[str, ...], Kernel]:
    """The weights whose curves a figure shows, by their names: "TOTAL" and the components."""
    return curves_once({"TOTAL": psf.kernel, **psf.components}, np.array_equal)


def curve_label(names: Sequence[str]) -> str:
    """The text of a legend for a curve with these names."""
    return ", ".join(names).lower().replace("_", " ").replace("airy", "airy (open aperture)")


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


def _draw_centre(figure: Figure, axes: Axes, psf: Psf) -> None:
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


def colourbar(figure: Figure, axes: Axes, drawn: ScalarMappable, *, beyond: str) -> None:
    """Draw the bar of colours of a map at the right of its axes.

    Parameters
    ----------
    beyond
        The ends of the bar beyond which there are values, as for ``extend`` of `Figure.colorbar`.
    """
    box = axes.get_position()
    width = 0.0085
    bar_axes = figure.add_axes((box.x1 + 0.006, box.y0, width, box.height))
    bar = figure.colorbar(drawn, cax=bar_axes, extend=beyond, extendfrac=0.02)
    bar.locator = MaxNLocator(4)
    bar.update_ticks()
    bar.outline.set_linewidth(0.5)
    bar_axes.tick_params(labelsize=8.5)
    axes.tick_params(labelsize=8.5)


def headed_figure(width_in: float, height_in: float, name: str, sentence: str) -> Figure:
    """An empty figure with a name in bold and a sentence below it."""
    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1, hspace=0.03, wspace=0.03)
    figure = Figure(figsize=(width_in, height_in), dpi=100, facecolor="white", layout=layout)
    # The layout reserves space for one title. Its first line is empty, and the name fills that line in bold.
    words = "\n".join(textwrap.wrap(sentence, int(_LETTERS_AN_INCH * width_in)))
    figure.suptitle(f"\n{words}", fontsize=11, color=INK, x=0.012, ha="left", linespacing=1.5)
    figure.text(0.012, 1 - 0.12 / height_in, name, fontsize=14, color=INK, weight="bold", va="top")
    return figure


def legend(
    axes: Axes,
    size: float = 9,
    loc: LegendPlace = "upper right",
    *,
    title: str | None = None,
    title_fontsize: float | None = None,
    ncols: int = 1,
    columnspacing: float | None = None,
    handletextpad: float | None = None,
) -> None:
    """Draw a legend without a frame."""
    axes.legend(
        fontsize=size,
        loc=loc,
        frameon=False,
        title=title,
        title_fontsize=title_fontsize,
        ncols=ncols,
        columnspacing=columnspacing,
        handletextpad=handletextpad,
    )


def boxed_legend(axes: Axes, size: float = 9, loc: LegendPlace = "best") -> None:
    """Draw a legend of two columns on a white ground, for charts that are full of lines."""
    axes.legend(fontsize=size, loc=loc, frameon=True, framealpha=0.85, edgecolor="none", ncols=2)


def marker_size(images: int) -> float:
    """The size of the markers of a chart with one point for each image."""
    return 5.0 if images < _MANY_IMAGES else 3.2


def by_pointing(pointings: Sequence[int]) -> list[tuple[int, NDArray[np.bool_], str]]:
    """Each pointing with a mask of its images and its colour; `pointings` holds the pointing of each image."""
    of_images = np.array(pointings)
    return [
        (one, of_images == one, POINTINGS[n % len(POINTINGS)]) for n, one in enumerate(sorted(set(pointings)))
    ]


def draw_errors(
    axes: Axes, pointings: Sequence[int], where: Vector, values: Vector, noise: Vector | None
) -> None:
    """Draw the errors of images, with their noise if it is known. Values of nan are not drawn.

    The colour shows the pointing.

    Parameters
    ----------
    pointings
        Pointing of each image.
    where
        Abscissa of each image.
    """
    axes.axhline(0, color="#555555", linewidth=1.0)
    for pointing, here, colour in by_pointing(pointings):
        bars = None if noise is None else noise[here]
        style = points(colour, marker_size(len(pointings)))
        axes.errorbar(where[here], values[here], bars, label=f"{pointing}", **style)
    span = np.abs(values) + (0.0 if noise is None else noise)
    top = 1.12 * float(span[np.isfinite(span)].max(initial=1e-3))
    axes.set_ylim(-top, 1.35 * top)
    legend(
        axes,
        loc="upper center",
        title="pointing",
        title_fontsize=9,
        ncols=6,
        columnspacing=1.0,
        handletextpad=0.2,
    )


def draw_band(
    axes: Axes, x: Vector, limits: NDArray[np.float64], colour: str, name: str, *, marker: str = ""
) -> None:
    """Draw a median and its bands of 1 and 2 sigma.

    Parameters
    ----------
    limits
        The values at -2 sigma, -1 sigma, the median, +1 sigma and +2 sigma, one row each.
    """
    low_2, low_1, median, high_1, high_2 = limits
    axes.fill_between(x, low_2, high_2, color=colour, alpha=0.18, linewidth=0)
    axes.fill_between(x, low_1, high_1, color=colour, alpha=0.32, linewidth=0)
    axes.plot(x, median, color=colour, marker=marker, markersize=3, linewidth=1.4, label=name)


def draw_weights_of_shells(
    axes: Axes, edges_px: Vector, limits: NDArray[np.float64], field_px: float, colour: str
) -> None:
    """Draw the weights of the free shells that begin within the field as steps: medians, bands of 1 and 2 sigma.

    No pixel constrains the other shells. The axis is logarithmic, so weights of 0 are drawn as very small ones.

    Parameters
    ----------
    limits
        The rows of `draw_band`, with one column for each shell.
    """
    shown = edges_px[:-1] < field_px
    edges = edges_px[: np.count_nonzero(shown) + 1]
    low_2, low_1, median, high_1, high_2 = np.maximum(limits[:, shown], 1e-30)
    for low, high, alpha, name in ((low_2, high_2, 0.14, "±2 σ"), (low_1, high_1, 0.28, "±1 σ")):
        steps = np.append(low, low[-1]), np.append(high, high[-1])
        label = f"free shells, {name}"
        axes.fill_between(edges, *steps, step="post", label=label, color=colour, alpha=alpha, linewidth=0)
    axes.stairs(median, edges, baseline=None, color=colour, linewidth=1.1, label="free shells, median")


def draw_totals(axes: Axes, totals: Vector, colour: str) -> None:
    """Draw a histogram of the total scatter of all fits; `totals` holds fractions of all light."""
    axes.hist(100 * totals, bins=min(25, max(5, totals.size // 4)), color=colour, label="folds")
    axes.set(xlabel="Diffusely scattered light (% of all light)", ylabel="Number of fits")


def along_distance(axes: Axes, field_px: float, label: str = "Distance (px)") -> None:
    """Make the x axis a logarithmic axis of distances, with ticks such as 1, 10, 100.

    Distances beyond the field are shaded, because the PSF there is an extrapolation of the fitted shape.
    """
    axes.set(xscale="log", xlim=(NEAREST_PX, FARTHEST_PX), xlabel=label)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    if field_px < FARTHEST_PX:
        axes.axvspan(field_px, FARTHEST_PX, label="beyond the field", color="#efefef", zorder=0, linewidth=0)
