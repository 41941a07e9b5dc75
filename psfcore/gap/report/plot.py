"""The figures of a gap diagnosis: each as a PNG for a page about ten inches wide, and all of them in one picture.

Residuals are simulated minus observed, in percent of the observed mean of a disc. The named effects are those that the
verdict names as the cause of the gap ("answer" in the report). Full symbols show the fitted model without any cause,
open symbols the model with the told causes. Each pointing has a colour and a symbol.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Concatenate, ParamSpec

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Wedge

from psfcore.arrays import Flags, Plane, Vector
from psfcore.drawing.page import PLOT_DPI
from psfcore.drawing.plots import CHANGE, INK, png_of, tidy
from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.evidence.cells import RINGS, DiscCells
from psfcore.gap.report.report import fits_of, percent_words
from psfcore.gap.schema import FieldJson, FitJson, GapReport, IntervalJson

P = ParamSpec("P")

WIDTH_IN = 9.9
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#8a6d00", "#56B4E9")
_SYMBOLS = ("o", "s", "^", "D", "v", "P")
_BEFORE, _AFTER, _OBSERVED = "#D55E00", "#0072B2", "#333333"
_DARK = 0.55  # fraction of the colour scale above which numbers are white, because the colour is dark
# Half width of a slice along x, px; number of rows on each side of the middle row.
_SLICE_PX, SLICE_ROWS = 20, 2
MOST_EFFECTS = 10
CERTAIN_P = 1e-12  # a smaller p-value is written as "p < 1e-12"
_ANSWER, _OTHER = "#0072B2", "#9a9a9a"
# Smallest and largest closure that the chart shows; longer bars are cut.
_NO_CLOSURE, _MOST_CLOSURE = -0.35, 1.3
_TITLES = ("Fitted model", "With the told causes")
# The cells of a disc: inner and outer radius of the ring (in radii of the dark disc), number of the sector, sectors in
# the ring.
_CELLS = [(low, high, k, sectors) for low, high, sectors in RINGS for k in range(sectors)]


def _png(
    width_in: float,
    height_in: float,
    draw: Callable[Concatenate[Figure, P], None],
    *data: P.args,
    **named: P.kwargs,
) -> bytes:
    """The figure of `draw` as PNG. data: the arguments of `draw` after the figure."""
    figure = Figure(figsize=(width_in, height_in), dpi=PLOT_DPI, facecolor="white", layout="constrained")
    draw(figure, *data, **named)
    return png_of(figure)


def _panels(figure: Figure | SubFigure, after: bool, *, sharey: bool = False) -> list[Axes]:
    """Charts of the fitted model and, if `after`, of the model with the named effects."""
    charts = list(np.ravel(figure.subplots(1, 1 + after, squeeze=False, sharey=sharey)))
    for axes, title in zip(charts, _TITLES, strict=False):
        axes.set_title(title, fontsize=11)
    return charts


def residuals_png(report: GapReport) -> bytes:
    """Residuals of the discs' means against detector x, y and time, without and with the named effects."""
    return _png(WIDTH_IN, 3.7, draw_residuals, report)


