"""The page of a gap diagnosis: summary, verdict, figures, intervals, cautions and images, in one file without links."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from psfcore.drawing.numbers import with_error
from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.evidence.tree import FAMILIES
from psfcore.gap.report import plot as gap_plot
from psfcore.gap.report.page import gap_page, interval_words, order_of_axes
from psfcore.gap.report.plot import (
    cell_means,
    draw_effects,
    draw_map,
    draw_unocculted,
    field_png,
    gap_png,
    simulated_of,
)
from psfcore.gap.report.report import gap_report, label_words, percent_words, promise_words, unit_words
from psfcore.gap.verdict.limits import Alike
from tests.blank_figures import blank_figures
from tests.html_page import check_stands_alone, read_page
from tests.psfcore.gap.report.judged import GIVEN, HOLDS_FOR, LEVEL, judged
from tests.psfcore.gap.small_gaps import OFFSET_DN, found

MADE_BY = {"software_version": "1.2.3", "seed": 5, "libraries": {"numpy": "9.9"}, "started_from_psf": None}
EFFECT_COLUMNS = 7  # of the table of effects; the other tables that begin with an effect have fewer columns


def report_of(diagnosis: Diagnosis) -> dict[str, Any]:
    """The report as a job writes it and a reader gets it."""
    said = gap_report(diagnosis) | {"provenance": MADE_BY}
    back: dict[str, Any] = json.loads(json.dumps(said, allow_nan=False))
    return back


@cache
def html() -> str:
    """The page of the small diagnosis, with small figures, which are quicker to draw."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(gap_plot, "PLOT_DPI", 40)
        return gap_page(found(), report_of(found())).html


@pytest.fixture
def blank() -> Iterator[None]:
    """Figures without content, for tests of the texts."""
    with blank_figures():
        yield


def page_of(diagnosis: Diagnosis) -> str:
    return gap_page(diagnosis, report_of(diagnosis)).html


def texts(page: str, tag: str) -> list[str]:
    """The texts of all tags of this name, with plain spaces."""
    return [one.text.replace("\N{NO-BREAK SPACE}", " ") for one in read_page(page) if one.name == tag]


def text_of(page: str) -> str:
    (body,) = texts(page, "body")
    return body


def rows_of(page: str) -> list[list[str]]:
    """The cells of every row of every table."""
    rows: dict[int, list[str]] = {}
    for tag in read_page(page):
        if tag.name == "td":
            rows.setdefault(id(tag.within[-1]), []).append(tag.text.replace("\xa0", " "))
    return list(rows.values())


def pictures(page: str) -> list[str]:
    return [tag.attributes["alt"] for tag in read_page(page) if tag.name == "img"]


def values(page: str) -> dict[str, str]:
    """Names and values of the lists."""
    tags = read_page(page)
    smalls = {t.within[-1]: t.text for t in tags if t.name == "small"}
    names = [t.text.removesuffix(smalls.get(t, "")) for t in tags if t.name == "dt"]
    return dict(zip(names, texts(page, "dd"), strict=True))


def test_the_page_needs_no_other_file_and_shows_the_numbers_of_the_report() -> None:
    check_stands_alone(html())
    report, said = report_of(found()), values(html())
    (lead,) = (t.text for t in read_page(html()) if t.attributes.get("class") == "lead")
    assert lead.replace("\xa0", " ") == report["lines"][0]
    assert all(line in texts(html(), "p") for line in report["lines"][1:])
    assert said["verdict"] == "attributed" and said["named effects"] == "dark offset"
    gap = report["gap"]
    for name, key in (
        ("gap before the refit", "before_refit_pct"),
        ("gap, PSF refitted", "rms_pct"),
        ("gap with the told causes in the model", "after_pct"),
    ):
        assert said[name] == f"{interval_words(gap[key])} %"
    unseen = values(page_of(replace(found(), rms=replace(found().rms, value=0.04))))
    assert unseen.keys() == said.keys() - {"gap with the told causes in the model"}
    assert float(said["noise"].split()[0]) == pytest.approx(gap["noise_pct"], rel=0.05)
    names = [name.split()[0] for name in pictures(html())]
    assert names == ["Map", "Residuals", "Bars", "Map", "Bars", "Observed"]
    rows = rows_of(html())
    tested = {row[0]: row for row in rows if len(row) == EFFECT_COLUMNS}
    for effect in report["effects"]:
        row = tested[effect["words"]]
        assert row[1] == percent_words(effect["probability"])
        for name, p in effect["parameters"].items():
            assert f"{name} {with_error(p['value'], p['sigma'])}" in row[2]
        low, high = (round(100 * one) for one in effect["closure"]["ci90"])
        assert row[5] == f"{low + 0} to {high + 0}"
    assert ["saturation fill", "no pixel was filled in"] in rows
    limit = found().limits.effects["dark_offset"].leading
    shown = [f"{limit.found_90:.3g}", f"{limit.excluded_95:.3g}", limit.unit]
    assert ["dark offset", limit.name, *shown] in rows
    # The PSF before and with the answer.
    before, after = (report["psf"][name]["total"] for name in ("refitted", "with_answer"))
    (total,) = (row for row in rows if row[0] == "total")
    assert total[1:3] == [with_error(one["value"], one["sigma"]) for one in (before, after)]
    image = report["images"][3]
    (row,) = (row for row in rows if row[0] == image["file"] and len(row) > 8)
    assert row[7] == with_error(image["residual_pct"], image["noise_pct"])
    assert "ab" * 32 in {cell for row in rows for cell in row} and said["libraries: numpy"] == "9.9"


