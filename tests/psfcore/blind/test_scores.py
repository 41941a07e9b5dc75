"""The table of a blind set: hand-made truths, reports and bounds; figures computed by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from psfcore.blind.effects.effect import EFFECTS, STAGES, Effect
from psfcore.blind.judge import LEVELS, DiagnosedCase, true_closure
from psfcore.blind.score import row, score, table, wilson

BOUNDS: dict[str, tuple[float, ...]] = {  # noncentrality, detected, name, family, stage
    "hidden": (5.0, 0.1, 0.0, 0.1, 0.2),
    "open": (40.0, 0.9, 0.4, 0.6, 0.8),
    "isolable": (200.0, 1.0, 0.8, 0.9, 1.0),
}
# Residuals of two images, noise 1 %: 3 and 4 with the effect, 0 and 1 of the sampling: closure 1 - 1 / 25.
RESIDUALS = [
    {"residual_pct": residual, "noise_pct": 1.0, "clean_pct": clean}
    for residual, clean in ((3.0, 0.0), (4.0, 1.0))
]


def entry(*causes: str, level: str = "", **more: Any) -> dict[str, Any]:
    """An entry of a report. causes: names of effects; a family means another form of it."""
    alternatives = []
    for cause in causes:
        effect = cause if cause in EFFECTS else None
        family = EFFECTS[cause].families[0] if effect else cause
        alternatives.append({"stage": STAGES[family], "family": family, "effect": effect, "probability": 0.9})
    level = level or ("name" if len(causes) == 1 else "open")
    return {"level": level, "words": "", "alternatives": alternatives, "field": None, "closure": None} | more


def case(
    true: str, classes: str, *entries: dict[str, Any], left: float = 5.0, **report: Any
) -> DiagnosedCase:
    """A case. true, classes: the names of its effects, and their classes ("-": no bound)."""
    effects = [Effect(EFFECTS[name], 1.0, {}).as_json() | {"left_alone_pct": left} for name in true.split()]
    known = [effect["cause"] == effect["name"] for effect in effects]
    truth = {"kind": "mixed" if len(set(known)) == 2 else "", "effects": effects, "residuals": RESIDUALS}
    keys = ("noncentrality", "detected", *LEVELS)
    bounds = [dict(zip(keys, BOUNDS[one], strict=True)) for one in classes.split() if one != "-"]
    said = {"verdict": "attributed" if entries else "none", "causes": list(entries), **report}
    return DiagnosedCase(0, truth, said, 10.0, {"causes": bounds} if bounds else None)


def test_wilson_agrees_with_the_textbook_and_ratios_are_scaled() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    ratio = row("", [True] * 3 + [False], expected=[0.5] * 4)
    assert (ratio["n"], ratio["value"]) == (4, 1.5)
    assert ratio["wilson95"] == pytest.approx([2 * end for end in wilson(3, 4)])
    nothing = row("", [False], expected=[0.0])
    assert (nothing["n"], nothing["value"], nothing["wilson95"]) == (1, None, None)


def test_an_entry_is_right_at_levels_and_covers_or_is_wrong() -> None:
    rows: list[tuple[str, list[dict[str, Any]], str, bool, int]] = [
        # the true effect, the entries, levels at which they are right, whether they cover it, wrong effects alone
        ("ghost", [entry("ghost")], "name family stage", True, 0),
        ("ghost", [entry("wide_halo"), entry("ghost")], "name family stage", True, 1),
        ("ghost", [entry("psf", "ghost")], "stage", True, 0),
        ("ghost", [entry("psf", "core", level="stage")], "stage", True, 0),
        ("ghost", [entry("psf", "core")], "stage", False, 0),
        ("ghost", [entry("light_place", "core", level="stage")], "", False, 0),
        ("ghost", [entry(level="open")], "", False, 0),
        ("ghost", [], "", False, 0),
        ("wide_halo", [entry("psf")], "family stage", True, 0),  # another form of its family
        ("wide_halo", [entry("mesh_pitch", "mesh_rotation")], "family stage", True, 0),
        ("wide_halo", [entry("mesh_pitch")], "family stage", True, 0),
        ("glow", [entry("light_place")], "name family stage", True, 0),
        ("glow", [entry("intensity_gradient")], "family stage", True, 0),
        ("glow", [entry("ghost")], "", False, 1),
        ("dust_shadow", [entry("flat_field_residual")], "name family stage", True, 0),  # in another form
        ("dust_shadow", [entry("gain_place")], "name family stage", True, 0),
        ("row_crosstalk", [entry("ghost")], "family stage", True, 0),  # of two stages
        ("saturation_fill", [entry("scene_evolution")], "", False, 0),  # brought along
    ]
    for name, entries, levels, covered, wrong in rows:
        one = case(name, "-", *entries)
        (cause,) = one.causes
        right = " ".join(level for level in LEVELS if cause.right_entries(level))
        assert (right, cause.cover is not None, one.wrong_alone) == (levels, covered, wrong), (
            name,
            entries,
        )
        assert cause.visibility is None
    both = [entry("light_place"), entry("dark_offset", "offset_place")]
    for entries, told in ((both, True), (both[:1], False), ([entry("light_place", "dark_offset")], False)):
        assert case("glow dark_offset", "- -", *entries).tells_both is told


def light(*values: float) -> dict[str, Any]:
    at = [4.5, 14.5]
    return {"map": {"x_px": at, "y_px": at, "value": np.reshape(values, (2, 2)).tolist()}}


def closure(value: float, low: float, high: float) -> dict[str, Any]:
    return {"value": value, "ci90": [low, high]}


OFFSET = {"dark_offset": {"parameter": "offset", "excluded_95": 1.5}}
PITCH = {
    "mesh_pitch": {"parameter": "x", "excluded_95": 900.0, "parameters": {"stretch": {"excluded_95": 90.0}}}
}
CASES = [
    case("", ""),
    case("", "", entry("ghost")),
    case("dark_offset", "hidden", limits=OFFSET),
    case(
        "ghost",
        "hidden",
        entry("ghost", "core"),
        limits={"ghost": {"parameter": "share", "excluded_95": None}},
    ),
    case("mesh_pitch", "open", entry("psf", "core", "ghost", "edge"), limits=PITCH, where=[{"axis": "time"}]),
    case("ghost", "open", entry("light_place", "edge"), left=12.0, where=[{"axis": "intensity"}]),
    case("wide_halo", "isolable", entry("wide_halo", closure=closure(0.9, 0.8, 0.97)), left=12.0),
    case("core_blur", "isolable", entry("core_blur", closure=closure(0.72, 0.6, 0.8))),
    case("core_blur", "isolable", entry("ghost")),
    case("glow", "isolable", entry("light_place", field=light(0.0, 2.0, 4.0, 18.0))),
    case("glow", "isolable", entry("intensity_gradient", field=light(9.0, 2.0, 1.0, 0.0))),
    case("groove_streak", "isolable", entry("ghost", "core")),
    case("ghost glow", "isolable isolable", entry("ghost"), entry("light_place")),
    case("ghost glow", "isolable isolable", entry("light_place")),
    case("ghost glow", "isolable hidden", entry("ghost")),
    case("ghost", "-", entry("psf", "ghost")),
]
for one in CASES:
    for effect in one.truth["effects"]:
        if effect["name"] == "glow":
            effect["light_map"] = {"size_px": 20, "values": [[0.0, 1.0], [2.0, 9.0]]}
AGREES = np.corrcoef([0, 1, 2, 9], [9, 2, 1, 0])[0, 1]
# Figure: number of cases, value, whether its goal is met.
FIGURES = {
    "false alarms on clean data": (2, 1 / 2, False),
    "hidden: no cause is claimed": (2, 1 / 2, False),
    "hidden or open: strength below excluded_95": (1, 1.0, True),  # 1 of 1.5 DN
    "open: an entry covers the cause": (2, 1 / 2, False),
    "open: mean number of alternatives": (2, 3.0, False),
    "isolable, known: named and alone / bound": (6, 4 / (6 * 0.8), True),
    "isolable, known: named and alone": (6, 4 / 6, False),
    "isolable, withheld: right family / bound": (5, 4 / (5 * 0.9), True),
    "isolable, withheld: right stage / bound": (5, 5 / 5, True),
    "isolable, known beside withheld: both told": (2, 1 / 2, False),
    "wrong effect alone": (17, 1 / 17, False),
    "10 % left: an entry covers the cause": (2, 1 / 2, False),
    "map of light: peak within 0.15": (2, 1 / 2, False),
    "map of light: correlation, median": (2, (1 + AGREES) / 2, False),
    "90 % interval contains the true closure": (2, 1 / 2, False),
    "closure / true closure, median": (2, (0.9 + 0.72) / 2 / 0.96, False),
    "strongest axis is right": (5, 1 / 5, False),
    "time of the slowest case, s": (16, 10.0, True),
    "open: right at the level of name": (2, 0.0, None),
    "open: right at the level of family": (2, 0.0, None),
    "open: right at the level of stage": (2, 0.0, None),
    "isolable: right at the level of name": (11, 7 / 11, None),
    "isolable: right at the level of family": (11, 8 / 11, None),
    "isolable: right at the level of stage": (11, 10 / 11, None),
}


def test_every_figure_equals_the_one_computed_by_hand() -> None:
    found = score(CASES, {7: "exit status 1: no light"})
    rows = {row["figure"]: (row["n"], row["value"], row["met"]) for row in found["rows"]}
    assert rows == {
        figure: (cases, pytest.approx(value), met) for figure, (cases, value, met) in FIGURES.items()
    }
    bounds = {row["figure"]: row["bound"] for row in found["rows"] if row["bound"] is not None}
    levels = {f"{name}: right at the level of {level}" for name in ("open", "isolable") for level in LEVELS}
    assert bounds.keys() == levels and bounds["isolable: right at the level of family"] == pytest.approx(0.9)
    assert true_closure(CASES[2].truth) == pytest.approx(1 - 1 / 25)
    assert true_closure({"residuals": []}) is None
    wrong = found["cases"][8]
    assert (wrong["causes"][0]["class"], wrong["causes"][0]["covered"], wrong["wrong_alone"]) == (
        "isolable",
        False,
        1,
    )
    text = table(found)
    assert "0007: exit status 1: no light" in text and f"{7 / 11:.3f}" in text
    assert score([], {})["rows"][0]["value"] is None
