"""The gap report as JSON: the fields of its schema, and its three lines, for every kind of answer."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.evidence.tree import FAMILIES
from psfcore.gap.report.report import (
    AXIS_WORDS,
    CLEAR,
    LEAST_SHARE,
    axes_words,
    change_words,
    clearest_words,
    closing_words,
    gap_report,
    in_short_if_many,
    p_words,
    percent_words,
    pointing_shares,
    promise_words,
)
from psfcore.gap.verdict.calibration import ANOTHER_AUTHOR
from psfcore.gap.verdict.closure import Interval
from psfcore.gap.verdict.limits import Alike
from tests.psfcore.gap.report.judged import ABOUT, GIVEN, LEVEL, OFFSET, Given, judged, with_shares
from tests.psfcore.gap.small_gaps import found

# The fields of the report, with the types of their values.
FIELDS: dict[str, type] = dict.fromkeys(("schema", "sentence", "verdict", "would_separate"), str)
FIELDS |= dict.fromkeys(("gap", "probabilities", "limits", "calibration"), dict)
FIELDS |= dict.fromkeys(
    ("lines", "where", "answer", "causes", "hypotheses", "effects", "together", "untestable", "alike"), list
)
# Words that the lines of an answer contain: of WHICH, and of HOW FAR.
SAID = {
    "none": (["no cause", "70 %", "dark offset (15 %)"], ["dark offset (offset above", "DN"]),
    "name": (["dark offset (offset = 6.", "DN; 95 %", "confirm it, take a dark"], ["dark offset closes", "falls from"]),
    "two": (["dark offset (offset = 6.", "beside it core blur (variance", "To confirm them"], []),
    "beside": (["dark offset", f"; beside it {FAMILIES['light_place'].words}, in a form"], ["with another form of"]),
    "sun": (["scene evolution (96 %)"], ["Sun"]),
    "with_sun": (["dark offset (offset = 6.", "; beside it scene evolution (95 %)"], ["dark offset closes"]),
    "tie": (["52 %) or gain mismatch (48 %)", "take a dark exposure", "both gain modes"], ["gain mismatch closes"]),
    "map": ([f"{FAMILIES['light_place'].words}, in a form that the library does not have (95 %)"], ["another form of"]),
    "curve": ([f"{FAMILIES['psf_time'].words}, in a form"], ["another form of"]),
    "stage": (["dark offset (offset", "(38 %), all in the detector", "door closed"], ["dark offset closes"]),
}  # fmt: skip


def is_interval(value: Any) -> bool:
    return isinstance(value["value"], float) and len(value["ci90"]) == 2


def report_of(diagnosis: Diagnosis) -> dict[str, Any]:
    """The report as a reader gets it: NaN and infinity are no JSON."""
    back: dict[str, Any] = json.loads(json.dumps(gap_report(diagnosis), allow_nan=False))
    return back


@pytest.mark.parametrize("kind", list(GIVEN))
def test_the_report_of_every_kind_of_answer(kind: str) -> None:
    given, report = GIVEN[kind], report_of(judged(kind))
    assert (report["schema"], report["verdict"], report["level"]) == ("gap/3", given.verdict, LEVEL)
    for name, of_type in FIELDS.items():
        assert isinstance(report[name], of_type), name
    gap = report["gap"]
    assert set(gap) == {"before_refit_pct", "rms_pct", "after_pct", "noise_pct", "p_value"}
    assert all(is_interval(gap[name]) for name in ("before_refit_pct", "rms_pct", "after_pct"))
    assert gap["noise_pct"] > 0 and 0 <= gap["p_value"] <= 1
    for axis in report["where"]:
        assert axis["axis"] in AXIS_WORDS and {"share", "p_value", "at"} <= set(axis)
    assert len({axis["axis"] for axis in report["where"]}) == len(report["where"]) > 1
    # Every effect of the library is tested or not testable.
    effects, untestable = report["effects"], report["untestable"]
    assert sorted(one["name"] for one in effects) == sorted(e.name for e in found().evidence.effects)
    for effect in (*effects, *report["together"]):
        assert {"name", "words", "parameters", "p_value", "delta_chi2_held_out", "closure"} <= set(effect)
        assert all(set(one) == {"value", "sigma", "unit"} for one in effect["parameters"].values())
        assert effect["closure"] is None or is_interval(effect["closure"])
    assert untestable and all(set(one) == {"name", "why"} for one in untestable)
    assert not {one["name"] for one in effects} & {one["name"] for one in untestable}
    # The causes, their alternatives and the hypotheses agree with the probabilities.
    assert report["answer"] == list(given.named)
    labels = {label for shares in given.shares for label in shares}
    for cause in report["causes"]:
        assert cause["level"] in ("name", "family", "stage", "open") and cause["words"]
        shares = [one["probability"] for one in cause["alternatives"]]
        assert shares == sorted(shares, reverse=True) and sum(shares) >= LEVEL
        for one in cause["alternatives"]:
            assert (one["family"], one["effect"]) in labels and one["stage"] == FAMILIES[one["family"]].stage
        assert cause["closure"] is None or len(report["causes"]) == 1
    assert bool(report["causes"]) is (given.verdict != "none")
    listed = {
        frozenset((c["family"], c["effect"]) for c in one["causes"]): one["probability"]
        for one in report["hypotheses"]
    }
    assert listed == pytest.approx({frozenset(labels): share for labels, share in given.shares.items()})
    assert report["probabilities"]["none"] == pytest.approx(given.shares.get((), 0.0))
    assert bool(report["would_separate"]) is (kind in ("tie", "stage"))
    assert bool(report["together"]) is (kind in ("two", "beside", "map", "curve"))


@pytest.mark.parametrize("kind", list(GIVEN))
def test_three_lines_say_where_which_and_how_far(kind: str) -> None:
    report = report_of(judged(kind))
    lines = report["lines"]
    for line, begins in zip(lines, ("WHERE: ", "WHICH: ", "HOW FAR: "), strict=True):
        assert line.startswith(begins) and line.endswith(".") and len(line) > len(begins) + 10
        # No statement is made from an empty part.
        assert not re.search(r"  |_|take \.|: \.|; \.|\(\)|, \.|\.\.|None|nan", line), line
    for line, words in zip(lines[1:], SAID[kind], strict=True):
        assert all(word in line for word in words), line
    numbers = f"{report['gap']['rms_pct']['value']:.1f} %"
    assert numbers in lines[0] and all(line.partition(": ")[2][1:] in report["sentence"] for line in lines)
    shares = [int(share) for share in re.findall(r"\((\d+) %\)", lines[0])]
    assert shares == sorted(shares, reverse=True)
    significant = {AXIS_WORDS[axis["axis"]] for axis in report["where"] if axis["p_value"] <= 0.05}
    assert all(
        any(words in part for words in significant)
        for part in re.findall(r"it varies ([^,;]*\(\d+ %\))", lines[0])
    )
    assert ("closes" in lines[2]) is (report["closure"] is not None)


def test_a_shape_is_a_map_or_a_curve_and_its_clearest_place_is_told() -> None:
    for kind, place in (("map", r" DN/s at x = \d+ px, y = \d+ px"), ("curve", r" at \d+ s")):
        found = judged(kind)
        report = report_of(found)
        (cause,) = report["causes"]
        field = cause["field"]
        shape = field.get("map") or field["curve"]
        values, sigma = np.array(shape["value"]), np.array(shape["sigma"])
        assert (
            values.shape
            == sigma.shape
            == ((len(shape["y_px"]), len(shape["x_px"])) if kind == "map" else (len(shape["time_s"]),))
        )
        clearest = np.unravel_index(np.argmax(np.abs(values / sigma)), values.shape)
        assert (field["strength"]["value"], field["strength"]["sigma"]) == (values[clearest], sigma[clearest])
        (shape_of_field,) = found.shapes.values()
        assert re.search(place, clearest_words(shape_of_field)), kind
        # The line tells a place only if the field is clear there.
        clear = abs(values[clearest]) >= CLEAR * sigma[clearest]
        assert (re.search(place, report["lines"][0]) is not None) == clear, report["lines"][0]
    assert all(cause["field"] is None for cause in report_of(judged("sun"))["causes"])


def test_limits_alike_and_calibration_are_stated() -> None:
    pair = Alike(("dark_offset", "core_blur"), 1.4, "a series of exposure times")
    named = judged("name")
    report = report_of(replace(named, limits=replace(named.limits, alike=(pair,))))
    assert set(report["limits"]) == {effect["name"] for effect in report["effects"]}
    for limit in report["limits"].values():
        assert {"parameter", "unit", "found_90", "excluded_95"} <= set(limit) and limit["excluded_95"] > 0
    # The fitted offset is below its own limit, and above what would be found.
    offset, limit = report["effects"][0]["parameters"]["offset"], report["limits"]["dark_offset"]
    assert limit["found_90"] < offset["value"] < limit["excluded_95"]
    assert report["alike"] == [vars(pair) | {"pair": list(pair.pair)}]
    assert report["calibration"] == {"cases": 19, "covered": 1.0, "another_author": ANOTHER_AUTHOR} | ABOUT
    given = Given({(OFFSET,): 1 - LEAST_SHARE / 2, (): LEAST_SHARE / 2}, "attributed", ("dark_offset",))
    report = report_of(with_shares(given))
    assert [one["causes"] for one in report["hypotheses"]] == [[{"family": OFFSET[0], "effect": OFFSET[1]}]]
    assert report["probabilities"]["none"] == pytest.approx(LEAST_SHARE / 2)


def test_the_axes_of_the_first_line_are_significant_and_in_order() -> None:
    named = judged("name")
    shares = {
        "time": (0.2, 0.001),
        "detector_x": (0.3, 0.01),
        "exposure": (0.4, 0.5),
        "pointing": (0.04, 0.001),
    }
    axes = [
        replace(axis, share=shares[axis.name][0], p_value=shares[axis.name][1])
        for axis in named.where
        if axis.name in shares
    ]
    line = report_of(replace(named, where=tuple(axes)))["lines"][0]
    assert "it varies most clearly along detector x (30 %) and in time (20 %), although" in line
    assert "although the share with the exposure time is 40 %, which is not significant (p = 0.5)" in line
    axes = [replace(axis, share=0.25) if axis.name == "exposure" else axis for axis in axes]
    assert axes_words(axes) == "; it varies along detector x (30 %) and in time (20 %)"
    assert axes_words([replace(axis, p_value=0.5) for axis in axes]) == ""


def test_the_pointings_of_the_first_line_hold_most_of_the_gap() -> None:
    named, shares = judged("name"), pointing_shares(judged("name"))
    assert sum(shares.values()) == pytest.approx(1.0) and min(shares.values()) >= 0
    line = report_of(named)["lines"][0]
    (percent, last) = re.findall(
        r"; (?:> )?(\d+) % of the chi2 of the gap is in pointings? ([\d and]+)\.", line
    )[0]
    told = [int(one) for one in last.split(" and ")]
    assert set(told) == set(list(shares)[: len(told)]) and len(told) < len(shares)
    assert int(percent) == min(round(100 * sum(shares[one] for one in told)), 99) >= 60  # "> 99 %"


def test_few_images_and_a_gap_of_the_unocculted_field() -> None:
    few = replace(
        judged("none"), residual=None, answer=replace(judged("none").answer, verdict="inconclusive")
    )
    assert "no image can be held out" in report_of(few)["lines"][0] and report_of(few)["answer"] == []
    told = replace(judged("name"), residual=None)
    assert "cannot say" in report_of(told)["lines"][2]
    model = found().model
    quiet = tuple(replace(disc, residual=0.0 * disc.residual) for disc in model.evidence.discs)
    blocks = model.evidence.unocculted
    images, across = np.indices(blocks.levels.shape)
    levels = blocks.levels * (1 + 0.2 * (-1.0) ** images * (across % 2))
    evidence = replace(model.evidence, discs=quiet, unocculted=replace(blocks, levels=levels))
    small = replace(found().rms, value=0.1)
    alone = replace(judged("curve"), model=replace(model, evidence=evidence), rms=small)
    lines = report_of(alone)["lines"]
    assert "in the unocculted field" in lines[0] and "discs" not in lines[2]
    # The lines have the size of the gap there, without and with the told cause, and what the discs show.
    held_out = alone.residual
    assert held_out is not None
    one = np.ones_like(held_out.unocculted_chi2)
    before, after = (
        replace(held_out, unocculted_chi2=size**2 * 7 * one, unocculted_expected=7 * one)
        for size in (4.9, 1.1)
    )
    alone = replace(alone, residual=before, residual_after=after)
    said = report_of(alone)
    size, lines = said["unocculted"], said["lines"]
    assert (size["residual"], size["residual_after"]) == pytest.approx((4.9, 1.1)) and size["shows_the_gap"]
    assert f"by 4.9 times their noise of {size['noise_pct']:.2g} %; the discs show none, 0.1 %" in lines[0]
    assert "the difference in the unocculted field falls from 4.9 to 1.1 times the noise" in lines[2]
    assert [image["unocculted"] for image in said["images"]] == pytest.approx([4.9] * len(said["images"]))
    # Without images that can be held out, no part of the sentence is empty.
    assert "unocculted field; the discs" in report_of(replace(alone, residual=None))["lines"][0]


def test_no_sentence_is_made_from_an_observation_that_is_not_known() -> None:
    for kind, ends in (("tie", "; no observation is known that would."), ("name", "95 %).")):
        told = judged(kind)
        effects = tuple(replace(effect, settled_by="") for effect in told.evidence.effects)
        model = replace(told.model, evidence=replace(told.evidence, effects=effects))
        report = report_of(replace(told, model=model))
        assert report["lines"][1].endswith(ends), report["lines"][1]
        assert "take" not in report["lines"][1] and not report["would_separate"] + report["would_confirm"]
    # A cause without a name in the library has a next step too.
    door = FAMILIES["light_place"].settled_by
    assert report_of(judged("map"))["lines"][1].endswith(f"To confirm it, take {door}.")
    assert report_of(judged("beside"))["would_confirm"].endswith(f"; and {door}")


def test_a_place_is_told_with_its_error_and_with_how_far_it_is_known() -> None:
    found = judged("map")
    (shape,) = found.shapes.values()
    clear = replace(shape, sigma=np.full_like(shape.sigma, np.abs(shape.values).max() / 10))
    line = report_of(replace(found, shapes=dict.fromkeys(found.shapes, clear)))["lines"][0]
    assert re.search(
        r"clearest with -?[\d.]+ ± [\d.]+ DN/s at x = \d+ px, y = \d+ px \(known only near the discs\)", line
    )


def test_closure_and_change_are_told_as_their_intervals_allow() -> None:
    closing = {
        Interval(0.8, 0.47, 1.0): "it closes 80 % (47 to 100) of the gap",
        Interval(0.4, -0.2, 0.7): "it closes 40 % (less than 0 to 70) of the gap",
        Interval(-1.4, -5.5, 1.0): "these data cannot say whether it closes none or all of the gap",
        Interval(0.3, -0.1, 0.998): "these data cannot say whether it closes none or all of the gap",
        Interval(-0.4, -2.0, 0.02): "it closes none of the gap (at most 2 %)",
        Interval(-0.4, -2.0, -0.1): "it closes none of the gap (at most 0 %)",
    }
    assert {closure: closing_words("it", closure) for closure in closing} == closing
    before = Interval(3.0, 1.8, 3.8)
    changes = {
        Interval(1.0, 0.2, 1.9): "falls from 3.0 % (1.8 to 3.8) to 1.0 % (0.2 to 1.9)",
        Interval(
            1.3, 0.0, 3.8
        ): "changes from 3.0 % (1.8 to 3.8) to 1.3 % (0.0 to 3.8), which is within the errors",
        Interval(5.0, 4.0, 6.0): "rises from 3.0 % (1.8 to 3.8) to 5.0 % (4.0 to 6.0)",
    }
    assert {after: change_words(before, after) for after in changes} == changes


def test_the_measured_coverage_is_that_of_the_documentation() -> None:
    results = Path("docs/gap.md").read_text("utf-8")
    row = next(
        one for one in results.splitlines() if one.startswith("| 10 % left: an entry covers the cause")
    )
    causes, covered, interval = (cell.strip() for cell in row.split("|")[2:5])
    assert (int(causes), float(covered)) == (ANOTHER_AUTHOR["causes"], ANOTHER_AUTHOR["covered"])
    assert [float(end) for end in interval.split(" - ")] == ANOTHER_AUTHOR["ci95"]
    promise = promise_words(report_of(judged("name"))["calibration"])
    assert f"{100 * ANOTHER_AUTHOR['covered']:.0f} % (46 to 85) of 19 causes" in promise


def test_words_for_probabilities_and_parameters() -> None:
    percents = {1.0: "> 99 %", 0.9949: "99 %", 0.5: "50 %", 0.006: "1 %", 0.004: "< 1 %", 0.0: "< 1 %"}
    assert {share: percent_words(share) for share in percents} == percents
    assert [p_words(p) for p in (2.3e-4, 0.0)] == ["0.00023", "< 1e-300"]
    assert in_short_if_many([1.0] * 12) is None
    assert in_short_if_many([3.0] + 15 * [0.0] + [4.0]) == "17 parameters, root sum of squares 5"
