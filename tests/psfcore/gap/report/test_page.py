"""The page of a gap diagnosis: summary, verdict, figures, intervals, cautions and images, in one file without links."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from psfcore.drawing.page import with_error
from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.report import bars
from psfcore.gap.report import plot as gap_plot
from psfcore.gap.report.bars import draw_effects
from psfcore.gap.report.page import gap_page, interval_words, unit_words
from psfcore.gap.report.plot import cell_means, draw_cells, draw_map, gap_png, simulated_of
from psfcore.gap.report.report import gap_report, hypothesis_words, percent_words
from psfcore.gap.verdict.limits import Alike
from psfcore.gap.verdict.posterior import UNKNOWN
from tests.blank_figures import blank_figures
from tests.html_page import Tag, check_stands_alone, read_page
from tests.psfcore.gap.report.judged import (
    HOLDS_FOR,
    LEAST,
    OFFSET_BLUR,
    OFFSET_GAIN,
    SHARES,
    judged,
    with_shares,
)
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
    return gap_page(found(), report_of(found())).html()


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small figures, which are quicker to draw."""
    monkeypatch.setattr(gap_plot, "PLOT_DPI", 40)


@pytest.fixture
def blank() -> Iterator[None]:
    """Figures without content, for tests of the texts."""
    with blank_figures():
        yield


def text_of(page: str) -> str:
    body = next(tag for tag in read_page(page) if tag.name == "body")
    return body.text.replace("\N{NO-BREAK SPACE}", " ")


def rows_of(page: str) -> list[list[str]]:
    """The cells of every row of every table."""
    rows: dict[int, list[str]] = {}
    for tag in read_page(page):
        if tag.name == "td":
            rows.setdefault(id(tag.within[-1]), []).append(tag.text.replace("\xa0", " "))
    return list(rows.values())


def pictures(tags: list[Tag]) -> list[str]:
    return [tag.attributes["alt"] for tag in tags if tag.name == "img"]


def values(tags: list[Tag]) -> dict[str, str]:
    """Names and values of the lists."""
    smalls = {t.within[-1]: t.text for t in tags if t.name == "small"}
    names = [t.text.removesuffix(smalls.get(t, "")) for t in tags if t.name == "dt"]
    return dict(zip(names, (t.text.replace("\xa0", " ") for t in tags if t.name == "dd"), strict=True))


def test_the_page_needs_no_other_file_and_begins_with_the_summary() -> None:
    check_stands_alone(html())
    tags = read_page(html())
    lead = next(t for t in tags if t.attributes.get("class") == "lead")
    assert lead.text.replace("\xa0", " ") == report_of(found())["sentence"]
    assert len(html()) < 1.5e6  # small enough for an e-mail


def test_verdict_gap_and_noise_are_at_the_top() -> None:
    gap, said = report_of(found())["gap"], values(read_page(html()))
    assert said["verdict"] == "attributed" and said["named effects"] == "dark offset"
    assert said["gap before the refit"] == f"{interval_words(gap['before_refit_pct'])} %"
    assert said["gap, PSF refitted"] == f"{interval_words(gap['rms_pct'])} %"
    assert said["gap with the named effects in the model"] == f"{interval_words(gap['after_pct'])} %"
    assert float(said["noise"].split()[0]) == pytest.approx(gap["noise_pct"], rel=0.05)
    assert "To confirm the named effects, take a dark exposure" in text_of(html())


def test_the_page_has_all_figures_and_one_picture_combines_them() -> None:
    names = pictures(read_page(html()))
    assert [name.split()[0] for name in names] == ["Map", "Residuals", "Bars", "Map", "Bars", "Observed"]
    assert gap_png(found(), report_of(found())).startswith(b"\x89PNG")


def test_the_tables_list_all_effects_with_closure_and_those_not_tested() -> None:
    rows = rows_of(html())
    tested = {row[0]: row for row in rows if len(row) == EFFECT_COLUMNS}
    for effect in report_of(found())["effects"]:
        row = tested[effect["name"].replace("_", " ")]
        assert row[1] == percent_words(effect["probability"])
        for name, p in effect["parameters"].items():
            assert f"{name} {with_error(p['value'], p['sigma'])}" in row[2]
        low, high = (round(100 * one) for one in effect["closure"]["ci90"])
        assert row[5] == f"{low + 0} to {high + 0}"
    assert ["saturation fill", "no pixel was filled in"] in rows


def test_the_psf_is_shown_before_and_with_the_answer() -> None:
    cells = [t.text.replace("\xa0", " ") for t in read_page(html()) if t.name == "td"]
    at = cells.index("total")
    psf = report_of(found())["psf"]
    assert cells[at + 1] == with_error(*(psf["refitted"]["total"][k] for k in ("value", "sigma")))
    assert cells[at + 2] == with_error(*(psf["with_answer"]["total"][k] for k in ("value", "sigma")))
    moved = psf["with_answer"]["total"]["value"] - psf["refitted"]["total"]["value"]
    assert float(cells[at + 3]) == pytest.approx(moved / psf["refitted"]["total"]["sigma"], abs=0.06)


