"""Plans: an exposure ladder tells a dark offset from scatter, the limits agree with data, and a page says it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import pytest

from psfcore.errors import DataError
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.planning import Planned, planned_limits
from psfcore.gap.report.limits import NOT_FOUND, lines, plan_page
from psfcore.gap.verdict.limits import ALIKE, Alike, EffectLimits, ParameterLimits
from psfcore.simulate.plan import HIGH, Plan, default_plan
from tests.html_page import check_stands_alone, read_page
from tests.transit_files import diffraction

NAMES = ("dark_offset", "intensity_gradient", "gain_mismatch", "wide_halo")
FEW = tuple(effect for effect in LIBRARY if effect.name in NAMES)
ONE, LADDER = (1.8,), (0.6, 1.8, 5.0)
IMAGES, SIZE_PX = 12, 96


def plan_with(exposures_s: Sequence[float], images: int = IMAGES) -> Plan:
    """A plan whose images have these exposure times in turn, all with one gain mode."""
    plan = default_plan(images, SIZE_PX, oversampling=1, brightness=8.0)
    shots = (
        replace(shot, exposure_s=exposures_s[n % len(exposures_s)], gain_mode=HIGH)
        for n, shot in enumerate(plan.shots)
    )
    return replace(plan, shots=tuple(shots))


@cache
def planned(exposures_s: tuple[float, ...]) -> Planned:
    return planned_limits(plan_with(exposures_s), diffraction(), library=FEW)


def strength_of(plan: Planned, name: str) -> float:
    strength = plan.limits.effects[name].leading.found_90
    assert strength is not None
    return strength


def test_a_ladder_of_exposures_separates_a_dark_offset_from_a_halo_and_from_a_leak() -> None:
    one, ladder = planned(ONE), planned(LADDER)
    assert strength_of(ladder, "dark_offset") < strength_of(one, "dark_offset") / 3
    halo, leak = ("dark_offset", "wide_halo"), ("dark_offset", "intensity_gradient")
    # The ladder separates them better although its dark offset is smaller.
    assert ladder.limits.distances[halo] > one.limits.distances[halo]
    alike = [one_pair.pair for one_pair in one.limits.alike]
    assert leak in alike and one.limits.distances[leak] < 1 < ALIKE < ladder.limits.distances[leak]
    assert "a series of exposure times at one pointing" in one.limits.alike[alike.index(leak)].would_separate
    # What cannot be planned is named with its reason.
    assert "same gain mode" in one.limits.untestable["gain_mismatch"]
    two = replace(plan_with(ONE), shots=plan_with(ONE).shots[:2])
    with pytest.raises(DataError, match=r"at least 3 images.* got 2"):
        planned_limits(two, diffraction(), library=FEW)


def test_a_plan_as_json() -> None:
    content = planned(LADDER).as_json()
    assert content["schema"] == "gap-plan/1"
    assert content["plan"]["images"] == IMAGES
    first = {"pointing": 1, "view": "east_limb", "images": IMAGES // 3, "exposures_s": list(LADDER)}
    assert content["plan"]["pointings"][0] == first
    strength = strength_of(planned(LADDER), "dark_offset")
    offset = {"parameter": "offset", "unit": "DN", "found_90": strength}
    assert content["limits"]["dark_offset"] == offset
    level = content["limits"]["intensity_gradient"]["parameters"]["level"]
    assert level["found_90"] > 0 and "excluded_95" not in level
    distances = [one["distance"] for one in content["distances"]]
    assert len(distances) == 3 and distances == sorted(distances)
    assert content["searched"] == ["wide_halo"]


def test_text_and_page_name_every_effect_and_pair() -> None:
    plan = planned(ONE)
    html = plan_page(plan)
    check_stands_alone(html)
    (page,) = (tag.text for tag in read_page(html) if tag.name == "body")
    text = "\n".join(lines(plan))
    for name in (*plan.limits.effects, *plan.limits.untestable):
        assert name in text and name.replace("_", " ") in page
    for pair in plan.limits.alike:
        assert pair.would_separate in text and pair.would_separate in page
    assert f"{strength_of(plan, 'dark_offset'):.3g}" in text and "wide_halo*" in text
    cells = [tag.text for tag in read_page(html) if tag.name == "td"]
    assert all(f"{distance:.1f}" in cells for distance in plan.limits.distances.values())
    hidden = EffectLimits((ParameterLimits("offset", "DN", 2.0, None, None),))
    strong = EffectLimits((ParameterLimits("share", "", 0.1, 0.2, None),))
    limits = replace(
        planned(LADDER).limits, effects={"dark_offset": hidden, "wide_halo": strong}, alike=(), untestable={}
    )
    plan = replace(planned(LADDER), left_out={}, limits=limits)
    text, html = "\n".join(lines(plan)), plan_page(plan)
    assert f"offset: {NOT_FOUND}" in text and "share 0.2" in text and "would show 0 of 2 effects" in text
    assert "could not be tested" not in html and "not usable" not in text
    assert "no pair of the effects that would be found looks alike" in text
    # No sentence is made from an observation that is not known.
    pair = Alike(("dark_offset", "wide_halo"), 1.4, "")
    text = "\n".join(lines(replace(plan, limits=replace(limits, alike=(pair,)))))
    assert "  1.40  dark_offset and wide_halo\n" in text + "\n" and "take" not in text
