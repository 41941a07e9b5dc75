"""Reads the stored HTML page of a report, so that the same sections are shown inside the pages of the service.

The stored page is self-contained: it includes its style, and its figures as data. A page of the service may contain
neither inline styles nor data addresses. Therefore this module takes the sections without the style, and the figures
as separate files. The module keeps the tags and attributes of a short list. Other markup is removed, but its text is
kept.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from html.parser import HTMLParser
from pathlib import Path

from markupsafe import Markup, escape

# Tags that are kept, with the attributes that are kept of each.
KEPT = {
    "p": (),
    "ul": (),
    "ol": (),
    "li": (),
    "b": (),
    "small": (),
    "figure": (),
    "figcaption": (),
    "table": (),
    "thead": (),
    "tbody": (),
    "tr": (),
    "th": ("scope",),
    "td": (),
    "dl": (),
    "dt": (),
    "dd": (),
    "details": (),
    "summary": (),
}
HIDDEN = {"style", "script", "title"}  # the text inside these tags is not for readers
PICTURE = "data:image/png;base64,"
OPEN_TABLE = Markup('<div class="scroll" tabindex="0" role="region" aria-label="Table {}"><table>')
EMPTY_HEAD = '<th scope="col"></th>'  # a heading without text; screen readers would report it as an error
MOST_KEPT = 4  # pages that stay in memory, with their figures


@dataclass(frozen=True)
class Section:
    """A section of a stored page. markup: the content below its heading."""

    title: str
    markup: Markup


@dataclass(frozen=True)
class StoredPage:
    """A stored page. lead: the sentence at the top. figures: PNG files in reading order. footer: software and method."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    figures: tuple[bytes, ...]
    footer: str


@dataclass
class _Part:
    title: list[str] = field(default_factory=list)
    markup: list[str] = field(default_factory=list)


@lru_cache(maxsize=MOST_KEPT)
def read_stored(path: Path, figures_at: str) -> StoredPage:
    """The stored page of a report. Raises OSError.

    figures_at: the beginning of the addresses of the figures; "/" and the number of the figure follow.

    A file of the store never changes, so its content can be kept in memory.
    """
    reader = _Reader(lambda number: f"{figures_at}/{number}")
    reader.feed(path.read_text("utf-8"))
    reader.close()
    return StoredPage(
        title="".join(reader.title).strip(),
        lead="".join(reader.lead).strip(),
        sections=tuple(
            Section("".join(one.title).strip(), Markup("".join(one.markup).replace(EMPTY_HEAD, "<td></td>")))
            for one in reader.sections
        ),
        figures=tuple(reader.figures),
        footer="".join(reader.footer).strip(),
    )


class _Reader(HTMLParser):
    """Collects title, lead, sections and figures of a page that ``psfcore.drawing.page`` made."""

    def __init__(self, address: Callable[[int], str]) -> None:
        super().__init__()
        self.title: list[str] = []
        self.lead: list[str] = []
        self.footer: list[str] = []
        self.sections: list[_Part] = []
        self.figures: list[bytes] = []
        self._address = address
        self._tables = 0
        self._text: list[str] | None = None  # where text goes; None: the page does not show it
        self._hidden = 0
        self._inside = False  # whether a section is open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self._hidden += tag in HIDDEN
        if tag == "h1":
            self._text = self.title
        elif tag == "footer":
            self._text = self.footer
        elif tag == "p" and given.get("class") == "lead" and not self.sections:
            self._text = self.lead
        elif tag == "section":
            self.sections.append(_Part())
            self._inside, self._text = True, None
        elif self._inside:
            self._start_in_section(tag, given)

    def _start_in_section(self, tag: str, given: dict[str, str]) -> None:
        if tag == "h2":
            self._text = self.sections[-1].title
        elif tag == "img":
            self._add(self._picture(given))
        elif tag in KEPT:
            self._text = self.sections[-1].markup
            self._add(self._opened(tag, given))

    def handle_endtag(self, tag: str) -> None:
        if tag in HIDDEN:
            self._hidden -= 1
        elif tag == "section":
            self._inside, self._text = False, None
        elif not self._inside:
            self._text = self._text if tag == "p" and self._text is self.footer else None
        elif tag == "h2":
            self._text = self.sections[-1].markup
        elif tag in KEPT and self._text is not None:
            self._add(Markup("</table></div>") if tag == "table" else Markup("</{}>").format(tag))

    def handle_data(self, data: str) -> None:
        if self._text is not None and not self._hidden:
            self._text.append(str(escape(data)) if self._in_markup() else data)

    def _in_markup(self) -> bool:
        return self._inside and self._text is self.sections[-1].markup

    def _add(self, markup: Markup) -> None:
        self.sections[-1].markup.append(str(markup))

    def _opened(self, tag: str, given: dict[str, str]) -> Markup:
        if tag == "table":
            self._tables += 1
            return OPEN_TABLE.format(self._tables)
        if tag == "dl":
            return Markup('<dl class="facts values">')
        kept = {name: given[name] for name in KEPT[tag] if name in given}
        if given.get("class") == "n" and tag in ("th", "td"):
            kept["class"] = "number"
        return Markup("<{}{}>").format(
            tag, Markup("").join(Markup(' {}="{}"').format(name, value) for name, value in kept.items())
        )

    def _picture(self, given: dict[str, str]) -> Markup:
        """An `<img>` element with the address of a figure of the page. Empty if the stored page does not contain the
        image data."""
        source = given.get("src", "")
        if not source.startswith(PICTURE):
            return Markup("")
        try:
            png = base64.b64decode(source.removeprefix(PICTURE), validate=True)
        except binascii.Error:
            return Markup("")
        self.figures.append(png)
        size = {name: given[name] for name in ("width", "height") if given.get(name, "").isdecimal()}
        sizes = Markup("").join(Markup(' {}="{}"').format(name, value) for name, value in size.items())
        return Markup('<img class="picture" src="{}" alt="{}" loading="lazy"{}>').format(
            self._address(len(self.figures)), given.get("alt", ""), sizes
        )