def test_images_inputs_and_provenance_are_listed() -> None:
    cells = [t.text.replace("\xa0", " ") for t in read_page(html()) if t.name == "td"]
    for image in report_of(found())["images"]:
        at = cells.index(image["file"])
        assert cells[at + 7] == with_error(image["residual_pct"], image["noise_pct"])
        assert cells[at + 8] == with_error(image["residual_after_pct"], image["noise_after_pct"])
    assert {"ab" * 32, "cd" * 32} <= set(cells)
    said = values(read_page(html()))
    assert said["libraries: numpy"] == "9.9" and said["seed"] == "5"
    assert text_of(html()).rstrip().endswith("heliopsf 1.2.3")


@pytest.mark.parametrize(
    ("verdict", "told"),
    [
        (
            "none",
            "Most probably there is no gap. An effect that is in the answer set or in the table may still act",
        ),
        ("attributed", "To confirm the named effects, take a dark exposure"),
        ("unknown", "No effect of the library, alone or together with others, is in the answer set"),
        ("inconclusive", "These data do not decide between the hypotheses of the answer set"),
        ("tie", "Tied: dark offset or gain mismatch."),
    ],
)
def test_every_verdict_is_explained_on_its_page(verdict: str, told: str, blank: None) -> None:
    diagnosis = judged(verdict)
    page = gap_page(diagnosis, report_of(diagnosis)).html()
    check_stands_alone(page)
    text, answered = text_of(page), verdict in ("attributed", "tie")
    assert told in text and values(read_page(page))["verdict"] == verdict
    assert ("No effect was added to the model" in text) is not answered
    # Slices are shown only if an effect was added to the model.
    assert any(name.startswith("Observed") for name in pictures(read_page(page))) is answered
    # Bars of closure are shown only if there is a gap.
    assert ("Bars of held-out closure by effect" in pictures(read_page(page))) is (verdict != "none")
    assert ("To separate the tied effects, take a dark exposure" in text) is (verdict == "tie")
    assert ("with the named effects” means with the best of the tied effects: dark offset" in text) is (
        verdict == "tie"
    )
    unknown = UNKNOWN in diagnosis.judgement.members
    assert ("If the cause is not in the library: the patterns that the gap resembles" in text) is unknown
    assert ("a change that varies with the position along detector x and the pointing" in text) is unknown


@pytest.mark.parametrize("verdict", list(SHARES))
def test_the_page_shows_the_hypotheses_and_for_which_data_the_coverage_holds(
    verdict: str, blank: None
) -> None:
    diagnosis = judged(verdict)
    page = gap_page(diagnosis, report_of(diagnosis)).html()
    text = text_of(page)
    assert HOLDS_FOR in text and "19 simulated transits of known cause" in text
    assert "the stated coverage is not guaranteed" in text
    rows = rows_of(page)
    for names, share in SHARES[verdict].items():
        assert [hypothesis_words(names), percent_words(share), "yes" if share >= LEAST else ""] in rows
    said = values(read_page(page))
    assert said["answer set"] == "; ".join(map(hypothesis_words, diagnosis.judgement.members))
    assert said["probability of no gap"] == percent_words(SHARES[verdict][()])
    assert "in 90 % of the cases" in text
    name = "most probable effects" if verdict == "inconclusive" else "named effects"
    assert said[name] == (", ".join(diagnosis.judgement.answer).replace("_", " ") or "none")


def test_the_page_shows_what_the_data_could_have_shown_and_what_they_cannot_tell_apart(blank: None) -> None:
    rows = rows_of(html())
    for limit in found().limits.effects.values():
        one = limit.leading
        shown = [f"{one.found_90:.3g}", f"{one.excluded_95:.3g}", one.unit]
        assert [limit.effect.replace("_", " "), one.name, *shown] in rows
    assert "No two effects are closer than 3 sigma" in text_of(html())
    pair = Alike(("dark_offset", "core_blur"), 1.4, "a series of exposure times")
    close = replace(found(), limits=replace(found().limits, alike=(pair,)))
    page = gap_page(close, report_of(close)).html()
    assert ["dark offset and core blur", "1.40", "a series of exposure times"] in rows_of(page)
    assert "No two effects are closer" not in text_of(page)


def test_a_tie_names_the_certain_and_the_tied_effects(coarse: None) -> None:
    both = with_shares({OFFSET_BLUR: 0.5, OFFSET_GAIN: 0.45, UNKNOWN: 0.03, (): 0.02})
    report = report_of(both)
    assert report["ties"] == [["core_blur", "gain_mismatch"]]
    assert "Tied: dark offset, together with core blur or gain mismatch." in text_of(
        gap_page(both, report).html()
    )
    rows = [
        {"name": name}
        for name in ("dark_offset", "core_blur", "dark_offset + core_blur", "dark_offset + persistence")
    ]
    assert [bars._chosen(row, report) for row in rows] == [False, False, True, False]


