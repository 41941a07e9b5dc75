"""Curves of a page, and the numbers of stored JSON reports as curves and tables.

A page shows a plot as a table; a script draws the curves from the numbers in this table. Therefore a page holds each number
once, and shows the same numbers with and without scripts. This is the only module of the pages that knows the fields of the
reports:

| schema | what is read |
|---|---|
| psf-fit | parameters, free shells, the residual of each image |
| cross-validation | bands of the parameters |
| gap | the discs: position, time, residual without and with the named effects |
| rerun | the arrays that were compared, and what made each of the two results |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite, sqrt
from typing import Any, Literal

DIGITS = 5
FINE_TO_PX = 10.0  # up to this radius a table shows every radius
RATIO = 1.05  # farther out: the least ratio of two successive radii
MAP_PX = 400  # edge length of the map of discs in the units of its picture
DISC_PX = 9
NOT_COMPARED = ("id", "created_at")  # these always differ, or are always the same
# The ends of the scale of residuals; the middle is grey, so that it is seen on light and dark pages.
BELOW, MIDDLE, ABOVE = (33, 102, 172), (190, 190, 190), (178, 24, 43)

Report = Mapping[str, Any]
Row = tuple[str, ...]
Numbers = Sequence[float | None]
Draw = Literal["line", "points"]


@dataclass(frozen=True)
class Series:
    """A curve or points. low, high: ends of the band or of the error bars (both or neither); an entry None: no band at
    this x."""

    label: str
    values: Numbers
    low: Numbers | None = None
    high: Numbers | None = None
    draw: Draw = "line"


@dataclass(frozen=True)
class Plot:
    """Curves over one quantity. x: ascending for lines, in any order for points. names: names of the rows of the table."""

    title: str
    x_label: str
    y_label: str
    x: Sequence[float]
    series: Sequence[Series]
    x_log: bool = False
    y_log: bool = False
    names: Sequence[str] | None = None

    @property
    def columns(self) -> list[tuple[str, str, str, Numbers]]:
        """The columns of the table after x: heading, label of the series, role (line, points, low, high), numbers."""
        found: list[tuple[str, str, str, Numbers]] = []
        for one in self.series:
            found.append((one.label, one.label, one.draw, one.values))
            if one.low is not None and one.high is not None:
                found.append((f"{one.label}, low", one.label, "low", one.low))
                found.append((f"{one.label}, high", one.label, "high", one.high))
        return found

    @property
    def rows(self) -> list[tuple[str | None, list[str]]]:
        """The rows of the table: the name or None, and the numbers as text, x first."""
        columns = [self.x, *(numbers for _, _, _, numbers in self.columns)]
        names: Sequence[str | None] = self.names if self.names is not None else [None] * len(self.x)
        return [
            (name, [written(number) for number in row]) for name, *row in zip(names, *columns, strict=True)
        ]


def written(value: float | None) -> str:
    """A number as the table shows it; empty if the number is None or not finite."""
    return "" if value is None or not isfinite(value) else f"{value:.{DIGITS}g}"


def with_errors(
    label: str,
    values: Numbers,
    sigma: Numbers | None,
    places: Sequence[int] | None = None,
    *,
    draw: Draw = "line",
) -> Series:
    """A series with a band, or bars, of one standard error. sigma: None if there are no errors; an entry None: none there.

    places: the indices of the shown values; default: all.
    """
    chosen = range(len(values)) if places is None else places
    shown = [values[at] for at in chosen]
    if sigma is None:
        return Series(label, shown, draw=draw)
    errors = [sigma[at] for at in chosen]

    def ends(sign: int) -> Numbers:
        pairs = zip(shown, errors, strict=True)
        return [None if value is None or error is None else value + sign * error for value, error in pairs]

    return Series(label, shown, ends(-1), ends(1), draw)


def radial_plot(
    title: str, y_label: str, radii: Sequence[float], series: Sequence[Series], *, y_log: bool = True
) -> Plot:
    """Curves over the radius, on a logarithmic axis."""
    return Plot(title, "radius (px)", y_label, radii, series, x_log=True, y_log=y_log)


def shown_radii(radii: Sequence[float]) -> list[int]:
    """The indices of the radii that a table shows: all radii near the centre; farther out, radii in ratios of at least
    ``RATIO``."""
    chosen: list[int] = []
    for place, radius in enumerate(radii):
        if not chosen or radius <= FINE_TO_PX or radius >= radii[chosen[-1]] * RATIO:
            chosen.append(place)
    if chosen and chosen[-1] != len(radii) - 1:
        chosen.append(len(radii) - 1)
    return chosen


def light_beyond_plot(radii: Sequence[float], curves: Mapping[str, tuple[Numbers, Numbers | None]]) -> Plot:
    """1 - encircled energy of components or PSFs, in percent. curves: by label, the percentages and their errors."""
    places = shown_radii(radii)
    series = [with_errors(label, pct, sigma, places) for label, (pct, sigma) in curves.items()]
    shown = [radii[at] for at in places]
    return radial_plot("Light beyond a radius", "1 - encircled energy (%)", shown, series)


# --- a fit ------------------------------------------------------------------------------------------------


def fit_parameters(fit: Report) -> list[Row]:
    """The parameters of a fit: name, value, standard error, unit, meaning."""
    return [
        (name, f"{found['value']:.5g}", f"{found['sigma']:.2g}", found["unit"], found["meaning"])
        for name, found in fit["parameters"].items()
    ]


def fit_plots(fit: Report) -> list[Plot]:
    """The free shells of a fit if they were fitted, and the residual of each image."""
    return [*_free_shells(fit), _fit_residuals(fit)]


def _free_shells(fit: Report) -> list[Plot]:
    free = fit.get("free_shells")
    if free is None:
        return []
    weight = free["weight"]
    shells = Series("free shells", weight["median"], weight["minus_1_sigma"], weight["plus_1_sigma"])
    # The geometric middles of shells; half of the outer edge for a shell from the centre.
    middles = [sqrt(low * high) if low > 0 else high / 2 for low, high in pairwise(free["edges_px"])]
    return [radial_plot("Weight of the scatter without a formula", "weight of a pixel", middles, [shells])]


def _fit_residuals(fit: Report) -> Plot:
    frames = fit["frames"]
    residuals = [frame["residual_pct"] for frame in frames]
    errors = [100 * frame["noise_dn_s"] / frame["observed_dn_s"] for frame in frames]
    return Plot(
        "Residual of each image",
        "number of the image",
        "simulated minus observed (%)",
        list(range(len(frames))),
        [with_errors("residual", residuals, errors, draw="points")],
        names=[_image_name(frame) for frame in frames],
    )


# --- a cross-validation -----------------------------------------------------------------------------------


def band_parameters(report: Report) -> list[Row]:
    """The parameters over all folds: name, median, and the limits of one and of two standard deviations."""
    return [
        (
            name,
            f"{limits['median']:.4g}",
            f"{limits['minus_1_sigma']:.4g} to {limits['plus_1_sigma']:.4g}",
            f"{limits['minus_2_sigma']:.4g} to {limits['plus_2_sigma']:.4g}",
        )
        for name, limits in report["parameters"].items()
    ]


# --- a gap ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Disc:
    """A disc on the map. x, y: position in the picture, y = 0 at the top. row: its row in the tables of the plots."""

    row: int
    x: float
    y: float
    radius: float
    colour: str
    name: str
    told: str


@dataclass(frozen=True)
class GapMap:
    """The discs of a gap report on the detector, and their residuals against time.

    width, height: size of the picture. largest: the residual at the ends of the colour scale, percent.
    """

    width: float
    height: float
    discs: Sequence[Disc]
    residuals: Plot
    largest: float


def gap_map(report: Report) -> GapMap | None:
    """The map of a gap report with its residuals; None if no image could be held out, so that there are no residuals."""
    images = sorted(
        (image for image in report["images"] if image["residual_pct"] is not None),
        key=lambda image: image["time_s"],
    )
    if not images:
        return None
    ny, nx = report["shape"]
    scale = MAP_PX / max(ny, nx)
    largest = max(abs(image["residual_pct"]) for image in images) or 1.0
    discs = [
        Disc(
            row,
            image["x_px"] * scale,
            (ny - image["y_px"]) * scale,
            DISC_PX,
            _colour(image["residual_pct"] / largest),
            _image_name(image),
            f"{_image_name(image)}: {image['residual_pct']:+.2f} ± {image['noise_pct']:.2f} %",
        )
        for row, image in enumerate(images)
    ]
    return GapMap(nx * scale, ny * scale, discs, _gap_residuals(images), largest)


def _gap_residuals(images: Sequence[Report]) -> Plot:
    series = [_gap_series("fitted model", images, "residual_pct", "noise_pct")]
    if any(image["residual_after_pct"] is not None for image in images):
        series.append(_gap_series("with the named effects", images, "residual_after_pct", "noise_after_pct"))
    return Plot(
        "Residuals of the held-out discs against time",
        "time after the first image (s)",
        "simulated minus observed (%)",
        [image["time_s"] for image in images],
        series,
        names=[_image_name(image) for image in images],
    )


def _gap_series(label: str, images: Sequence[Report], of: str, error: str) -> Series:
    values, errors = ([image[name] for image in images] for name in (of, error))
    return with_errors(label, values, errors, draw="points")


def _colour(part: float) -> str:
    """The colour of a residual. part: the residual divided by the largest one, -1 to 1."""
    end = ABOVE if part > 0 else BELOW
    mixed = (round(m + abs(part) * (e - m)) for m, e in zip(MIDDLE, end, strict=True))
    return "#" + "".join(f"{value:02x}" for value in mixed)


# --- a rerun ----------------------------------------------------------------------------------------------


def rerun_arrays(report: Report) -> list[Row]:
    """The arrays that a rerun compared: name, whether equal, and the largest difference as a part of the largest value."""
    return [
        (name, "equal" if found["same"] else "different", _figure(found["largest_relative"]))
        for name, found in report["arrays"].items()
    ]


def rerun_makers(report: Report) -> list[Row]:
    """The properties that were different when the two results were made: name, first value, new value."""
    first, again = (_flat(report[name]) for name in ("first", "again"))
    names = [*first, *(name for name in again if name not in first)]
    rows = [(name, first.get(name, "-"), again.get(name, "-")) for name in names if name not in NOT_COMPARED]
    return [row for row in rows if row[1] != row[2]]


def _flat(made: Report) -> dict[str, str]:
    libraries = made.get("libraries") or {}
    own = {name: str(value) for name, value in made.items() if name != "libraries" and value is not None}
    return own | {f"library {name}": str(version) for name, version in libraries.items()}


# --- all --------------------------------------------------------------------------------------------------


def _image_name(image: Report) -> str:
    return f"{image['file']}, pointing {image['fov']}"


def _figure(value: float | None) -> str:
    return "-" if value is None or not isfinite(value) else f"{value:.3g}"