def draw_residuals(figure: Figure | SubFigure, report: GapReport) -> None:
    """Draw the residuals on three charts, and one legend on the figure."""
    charts = list(figure.subplots(1, 3, sharey=True))
    rows = report["images"]
    looks = _looks(rows)
    along = (
        ("Detector x of the disc (px)", _column(rows, "x_px")),
        ("Detector y of the disc (px)", _column(rows, "y_px")),
        ("Time from the first image (min)", _column(rows, "time_s") / 60),
    )
    for axes, (label, at) in zip(charts, along, strict=True):
        axes.axhline(0, color="#555555", linewidth=1.0)
        for here, colour, symbol in looks.values():
            for what, face, ms, mew, bar in (("", colour, 5.0, 0.0, 1.1), ("after_", "white", 4.5, 1.2, 0.5)):
                residual, noise = (_column(rows, f"{name}_{what}pct") for name in ("residual", "noise"))
                axes.errorbar(
                    at[here],
                    residual[here],
                    noise[here],
                    fmt=symbol,
                    color=colour,
                    mfc=face,
                    ms=ms,
                    mew=mew,
                    elinewidth=bar,
                )
        axes.set(xlabel=label)
    charts[0].set(ylabel="Simulated - observed (%)")
    entries = [
        Line2D([], [], ls="none", ms=6, label=f"pointing {fov}", color=colour, marker=symbol)
        for fov, (_, colour, symbol) in looks.items()
    ]
    if has_after(report):
        full, hollow = (
            Line2D([], [], ls="none", ms=6, label=title.lower(), color="#555555", marker="o")
            for title in _TITLES
        )
        hollow.set(mfc="white", mew=1.2)
        entries += [full, hollow]
    figure.legend(
        handles=entries,
        loc="outside upper center",
        ncols=8,
        fontsize=9,
        frameon=False,
        columnspacing=1.2,
        handletextpad=0.3,
    )
    tidy(charts)


def map_png(report: GapReport) -> bytes:
    """Every disc at its position on the detector. The colour shows its residual, without and with the named effects."""
    return _png(4.95 * (1 + has_after(report)) + 0.6, 4.6, draw_map, report)


def draw_map(figure: Figure | SubFigure, report: GapReport) -> None:
    """Draw the residual of each image at the position of its disc on the detector.

    First chart: the fitted model without effects. Second chart, if there are residuals with the named effects: the
    model with these effects, on the same colour scale.
    """
    charts, rows = _panels(figure, has_after(report)), report["images"]
    x, y, before, noise = (_column(rows, name) for name in ("x_px", "y_px", "residual_pct", "noise_pct"))
    top, drawn = _scale(before, noise), None
    ny, nx = report["shape"]
    for axes, values in zip(charts, (before, _column(rows, "residual_after_pct")), strict=False):
        for fov, (of_fov, _, symbol) in _looks(rows).items():
            here = of_fov & np.isfinite(values)
            drawn = axes.scatter(
                x[here],
                y[here],
                s=62,
                c=values[here],
                marker=symbol,
                cmap=CHANGE,
                vmin=-top,
                vmax=top,
                edgecolors="#444444",
                linewidths=0.6,
            )
            axes.plot([], [], symbol, color="#777777", ms=7, label=f"pointing {fov}")
        axes.set(xlim=(-0.5, nx - 0.5), ylim=(-0.5, ny - 0.5), aspect="equal", xlabel="Detector x (px)")
    charts[0].set(ylabel="Detector y (px)")
    charts[0].legend(fontsize=8.5, loc="best", framealpha=0.85, edgecolor="none")
    assert drawn is not None  # every report has a chart and a pointing
    figure.colorbar(drawn, ax=charts, label="Simulated - observed (%)", shrink=0.85)
    tidy(charts)


def unocculted_png(report: GapReport) -> bytes:
    """The residual of the unocculted field of each image against time, without and with the named effects."""
    return _png(WIDTH_IN, 3.4, lambda figure: draw_unocculted(figure.subplots(), report))


def draw_unocculted(axes: Axes, report: GapReport) -> None:
    """Draw the residual of the blocks of each image, in units of the noise. Full symbols: the fitted model. Open
    symbols: the model with the named effects.
    """
    rows = report["images"]
    minutes = _column(rows, "time_s") / 60
    axes.axhline(1.0, color="#555555", linewidth=1.0)
    for fov, (here, colour, symbol) in _looks(rows).items():
        before, after = (_column(rows, name)[here] for name in ("unocculted", "unocculted_after"))
        axes.plot(minutes[here], before, symbol, color=colour, ms=5, mew=0, label=f"pointing {fov}")
        axes.plot(minutes[here], after, symbol, color=colour, ms=4.5, mfc="white", mew=1.2)
    axes.set(xlabel="Time from the first image (min)", ylabel="Residual (noise)")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8.5, loc="best", framealpha=0.85, edgecolor="none")
    tidy([axes])


