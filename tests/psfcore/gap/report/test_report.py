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
    in_short_if_many,
    p_words,
    percent_words,
)
from psfcore.gap.verdict.limits import Alike
from psfcore.gap.verdict.posterior import NONE, UNKNOWN
from tests.psfcore.gap.posteriors import FIELD
from tests.psfcore.gap.report.judged import (
    ABOUT,
    BLUR,
    GAIN,
    OFFSET,
    OFFSET_BLUR,
    OFFSET_GAIN,
    SHARES,
    judged,
    with_shares,
)
from tests.psfcore.gap.small_gaps import found

# The fields of the report, with the types of their values.
FIELDS = dict.fromkeys(("schema", "sentence", "verdict", "would_separate"), str)
FIELDS |= dict.fromkeys(("gap", "set", "probabilities", "limits", "calibration"), dict)
FIELDS |= dict.fromkeys(("where", "answer", "effects", "ties", "untestable", "alike"), list)


def is_interval(value: Any) -> bool:
    return isinstance(value["value"], float) and len(value["ci90"]) == 2


@pytest.mark.parametrize("verdict", list(SHARES))
def test_the_report_of_every_verdict(verdict: str) -> None:
    """It has every field of its schema; its set, hypotheses, effects and sentence agree."""
    diagnosis = judged(verdict)
    report = json.loads(json.dumps(gap_report(diagnosis), allow_nan=False))  # NaN and infinity are no JSON
    assert report["schema"] == "gap/2" and report["verdict"] == verdict
    for name, kind in FIELDS.items():
        assert isinstance(report[name], kind), name
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
    for effect in effects:
        assert {"name", "parameters", "p_value", "delta_chi2_held_out", "closure"} <= set(effect)
        assert all(set(one) == {"value", "sigma", "unit"} for one in effect["parameters"].values())
        assert effect["closure"] is None or is_interval(effect["closure"])
    assert untestable and all(set(one) == {"name", "why"} for one in untestable)
    assert not {one["name"] for one in effects} & {one["name"] for one in untestable}
    shares = [one["probability"] for one in effects]
    assert shares == sorted(shares, reverse=True)
    # The set, its hypotheses and the probabilities agree.
    members = report["set"]["members"]
    assert report["set"]["coverage"] == diagnosis.judgement.coverage == 0.9
    listed = {tuple(one["effects"]): one["probability"] for one in report["hypotheses"]}
    assert members and all(tuple(names) in listed for names in members)
    assert members[0] == report["hypotheses"][0]["effects"]
    assert list(listed.values()) == sorted(listed.values(), reverse=True)
    assert {"none", "unknown"} <= set(report["probabilities"])
    assert all(0 <= share <= 1 for share in report["probabilities"].values())
    if verdict in ("attributed", "tie"):
        assert set(report["answer"]) == {name for names in members for name in names}
    else:
        assert members[:1] == [[]] or ["unknown"] in members
    assert report["ties"] == ([report["answer"]] if verdict == "tie" else [])
    assert bool(report["would_separate"]) is (verdict in ("tie", "inconclusive"))
    # What the gap looks like is said only if its cause may be unknown.
    unknown = report["unknown"]
    assert unknown["probability"] == report["probabilities"]["unknown"]
    assert len(unknown["fields"]) == (["unknown"] in members)
    for field in unknown["fields"]:
        assert (field["stage"], field["form"], field["width"]) == (FIELD.stage, FIELD.form, FIELD.width)
        assert field["probability"] == pytest.approx(1.0)
        shape = len(field["map"]["y_px"]), len(field["map"]["x_px"])
        assert np.shape(field["map"]["value"]) == np.shape(field["map"]["sigma"]) == shape
        value = np.array(field["map"]["value"]) / np.array(field["map"]["sigma"])
        clearest = np.unravel_index(np.argmax(np.abs(value)), shape)
        assert field["strength"]["value"] == np.array(field["map"]["value"])[clearest]
        assert len(field["resembles"]) == 3
    kinds = {(one["stage"], one["form"]) for one in unknown["excluded_95"]}
    assert {("detector", "light"), ("detector", "dark"), ("time", "gain_in_time")} <= kinds
    assert all(one["strength"] > 0 for one in unknown["excluded_95"])
    # The summary is one to four plain sentences.
    sentence = report["sentence"]
    named = [tuple(names) for names in members if names not in ([], ["unknown"])]
    assert all(hypothesis_words(names) in sentence for names in named), sentence
    assert (FIELD.words in sentence) is (verdict == "unknown")
    assert sentence[0].isupper() and sentence.endswith(".") and "  " not in sentence and "_" not in sentence
    assert 1 <= len(re.findall(r"\.(?= [A-Z]|$)", sentence)) <= 4
    assert ("It varies most " in sentence) is (verdict not in ("none", "inconclusive"))


