"""The documentation site is built without warnings, and its pages load nothing from another host."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest

HERE = Path(__file__).parents[2]
LOADING = {"data", "href", "poster", "src", "srcset"}


class _Loaded(HTMLParser):
    """What a browser loads with a page: all addresses except those of the links that a reader follows."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag != "a":
            self.found += [value for name, value in attrs if name in LOADING and value]
        self.found += [one for name, value in attrs if name == "style" for one in _addresses(value or "")]


def _addresses(css: str) -> Iterator[str]:
    yield from (one.strip("'\" ") for one in re.findall(r"url\(([^)]*)\)", css))
    yield from re.findall(r"@import\s+[\"']([^\"']+)", css)


@pytest.mark.slow
def test_the_site_is_built_without_warnings_and_loads_nothing_from_another_host(tmp_path: Path) -> None:
    built = shutil.ignore_patterns("_build", "_gallery")
    shutil.copytree(HERE / "docs", tmp_path / "docs", ignore=built)
    for name in ("CHANGELOG.md", "CONTRIBUTING.md"):
        shutil.copy(HERE / name, tmp_path)
    site = tmp_path / "site"
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    made = subprocess.run([*command, "docs", site], cwd=tmp_path, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    pages, styles = sorted(site.rglob("*.html")), sorted(site.rglob("*.css"))
    assert len(pages) > 25 and styles
    loaded = {(page.name, one) for page in pages for one in _Loaded(page.read_text("utf-8")).found}
    loaded |= {(style.name, one) for style in styles for one in _addresses(style.read_text("utf-8"))}
    assert len(loaded) > len(pages), "at least the style sheet of each page"
    assert {one for one in loaded if re.search(r"(^|[\s,])([a-z]+:)?//", one[1])} == set()
    assert not [page.name for page in pages if "@import" in page.read_text("utf-8")]
