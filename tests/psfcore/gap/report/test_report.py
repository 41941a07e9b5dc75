"""The gap report as JSON: the fields of its schema, for every verdict, and its summary sentence."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from psfcore.gap.report.report import (
    AXIS_WORDS,
    LEAST_SHARE,
    gap_report,
    hypothesis_words,
    order_words,
    percent_words,
)
from psfcore.gap.verdict.limits import Alike
from psfcore.gap.verdict.posterior import NONE, UNKNOWN
from tests.psfcore.gap.report.judged import (
    HOLDS_FOR,
    OFFSET,
    OFFSET_BLUR,
    OFFSET_GAIN,
    SHARES,
    judged,
    with_shares,
)
from tests.psfcore.gap.small_gaps import found

VERDICTS = tuple(SHARES)
# What a reader of schema gap/1 finds, with the types of the values.
GAP_1 = {
    "schema": str,
    "sentence": str,
    "gap": dict,
    "where": list,
    "verdict": str,
    "answer": list,
    "effects": list,
    "ties": list,
    "would_separate": str,
    "untestable": list,
}
GAP_2 = {"set": dict, "probabilities": dict, "limits": dict, "alike": list, "calibration": dict}


def reported(verdict: str) -> dict[str, Any]:
    """The report as a reader gets it. NaN and infinity are no JSON."""
    back: dict[str, Any] = json.loads(json.dumps(gap_report(judged(verdict)), allow_nan=False))
    return back


def is_interval(value: Any) -> bool:
    return isinstance(value["value"], float) and len(value["ci90"]) == 2


@pytest.mark.parametrize("verdict", VERDICTS)
def test_the_report_has_every_field_of_its_schema_and_of_the_earlier_one(verdict: str) -> None:
    report = reported(verdict)
    assert report["schema"] == "gap/2" and report["verdict"] == verdict
    for name, kind in (GAP_1 | GAP_2).items():
        assert isinstance(report[name], kind), name
    gap = report["gap"]
    assert set(gap) == {"before_refit_pct", "rms_pct", "after_pct", "noise_pct", "p_value"}
    assert all(is_interval(gap[name]) for name in ("before_refit_pct", "rms_pct", "after_pct"))
    assert gap["noise_pct"] > 0 and 0 <= gap["p_value"] <= 1
    for axis in report["where"]:
        assert axis["axis"] in AXIS_WORDS and {"share", "p_value", "at"} <= set(axis)
    assert len({axis["axis"] for axis in report["where"]}) == len(report["where"]) > 1
    for effect in report["effects"]:
        assert {"name", "parameters", "p_value", "delta_chi2_held_out", "closure"} <= set(effect)
        assert all(set(one) == {"value", "sigma", "unit"} for one in effect["parameters"].values())
        assert effect["closure"] is None or is_interval(effect["closure"])
    assert report["untestable"] and all(set(one) == {"name", "why"} for one in report["untestable"])


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_effect_of_the_library_is_tested_or_not_testable(verdict: str) -> None:
    report = reported(verdict)
    tested = [effect["name"] for effect in report["effects"]]
    assert sorted(tested) == sorted(effect.name for effect in found().evidence.effects)
    assert not set(tested) & {one["name"] for one in report["untestable"]}
    probabilities = [effect["probability"] for effect in report["effects"]]
    assert probabilities == sorted(probabilities, reverse=True)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_the_set_its_hypotheses_and_the_probabilities_agree(verdict: str) -> None:
    report, judgement = reported(verdict), judged(verdict).judgement
    members = report["set"]["members"]
    assert report["set"]["coverage"] == judgement.coverage == 0.9
    listed = {tuple(one["effects"]): one["probability"] for one in report["hypotheses"]}
    assert members and all(tuple(names) in listed for names in members)
    assert members[0] == report["hypotheses"][0]["effects"]
    assert list(listed.values()) == sorted(listed.values(), reverse=True)
    assert {"none", "unknown"} <= set(report["probabilities"])
    assert all(0 <= share <= 1 for share in report["probabilities"].values())
    # The answer and the set name the same effects.
    if verdict in ("attributed", "tie"):
        assert set(report["answer"]) == {name for names in members for name in names}
    else:
        assert members[:1] == [[]] or ["unknown"] in members
    assert report["ties"] == ([report["answer"]] if verdict == "tie" else [])
    assert bool(report["would_separate"]) is (verdict == "tie")


def test_hypotheses_that_are_hardly_possible_are_not_listed_unless_the_set_has_them() -> None:
    shares = {OFFSET: 1 - 1e-5, NONE: 0.9e-5, UNKNOWN: 0.1e-5}
    report = gap_report(with_shares(shares))
    assert [one["effects"] for one in report["hypotheses"]] == [["dark_offset"]]
    assert shares[NONE] < LEAST_SHARE
    assert report["probabilities"]["none"] == pytest.approx(0.9e-5)


def test_limits_alike_and_calibration_are_stated() -> None:
    report = reported("attributed")
    tested = {effect["name"] for effect in report["effects"]}
    assert set(report["limits"]) == tested
    for limit in report["limits"].values():
        assert {"parameter", "unit", "found_90", "excluded_95"} <= set(limit)
        assert limit["excluded_95"] > 0
    # The fitted offset is below its own limit, and above what would be found.
    offset = report["effects"][0]["parameters"]["offset"]
    limit = report["limits"]["dark_offset"]
    assert limit["found_90"] < offset["value"] < limit["excluded_95"]
    for one in report["alike"]:
        assert set(one) == {"pair", "distance", "would_separate"} and set(one["pair"]) <= tested
    assert report["calibration"] == {
        "cases": 19,
        "temperature": 1.0,
        "seed": 5,
        "version": "1.2.3",
        "command": "python -m made",
        "holds_for": HOLDS_FOR,
    }


def test_alike_effects_are_listed_with_what_would_separate_them() -> None:
    pair = Alike(("dark_offset", "core_blur"), 1.4, "a series of exposure times")
    report = gap_report(replace(found(), limits=replace(found().limits, alike=(pair,))))
    (listed,) = report["alike"]
    assert listed["pair"] == ["dark_offset", "core_blur"] and listed["distance"] == 1.4
    assert listed["would_separate"] == "a series of exposure times"


@pytest.mark.parametrize("verdict", VERDICTS)
def test_what_the_gap_looks_like_is_said_only_if_its_cause_may_be_unknown(verdict: str) -> None:
    report = reported(verdict)
    assert bool(report["looks_like"]) is (["unknown"] in report["set"]["members"])
    if report["looks_like"]:
        first, second = report["looks_like"]  # the third pattern is too improbable
        assert first["form"] == "a change that varies with the position along detector x and the pointing"
        assert (first["probability"], second["probability"]) == pytest.approx((0.8, 0.15))


SAID = {
    "none": (
        "No gap beyond noise and the error of the fit was found: with a probability of 70 % there is none",
        "These data do not exclude dark offset (15 %), a cause outside the library (8 %) or gain mismatch (7 %).",
    ),
    "attributed": (
        "There is a gap of ",
        "The gap is explained by dark offset (offset ",
        "with a probability of 93 %: on held-out images the gap in the discs falls from ",
    ),
    "tie": (
        "There is a gap of ",
        "These data cannot show which effect causes the gap: dark offset or gain mismatch.",
        "To separate these effects, take ",
    ),
    "unknown": (
        "There is a gap of ",
        "Its cause is not in the library; it most resembles a change that varies with the position along detector x",
    ),
    "inconclusive": (
        "There may be a gap.",
        "These data do not decide its cause: dark offset (50 %), a cause outside the library (30 %), no gap (12 %) or "
        "gain mismatch (8 %).",
    ),
}


@pytest.mark.parametrize("verdict", VERDICTS)
def test_the_summary_is_two_to_four_plain_sentences(verdict: str) -> None:
    sentence = reported(verdict)["sentence"]
    for part in SAID[verdict]:
        assert part in sentence
    assert sentence[0].isupper() and sentence.endswith(".") and "  " not in sentence and "_" not in sentence
    assert 1 <= len(re.findall(r"\.(?= [A-Z]|$)", sentence)) <= 4
    assert ("It varies most " in sentence) is (verdict not in ("none", "inconclusive"))


def test_few_images_are_said_to_exclude_only_a_large_gap() -> None:
    few = replace(with_shares(SHARES["none"], images=5), residual=None)
    report = gap_report(few)
    assert report["verdict"] == "inconclusive" and report["answer"] == []
    assert "No gap is visible in these" in report["sentence"] and "only a large gap" in report["sentence"]


def test_a_gap_is_said_to_exist_if_no_gap_is_not_in_the_set() -> None:
    unsure = with_shares({OFFSET: 0.6, UNKNOWN: 0.38, NONE: 0.02})
    sentence = gap_report(unsure)["sentence"]
    assert sentence.startswith("There is a gap of ") and "There may be" not in sentence
    assert "do not decide its cause: dark offset (60 %) or a cause outside the library (38 %)." in sentence


def test_more_hypotheses_than_a_sentence_can_hold_are_counted() -> None:
    many = with_shares(
        {OFFSET: 0.3, UNKNOWN: 0.2, NONE: 0.18, ("gain_mismatch",): 0.16, ("core_blur",): 0.16}
    )
    assert gap_report(many)["sentence"].endswith(" or 1 other of smaller probability.")


def test_a_pair_is_reported_with_its_own_fit() -> None:
    report = gap_report(with_shares({OFFSET_BLUR: 0.93, UNKNOWN: 0.04, NONE: 0.03}))
    assert report["answer"] == ["dark_offset", "core_blur"]
    (pair,) = report["together"]
    assert pair["name"] == "dark_offset + core_blur" and pair["probability"] == pytest.approx(0.93)
    assert all(name.split(".")[0] in report["answer"] for name in pair["parameters"])
    assert report["probabilities"]["dark_offset"] == pytest.approx(0.93)
    assert {effect["name"] for effect in report["effects"]} >= {"dark_offset", "core_blur"}


def test_a_tie_of_pairs_names_what_is_certain_and_what_is_tied() -> None:
    report = gap_report(with_shares({OFFSET_BLUR: 0.5, OFFSET_GAIN: 0.45, UNKNOWN: 0.05}))
    assert report["ties"] == [["core_blur", "gain_mismatch"]]
    assert "dark offset, together with core blur or gain mismatch." in report["sentence"]
    assert "a dark exposure" not in report["would_separate"] and "both gain modes" in report["would_separate"]


def test_a_tie_of_an_effect_and_its_pair_does_not_claim_the_second_effect() -> None:
    report = gap_report(with_shares({OFFSET_BLUR: 0.55, OFFSET: 0.4, UNKNOWN: 0.05}))
    assert (report["verdict"], report["ties"]) == ("tie", [["core_blur"]])
    assert "dark offset, alone or together with core blur." in report["sentence"]


def test_a_gap_of_the_unocculted_field_alone_is_not_said_of_the_discs() -> None:
    model = found().model
    quiet = tuple(replace(disc, residual=0.0 * disc.residual) for disc in model.evidence.discs)
    blocks = model.evidence.unocculted
    images, across = np.indices(blocks.levels.shape)
    levels = blocks.levels * (1 + 0.2 * (-1.0) ** images * (across % 2))
    evidence = replace(model.evidence, discs=quiet, unocculted=replace(blocks, levels=levels))
    alone = replace(
        judged("unknown"), model=replace(model, evidence=evidence), rms=replace(found().rms, value=0.1)
    )
    sentence = gap_report(alone)["sentence"]
    assert sentence.startswith("There is a gap in the unocculted field")
    assert "The discs do not show it (the gap in the discs is 0.1 %" in sentence


def test_words_for_probabilities_orders_and_hypotheses() -> None:
    assert [percent_words(share) for share in (1.0, 0.9949, 0.5, 0.006, 0.004, 0.0)] == [
        "> 99 %",
        "99 %",
        "50 %",
        "1 %",
        "< 1 %",
        "< 1 %",
    ]
    assert order_words(("time",)) == "a change that varies with the time"
    assert order_words(("x", "y", "time", "pointing")) == "a change along many orders of the data"
    assert hypothesis_words(NONE) == "no gap" and hypothesis_words(UNKNOWN) == "a cause outside the library"
    assert hypothesis_words(("dark_offset", "core_blur")) == "dark offset together with core blur"
