"""A page needs no other file, escapes all texts, numbers its figures, and rounds values to their errors."""

from __future__ import annotations

import math
from io import BytesIO

import pytest
from matplotlib.figure import Figure as Drawing

from psfcore.drawing.page import (
    PLOT_DPI,
    Page,
    environment,
    named_texts,
    numeric_columns,
    render,
    size_of,
    with_error,
)
from psfcore.errors import DataError
from tests.html_page import check_stands_alone, read_page

MALICIOUS = '"><script>alert(1)</script><img src=x onerror=alert(2)>.fits'


def png(width_in: float = 3.0) -> bytes:
    out = BytesIO()
    Drawing(figsize=(width_in, 2)).savefig(out, dpi=PLOT_DPI)
    return out.getvalue()


# A page with all kinds of parts; the given name is in every place that takes a text.
PARTS = """
{% extends "drawing/page.html" %}
{% from "drawing/parts.html" import figure, provenance_values, section, table, value with context %}
{% block sections %}
{% call section(name) %}
<p>A paragraph of {{ name }}</p>
{% call figure(first, "alt " ~ name) %}
How to read
{{ name }}.
{% endcall %}
<dl>{{ value(name, name, name) }}</dl>
{% endcall %}
{% call section("Folded") %}
<details><summary>{{ name }}</summary>
{% call table(["file", "", "residual (%)"], [(name, "", "1.0 ± 0.2"), ("b", "c", "-3 to 4")]) -%}
Caption of {{ name }}.{% endcall %}
{% call figure(second, "second") %}Second, {{ name }}, to be read.{% endcall %}
</details>
{{ provenance_values({"file": {"name_of": name}, "none": none}) }}
{% endcall %}
{% endblock %}
"""


def page(name: str = "000.fits") -> Page:
    return render(
        environment().from_string(PARTS),
        title=f"Title {name}",
        lead=f"Lead {name}: 12.3 ± 0.4 %",
        footer=name,
        name=name,
        first=png(),
        second=png(2.0),
    )


def test_a_page_stands_alone_and_escapes_any_file_name() -> None:
    for name in ("000.fits", MALICIOUS, "' onload='alert(3)", "{{ 7 * 7 }}", "&amp;é日"):
        html = page(name).html
        check_stands_alone(html)
        tags = read_page(html)
        assert next(t for t in tags if t.name == "h1").text == f"Title {name}"
        assert name in [t.text for t in tags if t.name == "td"]
        assert next(t for t in tags if t.name == "img").attributes["alt"] == f"alt {name}"


def test_figures_and_tables_are_numbered_and_values_named_and_rounded() -> None:
    html = page().html
    tags = read_page(html)
    starts = [t.text.split(".")[0][:8].strip() for t in tags if t.name == "figcaption"]
    assert starts == ["Figure 1", "Table 1", "Figure 2"]
    cells = {t.text: t.attributes.get("class") for t in tags if t.name == "td"}
    numbers = {"1.0\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}0.2": "number", "-3 to 4": "number"}
    assert cells == {"000.fits": None, "b": None, "": None, "c": None, **numbers}
    heads = [(t.text, t.attributes.get("class")) for t in tags if t.name == "th"]
    assert heads == [("file", None), ("residual (%)", "number")], "a heading without text is an empty cell"
    assert (
        "How to read 000.fits." in html and next(t for t in tags if t.name == "dt").text == "000.fits000.fits"
    )
    assert "12.3\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}0.4\N{NO-BREAK SPACE}%" in html
    assert 'width="288" height="192"' in size_of(png(3.0)), "the size in which it was drawn"
    with pytest.raises(DataError, match="not-a-png"):
        size_of(b"GIF89a")
    with pytest.raises(DataError, match=r"uneven-table: expected 2 .*; got 3"):
        numeric_columns(["a", "b"], [["1", "2", "3"]])
    values = {"seed": 5, "libraries": {"num_py": "9.9"}, "started_from_psf": None}
    assert list(named_texts(values)) == [("seed", "5"), ("libraries: num py", "9.9")]


def test_the_texts_of_a_page_name_its_figures() -> None:
    made = page(MALICIOUS)
    first, folded = made.texts.pop("sections")
    assert made.texts == {
        "title": f"Title {MALICIOUS}",
        "lead": f"Lead {MALICIOUS}: 12.3 ± 0.4 %",
        "footer": MALICIOUS,
    }
    assert "<script>" not in first and first.count('src="figure:1"') == 1 and 'src="figure:2"' in folded
    assert made.figures == [png(), png(2.0)]
    for section in (first, folded):
        assert "".join(section.split('src="figure:')[0]) in made.html


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
