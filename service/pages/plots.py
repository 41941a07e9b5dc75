"""Curves of a page. A page shows a plot as a table; a script draws the curves from the numbers in this table.

Therefore a page holds each number once, and shows the same numbers with and without scripts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Literal

DIGITS = 5
FINE_TO_PX = 10.0  # up to this radius a table shows every radius
RATIO = 1.05  # farther out: the least ratio of two successive radii

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