@pytest.mark.parametrize("kind", list(GIVEN))
def test_every_kind_of_answer_is_explained_on_its_page(kind: str, blank: None) -> None:
    given, diagnosis = GIVEN[kind], judged(kind)
    page, report = page_of(diagnosis), report_of(diagnosis)
    check_stands_alone(page)
    text, said, rows = text_of(page), values(page), rows_of(page)
    assert said["verdict"] == given.verdict and said["level"] == f"{100 * LEVEL:.0f} %"
    assert all(line in text for line in report["lines"])
    # Slices are shown only if an effect was added to the model, bars of closure only if there is a gap.
    assert not any(name.startswith("Observed") for name in pictures(page))
    assert ("Bars of held-out closure by effect" in pictures(page)) is (given.verdict != "none")
    assert ("The shape of the change" in pictures(page)) is (kind in ("map", "curve", "beside"))
    # The causes, the hypotheses, and for which data the coverage holds.
    for number, cause in enumerate(report["causes"], 1):
        for one in cause["alternatives"]:
            row = [str(number), one["words"], one["stage"], FAMILIES[one["family"]].words]
            assert [*row, percent_words(one["probability"])] in rows
    for labels, share in given.shares.items():
        told = " together with ".join(label_words(*label) for label in sorted(labels, key=str)) or "no cause"
        assert [told, percent_words(share)] in rows
    assert HOLDS_FOR in text and "19 simulated transits" in text
    assert said["probability of no cause"] == percent_words(given.shares.get((), 0.0))
    # The promise stands with what was measured with the effects of another author.
    assert promise_words(report["calibration"]) in text
    names = {"inconclusive": "most probable effects", "tie": "tied effects"}
    assert said[names.get(given.verdict, "named effects")] == (
        ", ".join(given.named).replace("_", " ") or "none"
    )


def test_what_has_no_picture_is_told_in_words(blank: None) -> None:
    assert "No two effects that would be found are closer than 3 sigma" in text_of(html())
    pair = Alike(("dark_offset", "core_blur"), 1.4, "a series of exposure times")
    page = page_of(replace(found(), limits=replace(found().limits, alike=(pair,))))
    assert ["dark offset and core blur", "1.40", "a series of exposure times"] in rows_of(page)
    assert "No two effects that" not in text_of(page)
    few = replace(judged("none"), residual=None)
    page = page_of(few)
    check_stands_alone(page)
    assert "No image could be held out" in text_of(page)
    assert len(pictures(page)) == 2
    for diagnosis in (few, found(), judged("map"), judged("curve")):
        assert gap_png(diagnosis, report_of(diagnosis)).startswith(b"\x89PNG")


def test_a_gap_of_the_unocculted_field_has_its_own_figure_and_numbers(blank: None) -> None:
    report = report_of(found())
    assert {"unocculted", "unocculted_after"} <= set(report["images"][0])
    assert not any("unocculted" in name for name in pictures(gap_page(found(), report).html))
    report["unocculted"] = {"residual": 4.02, "residual_after": 1.1, "noise_pct": 0.2, "shows_the_gap": True}
    page = gap_page(found(), report).html
    check_stands_alone(page)
    assert pictures(page)[0] == "Residuals of the unocculted field of every image against time"
    said = values(page)
    assert said["unocculted field"] == "4.0 times the noise"
    assert said["unocculted field with the told causes"] == "1.1 times the noise"
    assert "gap with the told causes in the model" not in said and "both maps show noise" in text_of(page)
    for image in report["images"]:
        image |= {"unocculted": 5.0, "unocculted_after": 1.0}
    axes = Figure().subplots()
    draw_unocculted(axes, report)
    drawn = [line.get_ydata() for line in axes.lines[1:]]
    assert {float(value) for line in drawn[::2] for value in line} == {5.0}
    assert {float(value) for line in drawn[1::2] for value in line} == {1.0}