def field_png(report: GapReport) -> bytes:
    """The first cause that has a shape: a map of the detector with its errors, or a curve."""
    field = field_of(report)
    assert field is not None
    label = f"Change {field['unit'] and '(' + field['unit'] + ')'}".rstrip()
    size, draw = ((7.0, 3.4), _draw_curve) if "curve" in field else ((10.0, 4.4), _draw_field)
    return _png(*size, draw, report, field, label)


def field_of(report: GapReport) -> FieldJson | None:
    """The field of the first cause that has one; None if there is none."""
    return next((cause["field"] for cause in report["causes"] if cause["field"] is not None), None)


def _draw_curve(figure: Figure | SubFigure, report: GapReport, field: FieldJson, label: str) -> None:
    at, values, sigma = field["curve"].values()
    along = ("Radius in the PSF (px)", "log") if "radius_px" in field["curve"] else ("Time (s)", "linear")
    axes = figure.subplots()
    axes.errorbar(at, values, sigma, fmt="o", ms=4, color=_ANSWER, ecolor=_OTHER)
    axes.axhline(0.0, color="#777777", lw=0.8)
    axes.set(xlabel=along[0], ylabel=label, xscale=along[1])
    tidy([axes])


def _draw_field(figure: Figure | SubFigure, report: GapReport, field: FieldJson, label: str) -> None:
    values, sigma = (np.array(field["map"][name]) for name in ("value", "sigma"))
    charts, clearest = figure.subplots(1, 2), abs(field["strength"]["value"])
    ny, nx = report["shape"]
    seen = np.where(sigma < clearest, values, np.nan)  # elsewhere the prior decides, not the data
    for axes, plane, title, top, name in (
        (charts[0], seen, "The field, where its error is smaller", 1.2 * clearest, label),
        (charts[1], values / sigma, "The field divided by its error", 5.0, "sigma"),
    ):
        extent = (-0.5, nx - 0.5, -0.5, ny - 0.5)
        drawn = axes.imshow(plane, origin="lower", extent=extent, cmap=CHANGE, vmin=-top, vmax=top)
        axes.set(title=title, xlabel="Detector x (px)", ylabel="Detector y (px)")
        axes.plot(*(_column(report["images"], name) for name in ("x_px", "y_px")), ".", color="#333333", ms=3)
        figure.colorbar(drawn, ax=axes, label=name, shrink=0.85)
    tidy(list(charts))


def cells_png(found: Diagnosis) -> bytes:
    """The residual of each cell, averaged over all images, without and with the named effects."""
    return _png(4.2 * (1 + bool(found.corrected)) + 0.9, 4.2, draw_cells, found)


def draw_cells(figure: Figure | SubFigure, found: Diagnosis) -> None:
    """Draw each cell as a sector of a ring. The second chart, if effects are named, shows the model with the named
    effects.
    """
    charts = _panels(figure, bool(found.corrected))
    evidences = [found.evidence, *([found.corrected.model.evidence] if found.corrected else [])]
    maps = [cell_means(evidence.discs) for evidence in evidences]
    top = _scale(*maps[0])
    for axes, (means, errors) in zip(charts, maps, strict=True):
        for (low, high, sector, sectors), mean, error in zip(_CELLS, means, errors, strict=True):
            if not np.isfinite(mean):
                continue
            ends = (sector - 0.5) * 360 / sectors, (sector + 0.5) * 360 / sectors
            share = float(np.clip(mean / top, -1, 1))
            colour = CHANGE((share + 1) / 2)
            axes.add_patch(Wedge((0, 0), high, *ends, width=high - low, fc=colour, ec="white", lw=1.0))
            angle, middle = np.radians(sector * 360 / sectors), (low + high) / 2 if low else 0.0
            axes.text(
                middle * np.cos(angle),
                middle * np.sin(angle),
                f"{mean:+.1f}\n±{error:.1f}",
                ha="center",
                va="center",
                color="white" if abs(share) > _DARK else INK,
                fontsize=8,
                linespacing=1.05,
            )
        axes.add_patch(Circle((0, 0), 1.0, fc="none", ec="#555555", lw=1.0))
        axes.set(
            xlim=(-1.05, 1.05),
            ylim=(-1.05, 1.05),
            aspect="equal",
            xlabel="x from the centre (radii of the dark disc)",
        )
        axes.spines[:].set_visible(False)
    charts[0].set(ylabel="y from the centre (radii of the dark disc)")


