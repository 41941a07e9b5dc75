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
from psfcore.gap.diagnose import Diagnosis, Shrinking
from psfcore.gap.report import bars
from psfcore.gap.report import plot as gap_plot
from psfcore.gap.report.bars import draw_effects
from psfcore.gap.report.page import gap_page, interval_words, unit_words
from psfcore.gap.report.plot import cell_means, draw_cells, draw_map, gap_png, simulated_of
from psfcore.gap.report.report import gap_report
from psfcore.gap.verdict.judge import fitted
from tests.blank_figures import blank_figures
from tests.html_page import Tag, check_stands_alone, read_page
from tests.psfcore.gap.small_gaps import OFFSET_DN, found

MADE_BY = {"software_version": "1.2.3", "seed": 5, "libraries": {"numpy": "9.9"}, "started_from_psf": None}


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


def judged(verdict: Any, *answer: str) -> Diagnosis:
    """The same numbers with another verdict."""
    changed = replace(found().judgement, verdict=verdict, answer=answer)
    if verdict == "tie":
        return replace(found(), judgement=changed)
    return replace(found(), judgement=changed, corrected=(), residual_after=None)


def text_of(page: str) -> str:
    body = next(tag for tag in read_page(page) if tag.name == "body")
    return body.text.replace("\N{NO-BREAK SPACE}", " ")


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
    cells = [t.text.replace("\xa0", " ") for t in read_page(html()) if t.name == "td"]
    for effect in report_of(found())["effects"]:
        row = cells.index(effect["name"].replace("_", " "))
        for name, p in effect["parameters"].items():
            assert f"{name} {with_error(p['value'], p['sigma'])}" in cells[row + 1]
        low, high = (round(100 * one) for one in effect["closure"]["ci90"])
        assert cells[row + 5] == f"{low + 0} to {high + 0}"
    assert cells[cells.index("saturation fill") + 1] == "no pixel was filled in"


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
    ("verdict", "answer", "told"),
    [
        ("none", (), "There is no gap, so no effect is needed"),
        ("unknown", (), "No effect and no pair of effects explains the gap"),
        ("inconclusive", (), "changes with the assumed floor"),
        ("tie", ("dark_offset", "gain_mismatch"), "Tied: dark offset or gain mismatch."),
    ],
)
def test_every_verdict_is_explained_on_its_page(
    verdict: str, answer: tuple[str, ...], told: str, blank: None
) -> None:
    diagnosis = judged(verdict, *answer)
    page = gap_page(diagnosis, report_of(diagnosis)).html()
    check_stands_alone(page)
    text = text_of(page)
    assert told in text and values(read_page(page))["verdict"] == verdict
    assert ("No effect was added to the model" in text) is (verdict != "tie")
    # Slices are shown only if an effect was added to the model.
    assert any(name.startswith("Observed") for name in pictures(read_page(page))) is (verdict == "tie")
    # Bars of closure are shown only if there is a gap.
    assert ("Bars of held-out closure by effect" in pictures(read_page(page))) is (verdict != "none")
    assert ("To separate the tied effects, take a dark exposure" in text) is (verdict == "tie")
    assert ("with the named effects” means with the best of the tied effects: dark offset" in text) is (
        verdict == "tie"
    )
    assert ("a patch of added light" in text) is (verdict in ("unknown", "inconclusive"))


def test_an_unexplained_gap_in_the_discs_is_reported_separately(blank: None) -> None:
    diagnosis = judged("inconclusive")
    diagnosis = replace(diagnosis, judgement=replace(diagnosis.judgement, discs_unexplained=True))
    report = report_of(diagnosis)
    told = "dark offset explains the unocculted field, but the cause of the gap in the discs cannot be identified"
    assert told[1:] in report["sentence"] and "assumed floor" not in report["sentence"]
    text = text_of(gap_page(diagnosis, report).html())
    assert f"The report names no effect: {told}." in text and "assumed floor" not in text


def test_a_tie_names_the_certain_and_the_tied_effects(coarse: None) -> None:
    both = judged("tie", "core_blur", "dark_offset", "gain_mismatch")
    both = replace(both, judgement=replace(both.judgement, certain=("dark_offset",)))
    report = report_of(both)
    assert report["ties"] == [["core_blur", "gain_mismatch"]]
    told = "dark offset, together with core blur or gain mismatch"
    assert f"These data cannot show which effect causes the gap: {told}." in report["sentence"]
    assert "a dark exposure" not in report["would_separate"] and "both gain modes" in report["would_separate"]
    assert f"Tied: {told}." in text_of(gap_page(both, report).html())
    rows = [
        {"name": name}
        for name in ("dark_offset", "core_blur", "core_blur + dark_offset", "persistence + dark_offset")
    ]
    assert [bars._chosen(row, report) for row in rows] == [False, False, True, False]


def test_effects_of_a_pair_come_before_effects_that_explain_more_alone(blank: None) -> None:
    judgement = found().judgement
    alone = [one for one in judgement.tried if one.label != "dark_offset"]
    last = alone[-1].label
    names = ("dark_offset", last)
    pair = replace(
        fitted(found().model, [e for e in found().evidence.effects if e.name in names]), left_p_value=0.5
    )
    both = replace(
        found(), judgement=replace(judgement, answer=pair.names, tried=(pair, *judgement.tried), best=pair)
    )
    both = replace(both, shrinking=found().shrinking | {pair.label: Shrinking(None, None, None)})
    report = report_of(both)
    assert [fit["name"] for fit in report["effects"]][:2] == ["dark_offset", last]
    assert len(report["effects"]) == len(judgement.tried)
    assert [fit["name"] for fit in report["together"]] == [pair.label]
    # An effect measured in the unocculted field comes second, because it fits that field whatever the other does.
    measured = replace(both.evidence, numbers={both.evidence.columns["dark_offset"][0]: 9})
    report_so = report_of(replace(both, model=replace(both.model, evidence=measured)))
    assert [fit["name"] for fit in report_so["effects"]][:2] == [last, "dark_offset"]
    rows = [tag.text for tag in read_page(gap_page(both, report).html()) if tag.name == "td"]
    at = [rows.index(name.replace("_", " ")) for name in (pair.label, "dark_offset", last)]
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