def test_the_order_of_the_axes_is_explained_if_the_first_is_not_the_largest() -> None:
    axes = [{"share": 0.2, "of_best": False}, {"share": 0.3, "of_best": False}]
    assert "p-value of at most 0.05 come before" in order_of_axes({"where": axes})
    axes[0]["of_best"] = True
    assert "the told cause varies along it" in order_of_axes({"where": axes})
    assert order_of_axes({"where": axes[::-1]}) == order_of_axes({"where": axes[:1]}) == ""


def test_a_malicious_file_name_is_shown_as_text(blank: None) -> None:
    report = report_of(found())
    name = "<script>alert(1)</script>.fits"
    report["images"][0]["file"] = name
    report["cautions"] = [name]
    report["provenance"] = {"file": name}
    page = gap_page(found(), report).html
    check_stands_alone(page)
    assert texts(page, "td").count(name) == 1


def test_the_map_shows_every_disc_at_its_place_and_bars_show_closure() -> None:
    report, figure = report_of(found()), Figure()
    draw_map(figure, report)
    charts = figure.axes[:2]
    for axes, column in zip(charts, ("residual_pct", "residual_after_pct"), strict=True):
        drawn = {
            (round(float(x), 3), round(float(y), 3)): float(value)
            for points in axes.collections
            for (x, y), value in zip(points.get_offsets(), points.get_array(), strict=True)
        }
        discs = {(round(i["x_px"], 3), round(i["y_px"], 3)): i[column] for i in report["images"]}
        assert drawn == pytest.approx(discs)
    assert charts[0].collections[0].get_clim() == charts[1].collections[0].get_clim()
    report = report_of(found())
    report["effects"][1]["closure"] = {"value": -4.0, "ci90": [-9.0, 0.5]}
    axes = Figure().subplots()
    draw_effects(axes, report)
    widths = [bar.get_width() for bar in axes.patches]
    assert widths[0] == pytest.approx(report["effects"][0]["closure"]["value"])
    assert widths[1] == pytest.approx(axes.get_xlim()[0])
    assert "-4.0" in [text.get_text() for text in axes.texts]
    assert "<" in [line.get_marker() for line in axes.lines]
    assert axes.get_yticklabels()[0].get_text() == "dark offset  (named)"
    for kind in ("map", "curve"):
        assert field_png(report_of(judged(kind))).startswith(b"\x89PNG")


def test_cells_show_means_of_all_discs() -> None:
    discs = found().evidence.discs
    means, errors = cell_means(discs)
    middle = [
        -100 * d.residual[int(np.argmin(d.radius))] / d.observed for d in discs if d.radius.min() < 0.38
    ]
    assert means[0] == pytest.approx(np.mean(middle))
    assert 0 < errors[0] < np.nanmax(errors)
    assert np.isfinite(means).sum() >= 9


def test_a_simulated_image_with_the_answer_contains_the_effect() -> None:
    """It is the refitted PSF's image plus the change by the effect, comparable with the unchanged observed image."""
    diagnosis = found()
    n = diagnosis.evidence.discs[0].index
    frame, dark = diagnosis.solution.transit.frames[n], diagnosis.solution.sky.dark[n]
    assert diagnosis.corrected is not None
    added = diagnosis.corrected.solution
    np.testing.assert_allclose(simulated_of(diagnosis, n)[dark], diagnosis.solution.residual(n)[1], rtol=1e-5)
    offset = frame.pixels - added.transit.frames[n].pixels
    assert offset[dark].mean() == pytest.approx(OFFSET_DN / frame.exposure_s, rel=0.15)
    dark = added.sky.dark[n]
    answered = simulated_of(diagnosis, n, with_answer=True)[dark]
    np.testing.assert_allclose(answered, added.residual(n)[1] + offset[dark], rtol=1e-4)


def test_units_and_intervals_are_written_for_people() -> None:
    units = {"px2": "px²", "/field2": "/field²", "DN/s/field": "DN/s/field", "": ""}
    assert {unit: unit_words(unit) for unit in units} == units
    assert interval_words({"value": 5.06, "ci90": [4.44, 5.91]}) == "5.1 (4.4 to 5.9)"
    assert interval_words({"value": -0.01, "ci90": [-0.04, 0.0]}) == "0.0 (0.0 to 0.0)"
