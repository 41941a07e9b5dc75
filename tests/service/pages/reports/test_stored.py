"""Stored pages of reports: their sections without style, their figures as files, and nothing that is not known."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from psfcore.drawing.page import Bullets, Details, Figure, Page, Section, Table, Value, Values
from service.pages.reports.stored import read_stored
from tests.html_page import read_page


def png(grey: int) -> bytes:
    """An image of one pixel."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0)
    pixels = zlib.compress(bytes([0, grey]))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def test_the_sections_of_a_page_are_kept_with_their_text_tables_and_figures(tmp_path: Path) -> None:
    sections = (
        Section("First & best", ("A <b>bold</b> claim.", Figure(png(1), "How to read it.", "a dot"))),
        Section("Second", (Values([Value("width", 2.0, 0.1, "px", "of the core")]), Bullets(["one", "two"]))),
        Section(
            "Third", (Details("All", (Table(["", "n"], [["a", "1"]], "Numbers."), Figure(png(2), "c", "d"))),)
        ),
        Section("Fourth", ("The end.",)),
    )
    path = tmp_path / "page.html"
    path.write_text(Page("A title <1>", "The lead & more.", sections, "the foot").html(), "utf-8")
    found = read_stored(path, "/reports/x/figures")
    assert (found.title, found.lead) == ("A title <1>", "The lead & more.")
    assert [one.title for one in found.sections] == ["First & best", "Second", "Third", "Fourth"]
    assert found.footer == "the foot"
    assert found.figures == (png(1), png(2))
    first, second, third, fourth = (one.markup for one in found.sections)
    assert "A &lt;b&gt;bold&lt;/b&gt; claim." in first and 'src="/reports/x/figures/1"' in first
    assert 'alt="a dot"' in first and "<figcaption><b>Figure 1.</b> How to read it.</figcaption>" in first
    assert "<dd>2.00\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}0.10 px</dd>" in second and "<li>two</li>" in second
    assert "<small>of the core</small>" in second
    assert "<summary>All</summary>" in third and 'src="/reports/x/figures/2"' in third
    assert '<th scope="col"></th>' not in third and '<td class="number">1</td>' in third
    assert fourth.strip() == "<p>The end.</p>"
    whole = "".join(f"<section>{one.markup}</section>" for one in found.sections)
    read_page(whole)  # every tag is closed in the right order
    assert "data:" not in whole and "style" not in whole


def test_markup_that_a_report_does_not_have_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    path.write_text(
        '<header><h1>T</h1><p class="lead">L</p></header><section id="s1"><h2>S</h2><script>alert(1)</script>'
        '<p onclick="x()" style="color:red">Text <a href="javascript:x()">link</a> &lt;img&gt;</p>'
        '<img src="https://elsewhere/x.png" alt="x"><img src="data:image/png;base64,***"><iframe src="/"></iframe></section>'
    )
    [section] = read_stored(path, "/f").sections
    assert section.markup == "<p>Text link &lt;img&gt;</p>"
