"""An HTML page of a report in one file, drawn from a template.

A browser can open the page without a network: the page has no script, loads nothing, and contains its figures.
Every text is escaped, including texts from the data, such as the name of a file.

A template extends ``drawing/page.html``, sets ``title``, ``lead`` and ``footer``, and fills the block ``sections`` with
the macros of ``drawing/parts.html``. Names of templates are paths below the folder of psfcore.
"""

from __future__ import annotations

import base64
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup, escape

from psfcore.drawing.numbers import DASH, with_error
from psfcore.errors import DataError

PNG_START = b"\x89PNG\r\n\x1a\n"
PLOT_DPI = 160  # resolution of the figures on a page: sharp on screens of high resolution and on paper
CSS_DPI = 96  # CSS pixels per inch: a figure is shown at the size (in inches) at which it was drawn

_NUMBER = re.compile(r"[-+\N{MINUS SIGN}]?[\d.]+(e[-+]?\d+)?( ?%)?( (±|to) [-+]?[\d.]+(e[-+]?\d+)?)?")
_SPACES = re.compile(r"[ \n]+")
_FIGURE = re.compile(r'(?<=src=")figure:(\d+)')


@dataclass(frozen=True)
class Page:
    """A page.

    Attributes
    ----------
    html
        The whole page in one file.
    figures
        The figures as PNG, in reading order, from N = 1.
    texts
        The texts for other pages that show the same: the title, the lead and the footer as text, and the sections as
        HTML, in which ``figure:N`` is the address of the figure N.
    """

    html: str
    texts: dict[str, object]
    figures: list[bytes]


def render(template: str | Template, **values: object) -> Page:
    """The page that a template draws from these values. Figures, tables and sections are numbered in reading order.

    Raises DataError "not-a-png" for a figure that is no PNG, and "uneven-table" for a row of another length than the
    header of its table.
    """
    sections: list[list[str]] = []  # the templates add a title and a content for each section
    figures: list[bytes] = []

    html = (
        environment()
        .get_template(template)
        .render(values, sections=sections, figures=figures, next_table=count(1).__next__)
    )
    texts = {name: values.get(name, "") for name in ("title", "lead", "footer")}
    texts["sections"] = [content for _, content in sections]

    def inside(found: re.Match[str]) -> str:
        return f"data:image/png;base64,{base64.b64encode(figures[int(found[1]) - 1]).decode('ascii')}"

    return Page(_FIGURE.sub(inside, html), texts, figures)


def named_texts(values: Mapping[str, object], before: str = "") -> Iterator[tuple[str, str]]:
    """Nested values as names and texts. A nested name is preceded by the names of the levels above."""
    for key, value in values.items():
        name = f"{before}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            yield from named_texts(value, f"{name}: ")
        elif value is not None:
            yield name, str(value)


def numeric_columns(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[bool]:
    """For each column of a table, whether all its cells are numbers or empty. Raises DataError "uneven-table"."""
    for row in rows:
        if len(row) != len(header):
            raise DataError(
                "uneven-table",
                f"expected {len(header)} cells in each row; got {len(row)}: {list(row)[:3]}",
            )
    return [all(_is_number(row[place]) for row in rows) for place in range(len(header))]


def _is_number(cell: str) -> bool:
    return cell in ("", DASH) or _NUMBER.fullmatch(cell) is not None


def size_of(png: bytes) -> Markup:
    """The attributes width and height of a figure (PNG). Raises DataError "not-a-png"."""
    if png[:8] != PNG_START or len(png) < 24:
        raise DataError("not-a-png", f"expected a figure as PNG; got data that begin with {png[:8]!r}")
    width, height = (round(side * CSS_DPI / PLOT_DPI) for side in struct.unpack(">II", png[16:24]))
    return Markup('width="{}" height="{}"').format(width, height)


def prose(text: str) -> Markup:
    """The text in one line, with no line break between a number and its error or its percent sign."""
    space = "\N{NO-BREAK SPACE}"
    line = _SPACES.sub(" ", str(escape(text))).strip()
    return Markup(line.replace(" ± ", f"{space}±{space}").replace(" %", f"{space}%"))  # noqa: S704  # escaped above


@cache
def environment() -> Environment:
    """The templates of pages."""
    made = Environment(
        loader=FileSystemLoader(Path(__file__).parents[1]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"prose": prose, "size_of": size_of, "with_error": with_error}
    made.globals |= {"named_texts": named_texts, "numeric_columns": numeric_columns, "DASH": DASH}
    return made
