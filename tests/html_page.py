"""Reads an HTML page for tests: its tags and texts, and whether it needs anything from elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from html.parser import HTMLParser

VOID = {"meta", "link", "img", "br", "hr", "input"}
LOADING = ("src", "href", "srcset", "action", "data", "poster")  # attributes that can load another file


@dataclass(eq=False)
class Tag:
    """A tag, the tags around it, and the text inside it."""

    name: str
    attributes: dict[str, str]
    within: tuple[Tag, ...]
    words: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """All text inside it."""
        return "".join(self.words).strip()


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[Tag] = []
        self.open: list[Tag] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        made = Tag(tag, {name: value or "" for name, value in attrs}, tuple(self.open))
        self.tags.append(made)
        if tag not in VOID:
            self.open.append(made)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1].name == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        for tag in self.open:
            tag.words.append(data)


def read_page(html: str) -> list[Tag]:
    """The tags of a page in order; fails if a tag is not closed, or closed in the wrong order."""
    reader = _Reader()
    reader.feed(html)
    reader.close()
    assert reader.open == []
    return reader.tags


def check_stands_alone(html: str) -> None:
    """Check that the page loads nothing, runs no script, and describes every figure in words."""
    tags = read_page(html)
    assert html.lstrip().lower().startswith("<!doctype html>")
    assert next(t for t in tags if t.name == "html").attributes["lang"] == "en"
    assert any(t.attributes.get("name") == "viewport" for t in tags if t.name == "meta")
    assert not [t for t in tags if t.name in ("script", "iframe", "object", "embed", "base", "form")]
    assert any(t.attributes.get("rel") == "icon" for t in tags if t.name == "link")
    for tag in tags:
        assert not [name for name in tag.attributes if name.startswith("on")], tag.name
        for name in LOADING:
            assert tag.attributes.get(name, "#").startswith(("data:image/", "#")), tag.attributes[name][:80]
    assert "@import" not in html and "url(" not in html
    for image in (t for t in tags if t.name == "img"):
        assert image.attributes["alt"].strip()
        figure = next(t for t in reversed(image.within) if t.name == "figure")
        captions = [t for t in tags if t.name == "figcaption" and figure in t.within]
        assert len(captions) == 1 and len(captions[0].text) > 10