def test_a_tie_of_an_effect_and_a_pair_with_it_marks_both(coarse: None) -> None:
    report = report_of(with_shares({("dark_offset",): 0.4, OFFSET_BLUR: 0.55, UNKNOWN: 0.03, (): 0.02}))
    assert report["verdict"] == "tie"
    rows = [{"name": name} for name in ("dark_offset", "core_blur", "dark_offset + core_blur")]
    assert [bars._chosen(row, report) for row in rows] == [True, False, True]


def test_effects_of_a_pair_come_before_single_effects(blank: None) -> None:
    both = with_shares({OFFSET_BLUR: 0.93, UNKNOWN: 0.04, (): 0.03})
    report = report_of(both)
    (label,) = (fit["name"] for fit in report["together"])
    effects = [row[0] for row in rows_of(gap_page(both, report).html()) if len(row) == EFFECT_COLUMNS]
    at = [effects.index(name.replace("_", " ")) for name in (label, "dark_offset", "gain_mismatch")]
    assert at == sorted(at)


def test_without_held_out_images_the_page_shows_no_residuals(coarse: None) -> None:
    few = replace(judged("none"), residual=None)
    page = gap_page(few, report_of(few)).html()
    check_stands_alone(page)
    assert "No image could be held out" in text_of(page)
    assert len(pictures(read_page(page))) == 2
    assert gap_png(few, report_of(few)).startswith(b"\x89PNG")


def test_a_malicious_file_name_is_shown_as_text(coarse: None) -> None:
    report = report_of(found())
    name = "<script>alert(1)</script>.fits"
    report["images"][0]["file"] = name
    report["cautions"] = [name]
    report["provenance"] = {"file": name}
    page = gap_page(found(), report).html()
    check_stands_alone(page)
    assert [t.text for t in read_page(page) if t.name == "td"].count(name) == 1


def test_the_map_shows_every_disc_at_its_place() -> None:
    from matplotlib.figure import Figure

    report = report_of(found())
    figure = Figure()
    charts = figure.subplots(1, 2)
    draw_map(figure, list(charts), report)
    for axes, column in zip(charts, ("residual_pct", "residual_after_pct"), strict=True):
        drawn = {
            (round(float(x), 3), round(float(y), 3)): float(value)
            for points in axes.collections
            for (x, y), value in zip(points.get_offsets(), points.get_array(), strict=True)
        }
        wanted = {(round(i["x_px"], 3), round(i["y_px"], 3)): i[column] for i in report["images"]}
        assert drawn == pytest.approx(wanted)
    assert charts[0].collections[0].get_clim() == charts[1].collections[0].get_clim()


def test_bars_show_closure_and_mark_values_outside_the_chart() -> None:
    from matplotlib.figure import Figure

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


def test_cells_show_means_of_all_discs_and_noise_has_no_strong_colour() -> None:
    from matplotlib.figure import Figure

    discs = found().evidence.discs
    means, errors = cell_means(discs)
    middle = [
        -100 * d.residual[int(np.argmin(d.radius))] / d.observed for d in discs if d.radius.min() < 0.38
    ]
    assert means[0] == pytest.approx(np.mean(middle))
    assert 0 < errors[0] < np.nanmax(errors)
    assert np.isfinite(means).sum() >= 9
    quiet = [
        replace(d, residual=0.3 * np.sqrt(np.diag(d.covariance)) / np.sqrt(len(discs)) * (-1) ** k)
        for k, d in enumerate(discs)
    ]
    figure = Figure()
    silent = replace(
        judged("none"),
        model=replace(found().model, evidence=replace(found().evidence, discs=tuple(quiet))),
    )
    axes = figure.subplots()
    draw_cells(figure, [axes], silent)
    colours = np.array([patch.get_facecolor()[:3] for patch in axes.patches[:-1]])
    assert colours.min() > 0.75  # near white


def test_a_simulated_image_with_the_answer_contains_the_effect() -> None:
    """It is the refitted PSF's image plus the change by the effect, comparable with the unchanged observed image."""
    diagnosis = found()
    n = diagnosis.evidence.discs[0].index
    frame, dark = diagnosis.solution.transit.frames[n], diagnosis.solution.sky.dark[n]
    added = diagnosis.corrected[0].solution
    np.testing.assert_allclose(simulated_of(diagnosis, n)[dark], diagnosis.solution.residual(n)[1], rtol=1e-5)
    offset = frame.pixels - added.transit.frames[n].pixels
    assert offset[dark].mean() == pytest.approx(OFFSET_DN / frame.exposure_s, rel=0.15)
    dark = added.sky.dark[n]
    answered = simulated_of(diagnosis, n, with_answer=True)[dark]
    np.testing.assert_allclose(answered, added.residual(n)[1] + offset[dark], rtol=1e-4)


def test_units_and_intervals_are_written_for_people() -> None:
    assert [unit_words(u) for u in ("px2", "/field2", "DN/s/field", "")] == [
        "px²",
        "/field²",
        "DN/s/field",
        "",
    ]
    assert interval_words({"value": 5.06, "ci90": [4.44, 5.91]}) == "5.1 (4.4 to 5.9)"
    assert interval_words({"value": -0.01, "ci90": [-0.04, 0.0]}) == "0.0 (0.0 to 0.0)"
