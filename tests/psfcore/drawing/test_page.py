"""A page needs no other file, escapes all texts, numbers its figures, and rounds values to their errors."""

from __future__ import annotations

import math
import shutil
import subprocess
from io import BytesIO
from pathlib import Path

import pytest
from matplotlib.figure import Figure as Drawing

from psfcore.drawing.page import (
    PLOT_DPI,
    Bullets,
    Details,
    Figure,
    Page,
    Section,
    Table,
    Value,
    Values,
    with_error,
)
from psfcore.errors import DataError
from tests.html_page import check_stands_alone, read_page

MALICIOUS = '"><script>alert(1)</script><img src=x onerror=alert(2)>.fits'


def png(width_in: float = 3.0) -> bytes:
    out = BytesIO()
    Drawing(figsize=(width_in, 2)).savefig(out, dpi=PLOT_DPI)
    return out.getvalue()


def page(name: str = "000.fits") -> Page:
    """A page with all kinds of parts; the given name is in every place that takes a text."""
    table = Table(("file", "residual (%)"), ((name, "1.0 ± 0.2"), ("b", "-3 to 4")), f"Caption of {name}.")
    figure = Figure(png(), f"How to read {name}.", f"alt {name}")
    values = Values((Value(name, 0.12345, 0.0023, "px", name), Value("name", name)))
    return Page(
        f"Title {name}",
        f"Lead {name}: 12.3 ± 0.4 %",
        (
            Section(name, (f"A paragraph of {name}", figure, values)),
            Section("Folded", (Details(name, (table, figure_of(name))), Bullets((name,)))),
        ),
        footer=name,
    )


def figure_of(name: str) -> Figure:
    return Figure(png(2.0), f"Second, {name}, to be read.", "second")


def test_a_page_stands_alone_and_escapes_any_file_name() -> None:
    for name in ("000.fits", MALICIOUS, "' onload='alert(3)", "{{ 7 * 7 }}", "&amp;é日"):
        html = page(name).html()
        check_stands_alone(html)
        tags = read_page(html)
        assert next(t for t in tags if t.name == "h1").text == f"Title {name}"
        assert next(t for t in tags if t.name == "td").text == name
        assert next(t for t in tags if t.name == "img").attributes["alt"] == f"alt {name}"


def test_figures_and_tables_are_numbered_and_numbers_stay_on_one_line_with_their_error() -> None:
    html = page().html()
    tags = read_page(html)
    starts = [t.text.split(".")[0][:8].strip() for t in tags if t.name == "figcaption"]
    assert starts == ["Figure 1", "Table 1", "Figure 2"]
    cells = {t.text: t.attributes.get("class") for t in tags if t.name == "td"}
    assert cells == {"000.fits": None, "b": None, "1.0 ± 0.2": "n", "-3 to 4": "n"}
    assert "12.3\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}0.4\N{NO-BREAK SPACE}%" in html
    figure = Figure(png(3.0), "c", "a")
    assert (figure.shown_width, figure.shown_height) == (288, 192), "the size in which it was drawn"


def test_a_value_is_rounded_to_the_second_digit_of_its_error() -> None:
    for value, sigma, text in (
        (12.3456, 0.564, "12.35 ± 0.56"),
        (0.42834, 0.00851, "0.4283 ± 0.0085"),
        (-51.0, 12.0, "-51 ± 12"),
        (1234.5, 200.0, "1234 ± 200"),
        (-0.03, 7.0, "0.0 ± 7.0"),
        (3.2e-7, 1.1e-8, "3.200e-07 ± 1.1e-08"),
        (1.0, None, "1"),
        (2.5, 0.0, "2.5"),
        (2.5, math.nan, "2.5"),
        (math.nan, 0.1, "\N{EN DASH}"),
    ):
        assert with_error(value, sigma) == text


def test_bad_figures_and_tables_are_refused() -> None:
    with pytest.raises(DataError, match="not-a-png"):
        Figure(b"GIF89a", "c", "a")
    with pytest.raises(DataError, match=r"uneven-table: expected 2 .*; got 3"):
        Table(("a", "b"), (("1", "2", "3"),), "c")


def test_a_browser_opens_the_page_from_a_file_without_console_messages(tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium on this machine to open the page with")
    (tmp_path / "page.html").write_text(page(MALICIOUS).html(), "utf-8")
    picture = tmp_path / "page.png"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0"]
    files = [f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={picture}"]
    where = [*files, f"file://{tmp_path}/page.html"]
    done = subprocess.run([browser, *options, *where], capture_output=True, text=True, timeout=120)
    assert picture.read_bytes().startswith(b"\x89PNG"), done.stderr[-500:]
    assert "CONSOLE" not in done.stderr
