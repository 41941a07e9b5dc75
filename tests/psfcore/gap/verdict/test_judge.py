"""The verdict, on linear models with known effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel, Step, Vector
from psfcore.gap.library.detector import EFFECTS
from psfcore.gap.verdict import judge as judging
from psfcore.gap.verdict.judge import (
    Freedom,
    Judgement,
    Tried,
    _best_pair,
    _explains_more,
    _few_numbers_do,
    _in_place_of_one,
    _left,
    _worse_held_out,
    fitted,
    left_chi2,
    no_refit,
)
from psfcore.scatter.inversion import Solution, invert
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from tests.psfcore.gap.linear_models import FEW, about_fit_with, with_residuals
from tests.transit_files import TRUTH, diffraction


def test_a_second_effect_is_named_if_it_gains_more_than_a_search_allows(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    def second(dark: float, smear: float, for_real: float = np.inf) -> Tried | None:
        """for_real: chi2 of the discs after a full refit of the first effect."""
        model = with_residuals(evidence, {"dark_offset": dark, "column_smear": smear}, noise=1.0)
        best = max((fitted(model, [effect]) for effect in evidence.effects), key=lambda t: t.score)
        assert best.names == ("dark_offset",)
        before = _left(model, model.base, np.zeros(len(model.base.columns)))
        best = replace(best, left_for_real=np.array([for_real, np.inf]))
        return _best_pair(model, best, before, no_refit, enough=True)

    smear = evidence.columns["column_smear"][0]
    model = with_residuals(evidence, {})
    sigma = float(np.sqrt(model.fit([smear]).covariance[-1, -1]))
    found = second(10.0, 8.0 * sigma)
    assert found is not None and set(found.names) == {"dark_offset", "column_smear"}
    assert second(10.0, 1.0 * sigma) is None
    # What only the full refit of the first effect explains is not credited to the smear.
    both = with_residuals(evidence, {"dark_offset": 10.0, "column_smear": 8.0 * sigma}, noise=1.0)
    discs = float(left_chi2(both, found.step)[0])
    assert second(10.0, 8.0 * sigma, for_real=discs) is None
    # The error of form of so large an offset is larger than the smear,
    assert second(1000.0, 8.0 * sigma) is None
    # also if the offset explains as much in the discs, but not if it does in the unocculted field: the smear shows in
    # the discs.
    for more, names in (((1e6, 0.0), None), ((0.0, 1e6), {"dark_offset", "column_smear"})):

        def chi2_of(model: LinearModel, step: Step, more: tuple[float, float] = more) -> Vector:
            return left_chi2(model, step) + (np.array(more) if step is model.base else 0.0)

        monkeypatch.setattr(judging, "left_chi2", chi2_of)
        found = second(10.0, 8.0 * sigma)
        assert (None if found is None else set(found.names)) == names


def test_a_possible_replacement_of_one_member_of_a_pair_is_named(solution: Solution) -> None:
    again = replace(next(e for e in FEW if e.name == "column_smear"), name="smear_again")
    gradient = next(e for e in EFFECTS if e.name == "intensity_gradient")
    evidence = gather(solution, (*FEW, again, gradient))
    plain = with_residuals(evidence, {})
    strong = {
        name: 30.0 * float(np.sqrt(plain.fit([evidence.columns[name][0]]).covariance[-1, -1]))
        for name in ("dark_offset", "column_smear")
    }
    model = with_residuals(evidence, strong, noise=1.0)
    pair = fitted(model, [e for e in evidence.effects if e.name in strong])
    instead = _in_place_of_one(model, pair)
    assert {name: list(one) for name, one in instead.items()} == {
        "dark_offset": [],
        "column_smear": ["smear_again"],
    }
    assert set(instead["column_smear"]["smear_again"].names) == {"dark_offset", "smear_again"}
    model = replace(
        model, evidence=replace(model.evidence, effects=tuple(e for e in evidence.effects if e is not again))
    )
    assert _in_place_of_one(model, pair) == {"dark_offset": {}, "column_smear": {}}


def test_effects_that_are_tied_under_another_floor_are_in_the_answer(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = with_residuals(evidence, {"dark_offset": 100.0})
    pair = fitted(model, evidence.effects)

    def under(one: LinearModel, *_: object) -> Judgement:
        found = Judgement("attributed", pair.names, 0.0, (pair,), (), pair)
        if one.floor >= model.floor:
            return found
        answer = (*pair.names, "persistence")
        return replace(found, verdict="tie", answer=answer, certain=("dark_offset",))

    monkeypatch.setattr(judging, "_judge", under)
    monkeypatch.setattr(judging, "_worse_held_out", lambda *_: False)
    found = judging.judge(model)
    assert found.verdict == "tie" and set(found.answer) == {"dark_offset", "column_smear", "persistence"}
    assert found.certain == ("dark_offset",) and set(found.tied) == {"column_smear", "persistence"}


@pytest.mark.parametrize("lost", [0, 1])
def test_the_residuals_of_a_refit_count_if_it_has_the_same_images(evidence: Evidence, lost: int) -> None:
    """An offset, and noise that it does not explain, so that a refit is requested."""
    model = with_residuals(evidence, {"dark_offset": 100.0}, noise=3.0)
    again = about_fit_with("dark_offset", model, left=0.9)
    discs = again.evidence.discs[lost:]
    again = replace(again, evidence=replace(again.evidence, discs=discs))
    tried = fitted(model, [effect for effect in evidence.effects if effect.name == "dark_offset"])
    before = _left(model, model.base, np.zeros(len(model.base.columns)))
    found = judging._with_left(model, tried, before, lambda tried: again)
    if lost:
        assert found.left_for_real is None
    else:
        nothing = left_chi2(model, model.base)[0]
        assert found.left_for_real is not None
        assert found.left_for_real[0] == pytest.approx(0.9**2 * nothing, rel=0.05)
    assert judging._with_left(model, tried, before, no_refit).left_for_real is None


@pytest.mark.parametrize("does", [True, False])
def test_an_answer_that_fails_in_a_full_refit_is_excluded(evidence: Evidence, does: bool) -> None:
    model = with_residuals(evidence, {"dark_offset": 100.0})

    def refit(tried: Tried) -> LinearModel:
        """The refit with the effect leaves nothing, or everything."""
        return about_fit_with(tried.names[0], model, left=0.0 if does else 1.0)

    found = judging.judge(model, refit)
    assert ("dark_offset" in found.answer) is does
    assert found.amiss[:1] == (() if does else ("dark_offset",))
    assert does or "dark_offset" in [tried.label for tried in found.tried][-len(found.amiss) :]
    # The evidence for a gap stays.
    assert found.p_value < 1e-6


def test_an_answer_without_a_full_refit_is_excluded(evidence: Evidence) -> None:
    model = with_residuals(evidence, {"dark_offset": 100.0})
    found = judging.judge(model, lambda tried: None)
    assert found.verdict in ("unknown", "inconclusive") and found.amiss[0] == "dark_offset"
    assert judging.judge(model).answer == ("dark_offset",)


def test_a_tied_effect_that_fails_in_a_full_refit_is_excluded(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = with_residuals(evidence, {"dark_offset": 100.0})
    best, other = (fitted(model, [effect]) for effect in evidence.effects)
    tie = Judgement("tie", ("column_smear", "dark_offset"), 0.0, (best, other), (), best)
    monkeypatch.setattr(judging, "_fails_for_real", lambda model, tried, refit: tried is other)
    found, fallen = judging._without_those_that_fail(model, tie, lambda tried: None)
    assert (found.verdict, found.answer, fallen) == ("attributed", best.names, [other])


def test_an_excluded_effect_is_not_named_as_a_second_effect(evidence: Evidence) -> None:
    """The model with the first effect knows all effects; the judged model no longer contains the smear."""
    whole = with_residuals(evidence, {"dark_offset": 10.0, "column_smear": 0.3})
    offset, smear = evidence.effects
    first = fitted(whole, [offset])
    base = (*evidence.base, *evidence.columns["dark_offset"])
    rest = replace(whole, evidence=replace(whole.evidence, base=base, effects=(smear,)))
    known = judging._beside(whole, first, lambda tried: rest)
    assert known is not None and known.answer == ("column_smear", "dark_offset")
    alone = replace(whole, evidence=replace(whole.evidence, effects=(offset,)))
    found = judging._beside(alone, first, lambda tried: rest)
    assert found is None or found.answer in ((), ("dark_offset",))


@pytest.fixture(scope="module")
def with_unocculted(solution: Solution) -> Evidence:
    """Three effects, the first of which is treated as measured in the unocculted field and changes no disc."""
    gradient = [effect for effect in EFFECTS if effect.name == "intensity_gradient"]
    found = gather(solution, (*gradient, *FEW))
    own = list(found.columns["intensity_gradient"])
    discs = []
    for disc in found.discs:
        jacobian = disc.jacobian.copy()
        jacobian[own] = 0.0
        discs.append(replace(disc, jacobian=jacobian))
    found.unocculted.errors[own] = np.arange(found.unocculted.levels.shape[0])[:, None]
    return replace(found, discs=tuple(discs), numbers=dict.fromkeys(own, 5))


@pytest.mark.parametrize("found_well", [True, False])
def test_a_gap_in_the_discs_is_not_attributed_to_an_effect_that_they_do_not_show(
    with_unocculted: Evidence, monkeypatch: pytest.MonkeyPatch, found_well: bool
) -> None:
    """One effect explains the unocculted field, and the discs show a gap of unknown cause."""
    taken = tuple(
        replace(one, described=found_well or n > 0) for n, one in enumerate(with_unocculted.image_info)
    )
    model = LinearModel(replace(with_unocculted, image_info=taken), FLOOR)
    first, other = (fitted(model, [effect], any_sign=True) for effect in with_unocculted.effects[:2])
    unknown = Judgement("unknown", (), 1e-9, (), (), other)
    monkeypatch.setattr(judging, "_judge", lambda *some: unknown)
    found = judging._beside(model, first, lambda tried: model)
    # If an occulter's place is unreliable, a change of the scene around it may cause the gap.
    if found_well:
        assert found is not None and (found.verdict, found.discs_unexplained) == ("inconclusive", True)
    else:
        assert found is None
    assert judging._beside(model, other, lambda tried: model) is None


def test_two_effects_may_act_in_the_discs_with_one_in_the_unocculted_field(
    with_unocculted: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = with_residuals(with_unocculted, {"dark_offset": 10.0, "column_smear": 0.3})
    # Keep all parameters of the first effect, as for a Sun that changes much.
    monkeypatch.setattr(judging, "_not_worth_its_numbers", lambda *some: None)
    first, two = fitted(model, with_unocculted.effects[:1]), fitted(model, with_unocculted.effects[1:])
    for verdict, certain in (("attributed", ()), ("tie", ("dark_offset",))):
        second = Judgement(verdict, two.names, 1e-9, (two,), (), two, certain)  # type: ignore[arg-type]
        monkeypatch.setattr(judging, "_judge", lambda *some, second=second: second)
        found = judging._beside(model, first, lambda tried: model)
        assert found is not None and found.best is not None
        assert found.verdict == verdict and found.best.names == (*first.names, *two.names)
        assert set(found.answer) == {*first.names, *two.names}
        assert found.certain == ((*first.names, "dark_offset") if certain else ())
    alone = fitted(model, with_unocculted.effects[1:2])
    assert judging._beside(model, alone, lambda tried: model) is None  # the discs show it


def test_an_always_fitted_effect_does_not_count_as_part_of_another_effect(
    with_unocculted: Evidence,
) -> None:
    """An offset that leaves much unexplained, with an always fitted effect that was measured in the unocculted field."""
    base = (*with_unocculted.base, *with_unocculted.columns["intensity_gradient"])
    rest = replace(with_unocculted, base=base, effects=with_unocculted.effects[1:])
    found = judging._judge(with_residuals(rest, {"dark_offset": 30.0}, noise=3.0), no_refit, no_refit)
    assert found.best is not None and found.best.names == ("dark_offset",)
    assert found.verdict == "unknown"


def test_a_probe_counts_if_it_explains_more_but_not_if_it_has_fewer_parameters() -> None:
    def tried(gain: float, numbers: int) -> Tried:
        step = Step((), np.zeros(0), np.zeros((0, 0)), gain)
        values = {str(k): (1.0, 1.0, "") for k in range(numbers)}
        return Tried(("x",), True, values, gain, gain - 2 * numbers, 0.0, Freedom(1, 1, 1), step)

    effect = tried(45.0, 3)
    assert not _explains_more(tried(45.5, 1), effect)
    assert not _explains_more(tried(60.0, 12), effect)
    assert _explains_more(tried(60.0, 2), effect)
    # Eight more parameters gain 17.5 from noise once in forty times, and 30 hardly ever.
    assert tried(62.5, 11).score > effect.score
    assert not _explains_more(tried(62.5, 11), effect)
    assert _explains_more(tried(75.0, 11), effect)


def test_an_effect_of_few_parameters_precedes_one_measured_in_the_unocculted_field() -> None:
    def tried(name: str, gain: float) -> Tried:
        step = Step((), np.zeros(0), np.zeros((0, 0)), gain)
        return Tried((name,), True, {}, gain, gain, 0.0, Freedom(1, 1, 1), step)

    measured, few, other = tried("measured", 1000.0), tried("few", 870.0), tried("other", 800.0)
    assert _few_numbers_do([measured, few, other], {"measured"})
    assert not _few_numbers_do([measured, other], {"measured"})
    assert not _few_numbers_do([measured], {"measured"})
    assert not _few_numbers_do([few, other], {"measured"})


@pytest.mark.parametrize(
    ("images", "name", "offset_dn", "worse"),
    [
        (15, "dark_offset", 3.0, False),
        (15, "intensity_gradient", 0.0, True),
        # No fold has two neighbours, so the unocculted blocks are not tested on held-out images.
        (9, "dark_offset", 3.0, False),
    ],
)
def test_an_effect_that_fits_noise_predicts_held_out_images_worse_than_none(
    images: int, name: str, offset_dn: float, worse: bool
) -> None:
    """A real offset, and a three-parameter effect fitted to noise."""
    plan = default_plan(images, 160, oversampling=1, brightness=4.0)
    transit = simulate(plan, TRUTH, diffraction(), seed=5).transit
    frames = tuple(replace(f, pixels=f.pixels + np.float32(offset_dn / f.exposure_s)) for f in transit.frames)
    effects = [effect for effect in EFFECTS if effect.name == name]
    model = LinearModel(gather(invert(replace(transit, frames=frames)), effects), FLOOR)
    best = fitted(model, effects)
    assert best.gain > 0
    answer = Judgement("attributed", best.names, 0.0, (best,), (), best)
    assert _worse_held_out(model, answer, no_refit) is worse