def test_limits_alike_calibration_and_possible_hypotheses_are_stated() -> None:
    pair = Alike(OFFSET_BLUR, 1.4, "a series of exposure times")
    attributed = judged("attributed")
    report = gap_report(replace(attributed, limits=replace(attributed.limits, alike=(pair,))))
    assert set(report["limits"]) == {effect["name"] for effect in report["effects"]}
    for limit in report["limits"].values():
        assert {"parameter", "unit", "found_90", "excluded_95"} <= set(limit) and limit["excluded_95"] > 0
    # The fitted offset is below its own limit, and above what would be found.
    offset = report["effects"][0]["parameters"]["offset"]
    limit = report["limits"]["dark_offset"]
    assert limit["found_90"] < offset["value"] < limit["excluded_95"]
    assert report["alike"] == [pair.as_json()]
    assert report["calibration"] == {"cases": 19, "temperature": 1.0} | ABOUT
    shares = {OFFSET: 1 - 1e-5, NONE: 0.9e-5, UNKNOWN: 0.1e-5}
    report = gap_report(with_shares(shares))
    assert [one["effects"] for one in report["hypotheses"]] == [["dark_offset"]]
    assert shares[NONE] < LEAST_SHARE
    assert report["probabilities"]["none"] == pytest.approx(0.9e-5)


def test_the_sentence_says_how_sure_a_gap_is_and_where_it_shows() -> None:
    few = gap_report(replace(with_shares(SHARES["none"], images=5), residual=None))
    assert few["verdict"] == "inconclusive" and few["answer"] == []
    assert "No gap is visible" in few["sentence"] and "only a large gap" in few["sentence"]
    # An axis that is first because of the answer is no evidence for the answer.
    first, *others = found().where
    attributed = judged("attributed")
    for of_best in (True, False):
        led = replace(attributed, where=(replace(first, of_best=of_best), *others))
        assert ("as the best effect does" in gap_report(led)["sentence"]) is of_best
    # A gap is said to exist if "no gap" is not in the set.
    unsure = gap_report(with_shares({OFFSET: 0.6, UNKNOWN: 0.38, NONE: 0.02}))["sentence"]
    assert unsure.startswith("There is a gap of ") and "There may be" not in unsure
    assert "dark offset (60 %) or a cause outside the library (38 %)." in unsure
    # More hypotheses than a sentence can hold are counted.
    many = with_shares({OFFSET: 0.3, UNKNOWN: 0.2, NONE: 0.18, GAIN: 0.16, BLUR: 0.16})
    assert " or 1 other of smaller probability. To decide, take " in gap_report(many)["sentence"]
    model = found().model
    quiet = tuple(replace(disc, residual=0.0 * disc.residual) for disc in model.evidence.discs)
    blocks = model.evidence.unocculted
    images, across = np.indices(blocks.levels.shape)
    levels = blocks.levels * (1 + 0.2 * (-1.0) ** images * (across % 2))
    evidence = replace(model.evidence, discs=quiet, unocculted=replace(blocks, levels=levels))
    small = replace(found().rms, value=0.1)
    alone = replace(judged("unknown"), model=replace(model, evidence=evidence), rms=small)
    sentence = gap_report(alone)["sentence"]
    assert sentence.startswith("There is a gap in the unocculted field")
    assert "The discs do not show it." in sentence


def test_pairs_and_ties_name_what_is_certain_and_what_is_tied() -> None:
    report = gap_report(with_shares({OFFSET_BLUR: 0.93, UNKNOWN: 0.04, NONE: 0.03}))
    assert report["answer"] == [*OFFSET_BLUR]
    (pair,) = report["together"]
    assert pair["name"] == "dark_offset + core_blur" and pair["probability"] == pytest.approx(0.93)
    assert all(name.split(".")[0] in report["answer"] for name in pair["parameters"])
    assert report["probabilities"]["dark_offset"] == pytest.approx(0.93)
    assert {effect["name"] for effect in report["effects"]} >= {*OFFSET_BLUR}

    tied = gap_report(with_shares({OFFSET_BLUR: 0.5, OFFSET_GAIN: 0.45, UNKNOWN: 0.05}))
    assert tied["ties"] == [["core_blur", "gain_mismatch"]]
    assert "dark offset, together with core blur or gain mismatch." in tied["sentence"]
    assert "a dark exposure" not in tied["would_separate"] and "both gain modes" in tied["would_separate"]

    # A tie of an effect and its pair does not claim the second effect.
    single = gap_report(with_shares({OFFSET_BLUR: 0.55, OFFSET: 0.4, UNKNOWN: 0.05}))
    assert (single["verdict"], single["ties"]) == ("tie", [["core_blur"]])
    assert "dark offset, alone or together with core blur." in single["sentence"]


def test_words_for_probabilities_and_hypotheses() -> None:
    percents = {1.0: "> 99 %", 0.9949: "99 %", 0.5: "50 %", 0.006: "1 %", 0.004: "< 1 %", 0.0: "< 1 %"}
    assert {share: percent_words(share) for share in percents} == percents
    assert [p_words(p) for p in (2.3e-4, 0.0)] == ["0.00023", "< 1e-300"]
    assert in_short_if_many([1.0] * 12) is None
    assert in_short_if_many([3.0] + 15 * [0.0] + [4.0]) == "17 parameters, root sum of squares 5"
    assert (hypothesis_words(NONE), hypothesis_words(UNKNOWN)) == ("no gap", "a cause outside the library")
    assert hypothesis_words(OFFSET_BLUR) == "dark offset together with core blur"
    assert hypothesis_words(("ghost", "unknown")) == "ghost together with a cause outside the library"