def cell_means(discs: Sequence[DiscCells]) -> tuple[Vector, Vector]:
    """The residual of each cell, averaged over the discs, and its error from noise: two arrays (cells,), percent.

    NaN if no disc has the cell.
    """
    sums, variance, count = (np.zeros(len(_CELLS)) for _ in range(3))
    for disc in discs:
        noise = np.sqrt(np.diag(disc.covariance))
        for k, number in enumerate(_numbers(disc)):
            sums[number] -= 100 * disc.residual[k] / disc.level
            variance[number] += (100 * noise[k] / disc.level) ** 2
            count[number] += 1
    there = np.where(count > 0, count, np.nan)
    return sums / there, np.sqrt(variance) / there


def _scale(values: Vector, noise: Vector) -> float:
    """The end of the colour scale: the largest absolute value, but at least three times the noise.

    On a shorter scale, noise would look like a gap.
    """
    typical = float(np.sqrt(np.nanmean(noise**2))) if np.isfinite(noise).any() else 0.0
    return max(float(np.nanmax(np.abs(values), initial=0.0)), 3 * typical, 1e-3)


def _numbers(disc: DiscCells) -> list[int]:
    """For each cell of a disc, its index in `_CELLS`. Cells with too few pixels are missing from the disc."""
    out, ends = [], [high for _, high, _ in RINGS[:-1]]
    for ring, azimuth in zip(np.searchsorted(ends, disc.radius, side="right"), disc.azimuth, strict=True):
        sectors, first = RINGS[ring][2], sum(one[2] for one in RINGS[:ring])
        out.append(first + round(float(azimuth) / (2 * np.pi / sectors)) % sectors)
    return out


def where_png(report: GapReport) -> bytes:
    """The share of the gap along each axis."""
    return _png(7.4, 0.9 + 0.32 * len(report["where"]), lambda figure: draw_where(figure.subplots(), report))


def effects_png(report: GapReport) -> bytes:
    """The closure by each effect on held-out images, best effect first."""
    height_in = 1.1 + 0.34 * min(len(fits_of(report)), MOST_EFFECTS)
    return _png(WIDTH_IN, height_in, lambda figure: draw_effects(figure.subplots(), report))


def slices_png(found: Diagnosis) -> bytes:
    """Light along x through the occulter with the largest residual: observed, and simulated without and with the named
    effects.
    """
    return _png(4.95 * (1 + bool(found.corrected)) + 0.1, 3.7, _draw_slices, found)


