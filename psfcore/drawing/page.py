"""An HTML page in one file, with text, figures, tables, and numbers with their errors.

A browser can open the page without a network: the page has no script, loads nothing, and contains its figures.
Every text is escaped, including texts from the data, such as the name of a file.

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
PLOT_DPI = 160  # resolution of the figures on a page: sharp on screens of high resolution and on paper
CSS_DPI = 96  # CSS pixels per inch: a figure is shown at the size (in inches) at which it was drawn

_NUMBER = re.compile(r"[-+\N{MINUS SIGN}]?[\d.]+(e[-+]?\d+)?( ?%)?( (±|to) [-+]?[\d.]+(e[-+]?\d+)?)?")


@dataclass(frozen=True, eq=False)
class Figure:
    """A figure (PNG). caption: how to read the figure. alt: a description for readers who cannot see it.

    Raises DataError "not-a-png".
    """

    kind: ClassVar[str] = "figure"
    png: bytes
    caption: str
    alt: str

    def __post_init__(self) -> None:
        if self.png[:8] != PNG_START or len(self.png) < 24:
            raise DataError(
                "not-a-png", f"expected a figure as PNG; got data that begin with {self.png[:8]!r}"
            )

    @property
    def data_uri(self) -> str:
        """The figure as a data URI."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")

    @property
    def shown_width(self) -> int:
        """Width in CSS pixels."""
        return self._size()[0]

    @property
    def shown_height(self) -> int:
        """Height in CSS pixels."""
        return self._size()[1]

    def _size(self) -> tuple[int, int]:
        width, height = struct.unpack(">II", self.png[16:24])
        return round(width * CSS_DPI / PLOT_DPI), round(height * CSS_DPI / PLOT_DPI)


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of cells. The texts of the cells are not changed; columns of numbers are right-aligned.

    Raises DataError "uneven-table" if a row does not have the length of the header.
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
                    f"expected {len(self.header)} cells in each row; got {len(row)}: {list(row)[:3]}",
                )

    @property
    def numeric(self) -> tuple[bool, ...]:
        """For each column, whether all its cells are numbers or empty."""
        columns = zip(*self.rows, strict=True) if self.rows else [()] * len(self.header)
        return tuple(all(_is_number(cell) for cell in column) for column in columns)


@dataclass(frozen=True)
class Value:
    """A number with its standard error, or a text. sigma: None if the error is unknown or the value has no error."""

    name: str
    value: float | str
    sigma: float | None = None
    unit: str = ""
    meaning: str = ""

    @property
    def text(self) -> str:
        """The number with its error and unit, rounded to the second digit of the error."""
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
    """A part that is collapsed until the reader opens it."""

    kind: ClassVar[str] = "details"
    summary: str
    parts: Sequence[Part]


Part = str | Figure | Table | Values | Bullets | Details  # a str is a paragraph


@dataclass(frozen=True, eq=False)
class Section:
    """A heading and the parts below it."""

    title: str
    parts: Sequence[Part]


@dataclass(frozen=True, eq=False)
class Page:
    """A page. lead: the sentence that the reader meets first."""

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
    """A number rounded to the second digit of its error, "12.34 ± 0.56". Without an error it is rounded to five digits."""
    if not math.isfinite(value):
        return DASH
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return f"{value:.5g}"
    if abs(value) >= 1e6 or max(abs(value), sigma) < 1e-3:
        return f"{value:.3e} ± {sigma:.1e}"
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    rounded = round(value, digits) + 0.0  # + 0.0 turns -0.0 into 0.0
    return f"{rounded:.{digits}f} ± {sigma:.{digits}f}"


def provenance_values(provenance: Mapping[str, Any]) -> Values:
    """The provenance of a report as names and texts. A nested name is preceded by the names of the levels above."""
    return Values([Value(name, text) for name, text in _named_texts(provenance)])


def _named_texts(provenance: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    for key, value in provenance.items():
        name = f"{before}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            yield from _named_texts(value, f"{name}: ")
        elif value is not None:
            yield name, str(value)


def _is_number(cell: str) -> bool:
    return cell in ("", DASH) or _NUMBER.fullmatch(cell) is not None


def _flat(parts: Sequence[Part]) -> Iterator[Part]:
    """All parts in reading order, including those inside Details."""
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
    """The text, with no line break between a number and its error or its percent sign."""
    space = "\N{NO-BREAK SPACE}"
    return text.replace(" ± ", f"{space}±{space}").replace(" %", f"{space}%")
