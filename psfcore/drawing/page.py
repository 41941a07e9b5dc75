"""One HTML page that holds all it needs: words, figures, tables and numbers with their errors.

It opens from a file, needs no script and asks for nothing over a network; pictures are inside. Every text is
escaped, also one that came with the data, as a file's name does.

    Page("Title", "What was found.", (Section("Figures", ("A paragraph.", Figure(png, "How to read it.", "What it shows"))),))
"""

from __future__ import annotations

import base64
import math
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from psfcore.errors import DataError

PNG_START = b"\x89PNG\r\n\x1a\n"
DASH = "\N{EN DASH}"
PLOT_DPI = 160  # of figures made for a page: sharp on a fine screen and on paper
CSS_DPI = 96  # a figure is shown as large as it was drawn: in inches of so many CSS pixels

_NUMBER = re.compile(r"[-+\N{MINUS SIGN}]?[\d.]+(e[-+]?\d+)?( ?%)?( (±|to) [-+]?[\d.]+(e[-+]?\d+)?)?")


@dataclass(frozen=True, eq=False)
class Figure:
    """A picture (PNG). caption: how to read it; alt: what it shows, for who cannot see it.

    Raises DataError "not-a-png".
    """

    kind: ClassVar[str] = "figure"
    png: bytes
    caption: str
    alt: str

    def __post_init__(self) -> None:
        if self.png[:8] != PNG_START or len(self.png) < 24:
            raise DataError("not-a-png", f"expected a figure as PNG; got {self.png[:8]!r}")

    @property
    def data_uri(self) -> str:
        """The picture as an address that holds it."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")

    @property
    def shown_width(self) -> int:
        """CSS pixels."""
        return self._size()[0]

    @property
    def shown_height(self) -> int:
        """CSS pixels."""
        return self._size()[1]

    def _size(self) -> tuple[int, int]:
        width, height = struct.unpack(">II", self.png[16:24])
        return round(width * CSS_DPI / PLOT_DPI), round(height * CSS_DPI / PLOT_DPI)


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of cells, written as they are given; columns of numbers stand to the right.

    Raises DataError "uneven-table" where a row is not as long as the header.
    """

    kind: ClassVar[str] = "table"
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise DataError(
                    "uneven-table",
                    f"expected {len(self.header)} cells a row; got {len(row)}: {list(row)[:3]}",
                )

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Which columns hold numbers alone, or nothing."""
        columns = zip(*self.rows, strict=True) if self.rows else [()] * len(self.header)
        return tuple(all(_is_number(cell) for cell in column) for column in columns)


@dataclass(frozen=True)
class Value:
    """A number with its standard error, or a text. sigma None: it has none, or it is not known."""

    name: str
    value: float | str
    sigma: float | None = None
    unit: str = ""
    meaning: str = ""

    @property
    def text(self) -> str:
        """As it is written: digits down to the second of the error's."""
        number = self.value if isinstance(self.value, str) else with_error(self.value, self.sigma)
        return f"{number} {self.unit}".rstrip()


@dataclass(frozen=True, eq=False)
class Values:
    """A list of names and values."""

    kind: ClassVar[str] = "values"
    values: Sequence[Value]


@dataclass(frozen=True, eq=False)
class Bullets:
    """A list of sentences."""

    kind: ClassVar[str] = "bullets"
    items: Sequence[str]


@dataclass(frozen=True, eq=False)
class Details:
    """What is long and folded away until it is asked for."""

    kind: ClassVar[str] = "details"
    summary: str
    parts: Sequence[Part]


Part = str | Figure | Table | Values | Bullets | Details  # a text is a paragraph


@dataclass(frozen=True, eq=False)
class Section:
    """A heading, and what stands below it."""

    title: str
    parts: Sequence[Part]


@dataclass(frozen=True, eq=False)
class Page:
    """A page. lead: the sentence that is read first."""

    title: str
    lead: str
    sections: Sequence[Section]
    footer: str = ""

    def html(self) -> str:
        """The page as HTML."""
        parts = [part for section in self.sections for part in _flat(section.parts)]
        numbers = _numbered(p for p in parts if isinstance(p, Figure))
        numbers |= _numbered(p for p in parts if isinstance(p, Table))
        return _template().render(page=self, numbers=numbers)


def with_error(value: float, sigma: float | None = None) -> str:
    """A number to the second digit of its error, "12.34 ± 0.56"; to five digits where it has none."""
    if not math.isfinite(value):
        return DASH
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return f"{value:.5g}"
    if abs(value) >= 1e6 or max(abs(value), sigma) < 1e-3:
        return f"{value:.3e} ± {sigma:.1e}"
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    rounded = round(value, digits) + 0.0  # no minus before a zero
    return f"{rounded:.{digits}f} ± {sigma:.{digits}f}"


def provenance_values(provenance: Mapping[str, Any]) -> Values:
    """What made a report: names and texts, a nested one's name with those that it lies in before it."""
    return Values([Value(name, text) for name, text in _told(provenance)])


def _told(provenance: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    for key, value in provenance.items():
        name = f"{before}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            yield from _told(value, f"{name}: ")
        elif value is not None:
            yield name, str(value)


def _is_number(cell: str) -> bool:
    return cell in ("", DASH) or _NUMBER.fullmatch(cell) is not None


def _flat(parts: Sequence[Part]) -> Iterator[Part]:
    """Parts in the order in which they are read, those folded away among them."""
    for part in parts:
        yield part
        if isinstance(part, Details):
            yield from _flat(part.parts)


def _numbered(parts: Iterable[Figure | Table]) -> dict[Figure | Table, int]:
    return {part: number for number, part in enumerate(parts, start=1)}


@cache
def _template() -> Template:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["unbroken"] = _unbroken
    return environment.get_template("page.html")


def _unbroken(text: str) -> str:
    """A text whose lines do not end between a number and its error or its percent sign."""
    space = "\N{NO-BREAK SPACE}"
    return text.replace(" ± ", f"{space}±{space}").replace(" %", f"{space}%")