def _draw_slices(figure: Figure | SubFigure, found: Diagnosis) -> None:
    charts, n = _panels(figure, bool(found.corrected), sharey=True), largest_residual(found)
    transit, sky = found.solution.transit, found.solution.sky
    frame, centre, (rows, columns) = transit.frames[n], sky.found[n].place.x_px, sky.dark[n]
    # The centre of a disc at the edge of the field may be outside the field, but its dark pixels are inside.
    middle = int(np.median(rows))
    band = slice(max(middle - SLICE_ROWS, 0), middle + SLICE_ROWS + 1)
    first, last = max(int(centre) - _SLICE_PX, 0), min(int(centre) + _SLICE_PX + 1, frame.pixels.shape[1])
    x = np.arange(first, last) - centre
    seen = frame.pixels[band, first:last].astype(np.float64)
    noise = np.sqrt(transit.noise.variance(seen, frame.exposure_s).sum(axis=0)) / seen.shape[0]
    inside = columns[rows == middle] - centre
    simulated = [
        simulated_of(found, n, with_answer=answer)[band, first:last].mean(axis=0)
        for answer in (False, True)[: len(charts)]
    ]
    # The scale shows the light in the disc: the light around the disc may be a hundred times as bright.
    dark = np.isin(np.arange(first, last), columns[rows == middle])
    observed = seen.mean(axis=0)
    top = 2.2 * float(np.max([one[dark] for one in (observed, *simulated)], initial=1e-9))
    for axes, colour, line in zip(charts, (_BEFORE, _AFTER), simulated, strict=False):
        if inside.size:
            axes.axvspan(inside.min() - 0.5, inside.max() + 0.5, color="#eeeeee", linewidth=0, zorder=0)
        axes.errorbar(x, observed, noise, fmt="o", color=_OBSERVED, ms=3.8, elinewidth=0.9, label="observed")
        axes.plot(x, line, color=colour, linewidth=1.8, label="simulated")
        axes.set(xlim=(-_SLICE_PX, _SLICE_PX), ylim=(min(0.0, float(observed.min())) - 0.05 * top, top))
        axes.set_xlabel("Offset from the occulter's centre along x (px)")
        axes.legend(fontsize=8.5, loc="upper center", framealpha=0.85, edgecolor="none", ncols=2)
    charts[0].set(ylabel="Intensity (DN/s)")
    tidy(charts)


def largest_residual(found: Diagnosis) -> int:
    """The index, among all images, of the image whose disc has the largest residual in units of its noise."""
    size = [abs(disc.share @ disc.residual) / max(disc.mean_noise, 1e-12) for disc in found.evidence.discs]
    return found.evidence.discs[int(np.argmax(size))].index


def simulated_of(found: Diagnosis, n: int, *, with_answer: bool = False) -> Plane:
    """The model image of image n [y, x], DN/s; `with_answer` adds the change by the named effects."""
    raw = found.solution.transit.frames[n].pixels
    solution = found.corrected.solution if with_answer and found.corrected else found.solution
    seen = solution.optics.field(solution.optics.convolve(solution.blanked_scene(n)))
    # The original image minus the corrected image is the change by the effects.
    return np.asarray(seen, np.float64) + (raw - solution.transit.frames[n].pixels)


def gap_png(found: Diagnosis, report: GapReport) -> bytes:
    """The figure of `gap_figure` as PNG."""
    return png_of(gap_figure(found, report))


def gap_figure(found: Diagnosis, report: GapReport) -> Figure:
    """All figures as one figure, below the summary sentence."""
    figure = Figure(figsize=(15.0, 13.2), dpi=100, facecolor="white", layout="constrained")
    words = "\n".join("\n".join(textwrap.wrap(line, 165)) for line in report["lines"])
    figure.suptitle(words, fontsize=12.5, color=INK, x=0.012, ha="left", linespacing=1.4)
    bands = figure.subfigures(3, 1, squeeze=False, height_ratios=(1.0, 1.05, 1.1))[:, 0]
    draw_residuals(bands[0], report)
    left, right = bands[1].subfigures(1, 2, width_ratios=(1.25, 1.0))
    draw_map(left, report)
    draw_cells(right, found)
    where, effects = bands[2].subfigures(1, 2, width_ratios=(0.85, 1.15))
    draw_where(where.subplots(), report)
    draw_effects(effects.subplots(), report)
    return figure


def has_after(report: GapReport) -> bool:
    """Whether the report has residuals of the model with the named effects."""
    return any(row["residual_after_pct"] is not None for row in report["images"])


def _column(rows: Sequence[Mapping[str, float | None]], name: str) -> Vector:
    """One number of every image (images,); NaN if the number is missing."""
    return np.array([np.nan if row[name] is None else row[name] for row in rows], dtype=np.float64)


def _looks(rows: Sequence[Mapping[str, float | None]]) -> dict[int, tuple[Flags, str, str]]:
    """For each pointing: which images belong to it (images,), its colour and its symbol."""
    pointing = _column(rows, "fov")
    looks = itertools.cycle(zip(_COLOURS, _SYMBOLS, strict=True))
    return {int(fov): (pointing == fov, *look) for fov, look in zip(np.unique(pointing), looks, strict=False)}


