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
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup, escape

from psfcore.drawing.numbers import DASH, with_error
from psfcore.errors import DataError

PNG_START = b"\x89PNG\r\n\x1a\n"
PLOT_DPI = 160  # resolution of the figures on a page: sharp on screens of high resolution and on paper
CSS_DPI = 96  # CSS pixels per inch: a figure is shown at the size (in inches) at which it was drawn

_NUMBER = re.compile(r"[-+\N{MINUS SIGN}]?[\d.]+(e[-+]?\d+)?( ?%)?( (±|to) [-+]?[\d.]+(e[-+]?\d+)?)?")
_SPACES = re.compile(r"[ \n]+")


def render(template: str | Template, **values: Any) -> str:
    """The page that a template draws from these values. Figures, tables and sections are numbered in reading order.

    Raises DataError "not-a-png" for a figure that is no PNG, and "uneven-table" for a row of another length than the
    header of its table.
    """
    sections: list[str] = []

    def begin_section(title: str) -> int:
        sections.append(title)
        return len(sections)

    return (
        environment()
        .get_template(template)
        .render(
            values,
            sections=sections,
            begin_section=begin_section,
            next_figure=count(1).__next__,
            next_table=count(1).__next__,
        )
    )


def named_texts(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
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


def source_and_size(png: bytes) -> Markup:
    """The attributes src, width and height of a figure (PNG). Raises DataError "not-a-png"."""
    if png[:8] != PNG_START or len(png) < 24:
        raise DataError("not-a-png", f"expected a figure as PNG; got data that begin with {png[:8]!r}")
    width, height = (round(side * CSS_DPI / PLOT_DPI) for side in struct.unpack(">II", png[16:24]))
    data = base64.b64encode(png).decode("ascii")
    return Markup('src="data:image/png;base64,{}" width="{}" height="{}"').format(data, width, height)


def prose(text: str) -> Markup:
    """The text in one line, with no line break between a number and its error or its percent sign."""
    space = "\N{NO-BREAK SPACE}"
    line = _SPACES.sub(" ", str(escape(text))).strip()
    return Markup(line.replace(" ± ", f"{space}±{space}").replace(" %", f"{space}%"))


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
    made.filters |= {"prose": prose, "source_and_size": source_and_size, "with_error": with_error}
    made.globals |= {"named_texts": named_texts, "numeric_columns": numeric_columns, "DASH": DASH}
    return made
