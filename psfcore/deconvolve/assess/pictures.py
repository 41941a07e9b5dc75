"""Show what deconvolution changed: a page with six panels for one image; numbers and a sheet of thumbnails for many
images.

Hofmeister et al., The point-spread function of HRI_EUV, section "Effects on HRI_EUV images", deconvolved a catalogue at
a daily cadence "to visually inspect for artifacts". This module sorts the images by artefact score, so that a person
inspects the most doubtful images first. Only thumbnails of the images are kept in memory. The images are deconvolved
elsewhere: `changes_in_product` reads the numbers from the details of a product, and the suspected pixels from its plane
QUALITY.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, SymLogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from psfcore.deconvolve.assess.changes import Changes, block_means
from psfcore.deconvolve.assess.quality import QualityBit
from psfcore.deconvolve.summary import LOOK_FROM
from psfcore.drawing.plots import (
    CHANGE,
    CHANGE_LIMIT_PCT,
    GOLD,
    INK,
    AxesBounds,
    Panel,
    binned,
    change_pct,
    compared_panels,
    draw_panels,
    square_root_stretch,
    write_png,
)
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.cards import optional_text
from psfcore.fits.images import read_planes
from psfcore.fits.observation import read_observation

_HISTOGRAM_BLOCK_PX = 4
_RATIO_MARKS = (0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0)
_BEFORE, _AFTER = "#1f6fb4", "#d5642f"

Plane = NDArray[np.floating]
THUMBNAIL_PX = 256
MOST_ON_SHEET = 60
DATE_KEYS = ("DATE-BEG", "DATE-OBS", "T_OBS")
# Each image is represented by these rows of psfcore.deconvolve.assess.changes: blocks of 4 px, tails of 1 %.
BLOCK_PX, TAIL_PCT = 4, 1.0
_MARKS = 300
_LETTERS = 48
_DOUBTFUL, _CLEAN = "#b3261e", "#2b8a6e"
_CELL_IN, _TEXT_IN, _TITLE_IN = 2.0, 0.62, 0.75


def changes_png(
    before: Plane, after: Plane, changes: Changes, path: str | Path, *, title: str, unit: str
) -> None:
    """Draw before, after, change in percent, difference, ratio and histogram into a PNG file.

    Parameters
    ----------
    before, after
        Pixels [y, x] in `unit`; row 0 is drawn at the bottom.
    changes
        The numbers below the panels.
    """
    panels = compared_panels(before, after, unit)
    old, new = panels[0].pixels, panels[1].pixels
    difference = new - old
    limit = max(_largest(difference), 1e-12)
    ratio = np.divide(new, old, out=np.full(old.shape, np.nan), where=old > 0)
    ratio = np.where(ratio > 0, ratio, np.nan)
    span = max(1.1, 2 ** _largest(np.log2(ratio)))
    ends = SymLogNorm(limit / 30, vmin=-limit, vmax=limit)
    panels += [
        Panel(f"After - before ({unit})", difference, CHANGE, ends, "both"),
        Panel("After / before", ratio, CHANGE, LogNorm(1 / span, span), "both"),
    ]
    figure = Figure(figsize=(15.6, 11.1), dpi=100, facecolor="white")
    figure.text(0.045, 0.977, title, fontsize=13, color=INK, va="center", weight="bold")
    draw_panels(figure, panels, [_place(index) for index in range(5)], before.shape)
    marks = [mark for mark in _RATIO_MARKS if 1 / span <= mark <= span]
    ratio_bar = figure.axes[-1]
    ratio_bar.set_yticks(marks, [f"{mark:g}" for mark in marks])
    ratio_bar.set_yticks([], minor=True)
    left, bottom, width, height = _place(5)
    _draw_histogram(figure.add_axes((left + 0.02, bottom, width, height)), before, after, unit)
    figure.text(0.045, 0.022, _figures(changes), fontsize=10, color=INK, va="center")
    write_png(figure, path, pil_kwargs={"compress_level": 3})


def _place(index: int) -> AxesBounds:
    row, column = divmod(index, 3)
    return 0.045 + 0.318 * column, 0.555 - 0.465 * row, 0.266, 0.38


def _draw_histogram(axes: Axes, before: Plane, after: Plane, unit: str) -> None:
    """Histogram of block means before and after, with logarithmic bins."""
    counted = np.isfinite(before) & np.isfinite(after)
    means = [block_means(plane, counted, _HISTOGRAM_BLOCK_PX) for plane in (before, after)]
    positive = [values[values > 0] for values in means]
    if min(values.size for values in positive) == 0:
        axes.set_axis_off()
        return
    low = min(float(np.percentile(values, 0.01)) for values in positive)
    bins = np.geomspace(low, max(float(values.max()) for values in positive) * 1.01, 121)
    for values, name, colour in zip(positive, ("before", "after"), (_BEFORE, _AFTER), strict=True):
        axes.hist(values, bins=list(bins), histtype="step", color=colour, linewidth=1.6, label=name)
        for level in np.percentile(values, [1, 99]):
            axes.axvline(level, color=colour, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set(
        xscale="log",
        yscale="log",
        xlabel=f"Mean of {_HISTOGRAM_BLOCK_PX} x {_HISTOGRAM_BLOCK_PX} px ({unit})",
    )
    axes.set_title("Blocks by brightness; dashed: percentiles 1, 99", fontsize=11, color=INK, loc="left")
    axes.tick_params(labelsize=8.5)
    axes.legend(frameon=False, loc="upper left")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _figures(changes: Changes) -> str:
    """The line of text below the panels, for blocks of 4 px and the brightest and darkest 1 % of them."""
    parts = [
        f"{row.kind} {row.tail_pct:g} % of {row.block_px} px blocks: {row.sum_pct:+.0f} %, up to {row.up_to_pct:+.0f} %"
        for row in changes.structures
        if (row.block_px, row.tail_pct) == (4, 1.0)
    ]
    parts += [
        f"dynamic range (percentile 99 / percentile 1): {_number(row.dynamic_before)} -> {_number(row.dynamic_after)}"
        for row in changes.ranges
        if (row.block_px, row.tail_pct) == (4, 1.0)
    ]
    parts.append(f"artefact score {changes.artefacts.score:.2f} (inspect from 1)")
    return "     ".join(parts)


def _number(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.1f}"


def _largest(plane: Plane) -> float:
    """99.5th percentile of the finite absolute values, or 0."""
    finite = np.abs(plane[np.isfinite(plane)])
    return float(np.percentile(finite, 99.5)) if finite.size else 0.0


@dataclass(frozen=True, eq=False)
class Treated:
    """One deconvolved image.

    Attributes
    ----------
    taken
        Date of the observation.
    changes
        The measured changes, as `Changes.as_json` gives them.
    before, after
        Thumbnails [y, x] of the image before and after deconvolution.
    suspected
        Positions [y, x] of the thumbnail pixels with suspected artefacts, shape (n, 2).
    """

    name: str
    taken: str | None
    psf: str
    changes: Mapping[str, Any]
    steps_done: int
    stopped_because: str
    before: Plane
    after: Plane
    suspected: NDArray[np.intp]

    @property
    def score(self) -> float:
        """Artefact score; a score below 1 means that nothing was found."""
        return float(self.changes["artefacts"]["score"])

    def structure(self, kind: str) -> dict[str, float] | None:
        """Change of the bright or dark blocks: sum_pct and up_to_pct of `Structure`; None if there are no such
        blocks.
        """
        for row in self.changes["structures"]:
            if (row["kind"], row["block_px"], row["tail_pct"]) == (kind, BLOCK_PX, TAIL_PCT):
                return {"sum_pct": row["sum_pct"], "up_to_pct": row["up_to_pct"]}
        return None

    def as_json(self) -> dict[str, object]:
        """One row of the table, as JSON values."""
        return {
            "file": self.name,
            "taken": self.taken,
            "psf": self.psf,
            "score": self.score,
            "flux_change_pct": self.changes["flux_change_pct"],
            "bright": self.structure("bright"),
            "dark": self.structure("dark"),
            "steps_done": self.steps_done,
            "stopped_because": self.stopped_because,
            "effects": self.changes,
        }


@dataclass(frozen=True)
class Failure:
    """An image that could not be deconvolved, and the reason."""

    name: str
    code: str
    reason: str


def changes_in_product(
    name: str, before: str | Path, product: str | Path, details: Mapping[str, Any], limits: FitsLimits
) -> Treated:
    """Make the row of one image.

    Raises the errors of ``read_observation``.

    Parameters
    ----------
    before, product
        The FITS files of the image and of its product.
    details
        The details of the product, with "changes", "steps_done" and "stopped_because".
    """
    image, after = read_observation(before, limits), read_observation(product, limits)
    suspected = (read_planes(product)["QUALITY"] & QualityBit.ARTEFACT) > 0
    step = max(1, -(-max(image.pixels.shape) // THUMBNAIL_PX))
    return Treated(
        name=name,
        taken=optional_text(image.header, *DATE_KEYS),
        psf=f"{optional_text(after.header, 'PSFNAME')} {optional_text(after.header, 'PSFVERS')}",
        changes=details["changes"],
        steps_done=details["steps_done"],
        stopped_because=details["stopped_because"],
        before=binned(image.pixels, step),
        after=binned(after.pixels, step),
        suspected=np.argwhere(_blocks_with_any(suspected, step)),
    )


def _blocks_with_any(flags: NDArray[np.bool_], step: int) -> NDArray[np.bool_]:
    """The blocks of step x step pixels [y, x] that contain a flag. The last blocks may be incomplete."""
    rows, columns = (np.arange(0, side, step) for side in flags.shape)
    return np.asarray(np.logical_or.reduceat(np.logical_or.reduceat(flags, rows, axis=0), columns, axis=1))


def treat_many(
    names: Sequence[str],
    one: Callable[[str], Treated],
    *,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> tuple[list[Treated], list[Failure]]:
    """Deconvolve many images. Returns the results, with the highest score first, and the failures in the order of
    `names`.

    one(name) reads and deconvolves one image. If it raises DataError or OSError, the image becomes a `Failure`, and the
    next image follows.
    """
    treated: list[Treated] = []
    failures: list[Failure] = []
    for done, name in enumerate(names):
        progress(done, len(names))
        try:
            treated.append(one(name))
        except DataError as error:
            failures.append(Failure(name, error.code, error.message))
        except OSError as error:
            failures.append(Failure(name, "unreadable-file", error.strerror or str(error)))
    progress(len(names), len(names))
    return sorted(treated, key=lambda row: -row.score), failures


def table(treated: Sequence[Treated], failures: Sequence[Failure]) -> dict[str, object]:
    """The results as JSON values: a summary, one row per image in the order of `treated`, and the failures."""
    return {
        "schema": "effects/1",
        "summary": _summary(treated, failures),
        "blocks": {"block_px": BLOCK_PX, "tail_pct": TAIL_PCT},
        "images": [row.as_json() for row in treated],
        "failures": [vars(failure) for failure in failures],
    }


def contact_sheet_png(
    treated: Sequence[Treated], failures: Sequence[Failure], path: str | Path, *, most: int = MOST_ON_SHEET
) -> None:
    """Draw the first `most` images (before, after and change) and a list of the failures into a PNG file."""
    shown = list(treated[:most])
    across = 1 if len(shown) < 4 else 2
    down = max(1, -(-len(shown) // across))
    width = across * (3 * _CELL_IN + 0.7) + 0.3
    foot = 0.35 + 0.2 * min(len(failures), 12)
    height = _TITLE_IN + down * (_CELL_IN + _TEXT_IN) + foot
    figure = Figure(figsize=(width, height), dpi=100, facecolor="white")
    figure.text(
        0.3 / width,
        1 - 0.3 / height,
        _heading(treated, shown),
        fontsize=12,
        color=INK,
        weight="bold",
        va="center",
    )
    legend = (
        f"Columns: before, after (same scale), change (blue -{CHANGE_LIMIT_PCT:g} %, red +{CHANGE_LIMIT_PCT:g} %). "
        "Circles: suspected artefacts"
    )
    figure.text(0.3 / width, 1 - 0.55 / height, legend, fontsize=9, color=INK, va="center")
    for index, row in enumerate(shown):
        down_at, across_at = divmod(index, across)
        left = 0.3 + across_at * (3 * _CELL_IN + 0.7)
        top = height - _TITLE_IN - down_at * (_CELL_IN + _TEXT_IN)
        _draw_row(figure, row, index + 1, left, top, (width, height))
    for line, text in enumerate(_failure_lines(failures)):
        figure.text(0.3 / width, (foot - 0.2 - 0.2 * line) / height, text, fontsize=9, color=_DOUBTFUL)
    write_png(figure, path, pil_kwargs={"compress_level": 6})


def _draw_row(
    figure: Figure, row: Treated, rank: int, left: float, top: float, size: tuple[float, float]
) -> None:
    width, height = size
    colour = _DOUBTFUL if row.score >= LOOK_FROM else _CLEAN
    heading = f"{rank}. score {row.score:.2f}   {_short(row.name)}"
    figure.text(left / width, (top - 0.16) / height, heading, fontsize=9.5, color=colour, weight="bold")
    figure.text(left / width, (top - 0.36) / height, _changes(row), fontsize=8.5, color=INK)
    stretch = square_root_stretch(row.before, row.after)
    change = change_pct(row.before, row.after)
    panels = (
        (row.before, GOLD, stretch),
        (row.after, GOLD, stretch),
        (change, CHANGE, Normalize(-CHANGE_LIMIT_PCT, CHANGE_LIMIT_PCT)),
    )
    for n, (plane, colours, norm) in enumerate(panels):
        place = (
            (left + n * (_CELL_IN + 0.06)) / width,
            (top - 0.44 - _CELL_IN) / height,
            _CELL_IN / width,
            _CELL_IN / height,
        )
        axes = figure.add_axes(place)
        axes.imshow(plane, origin="lower", cmap=colours, norm=norm, interpolation="nearest")
        axes.set_axis_off()
        if n == 2:
            y, x = row.suspected[:_MARKS].T
            axes.scatter(x, y, s=14, facecolors="none", edgecolors="#111111", linewidths=0.6)


def _heading(treated: Sequence[Treated], shown: Sequence[Treated]) -> str:
    doubtful = sum(row.score >= LOOK_FROM for row in treated)
    images = f"{len(treated)} image{'' if len(treated) == 1 else 's'}"
    part = "" if len(shown) == len(treated) else f" (shown: the {len(shown)} with the highest scores)"
    return f"{images} deconvolved{part}, sorted by artefact score; inspect {doubtful} (score {LOOK_FROM:g} or more)"


def _changes(row: Treated) -> str:
    parts = [] if row.taken is None else [row.taken]
    for kind in ("bright", "dark"):
        change = row.structure(kind)
        if change is not None:
            parts.append(f"{kind} {change['sum_pct']:+.0f} %, up to {change['up_to_pct']:+.0f} %")
    return "   ".join([*parts, f"flux {row.changes['flux_change_pct']:+.2f} %"])


def _failure_lines(failures: Sequence[Failure]) -> list[str]:
    if not failures:
        return []
    lines = [f"not deconvolved: {len(failures)}"]
    lines += [f"   {_short(failure.name)}: {failure.reason}"[:200] for failure in failures[:10]]
    return lines + ([f"   and {len(failures) - 10} more, listed in the table"] if len(failures) > 10 else [])


def _short(name: str) -> str:
    """A file's name without its folder; the middle of a long name is replaced by dots."""
    file = Path(name).name
    return file if len(file) <= _LETTERS else f"{file[: _LETTERS // 2 - 2]}...{file[-_LETTERS // 2 :]}"


def _summary(treated: Sequence[Treated], failures: Sequence[Failure]) -> dict[str, object]:
    """Summary of all images: the number of images that a person should inspect, and medians and extremes of the
    changes.
    """
    out: dict[str, object] = {
        "images": len(treated),
        "failures": len(failures),
        "to_look_at": sum(row.score >= LOOK_FROM for row in treated),
    }
    for kind in ("bright", "dark"):
        rows = [change for change in (row.structure(kind) for row in treated) if change is not None]
        if rows:
            ups = [change["up_to_pct"] for change in rows]
            out[kind] = {
                "median_sum_pct": float(np.median([change["sum_pct"] for change in rows])),
                "median_up_to_pct": float(np.median(ups)),
                "extreme_pct": max(ups) if kind == "bright" else min(ups),
            }
    return out