# --- bars -------------------------------------------------------------------------------------------------


def draw_where(axes: Axes, report: GapReport) -> None:
    """Draw one horizontal bar for each axis, with its p-value. The axes are in the order of the report; the first is at
    the top.
    """
    rows = report["where"]
    at, shares = np.arange(len(rows))[::-1], np.array([100 * row["share"] for row in rows])
    colours = [_ANSWER if n == 0 and report["verdict"] != "none" else _OTHER for n in range(len(rows))]
    bars = axes.barh(at, shares, color=colours, height=0.7)
    numbers = [
        f"= {row['p_value']:.2g}" if row["p_value"] >= CERTAIN_P else f"< {CERTAIN_P:.0e}" for row in rows
    ]
    axes.bar_label(bars, [f"p {number}" for number in numbers], padding=4, fontsize=8.5)
    axes.set_yticks(at, [row["axis"].replace("_", " ") for row in rows])
    axes.set(xlim=(0, 1.3 * max(float(shares.max(initial=0.0)), 1.0)), xlabel="Share of the gap (%)")
    tidy([axes])


def draw_effects(axes: Axes, report: GapReport) -> None:
    """Draw the closure by each effect, with its 90 % interval and its probability. The named or tied effects are
    blue.
    """
    rows = fits_of(report)[:MOST_EFFECTS]
    at, chosen = np.arange(len(rows))[::-1], [_chosen(row, report) for row in rows]
    mark = {"attributed": "  (named)", "tie": "  (tied)"}.get(report["verdict"], "")
    axes.set_yticks(at, [row["words"] + (mark if one else "") for row, one in zip(rows, chosen, strict=True)])
    for y, row, is_one, tick in zip(at, rows, chosen, axes.get_yticklabels(), strict=True):
        _draw_closure(axes, float(y), row["closure"], _ANSWER if is_one else _OTHER)
        axes.text(1.52, y, percent_words(row["probability"]), va="center", ha="right", fontsize=9)
        tick.set_fontweight("bold" if is_one else "normal")
    above = at.max(initial=0) + 0.75
    axes.text(1.52, above, "probability", va="center", ha="right", fontsize=9, color="#555555")
    axes.axvline(0, color="#555555", linewidth=1.0)
    axes.axvline(1, color="#555555", linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set(xlim=(_NO_CLOSURE, 1.56), ylim=(-0.7, len(rows) + 0.2), xticks=(0, 0.25, 0.5, 0.75, 1.0))
    axes.set_xlabel("Closure of the gap on held-out images (0: no closure, 1: full closure)", x=0.45)
    tidy([axes])


def _chosen(row: FitJson, report: GapReport) -> bool:
    """Whether a row of the report is the fit of the named effects. For a tie: whether it is the fit of a tied
    hypothesis.
    """
    names = set(row["name"].split(" + "))
    return names == set(report["answer"]) or (report["verdict"] == "tie" and names <= set(report["answer"]))


def _draw_closure(axes: Axes, y: float, closure: IntervalJson | None, colour: str) -> None:
    if closure is None:
        axes.text(0.02, y, "no gap to close", va="center", fontsize=8.5, color="#666666")
        return
    value, (low, high) = closure["value"], closure["ci90"]
    axes.barh(y, float(np.clip(value, _NO_CLOSURE, _MOST_CLOSURE)), color=colour, height=0.62)
    ends = np.clip([low, high], _NO_CLOSURE + 0.012, _MOST_CLOSURE)
    axes.plot(ends, [y, y], color=INK, linewidth=1.4)
    for end, beyond, cut in zip(ends, (low < ends[0], high > ends[1]), ("<", ">"), strict=True):
        axes.plot([end], [y], cut if beyond else "|", color=INK, markersize=5 if beyond else 8, clip_on=False)
    if value < _NO_CLOSURE:
        axes.text(_NO_CLOSURE + 0.03, y + 0.2, f"{value:.1f}", va="center", fontsize=7.5, color=INK)
