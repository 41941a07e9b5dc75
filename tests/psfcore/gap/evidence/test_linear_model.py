"""The linear algebra of the gap: cells, lit blocks, gains, shares, searches, each against something plainly right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from scipy.ndimage import gaussian_filter
from scipy.stats import multivariate_normal

from psfcore.gap.evidence.cells import cells_of, disc_cells, sensitivities
from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.linear_model import FLOOR, UNLIKELY, LinearModel, Step, Vector
from psfcore.gap.evidence.search import PlaceSearch, displaced
from psfcore.gap.library.detector import EFFECTS
from psfcore.gap.verdict import judge as judging
from psfcore.gap.verdict.closure import HeldOut, _deviance, closure, fall, gap, hold_out, time_blocks
from psfcore.gap.verdict.correction import _with_noise_of
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
from psfcore.gap.verdict.where import _shapley
from psfcore.gap.view import View
from psfcore.scatter.inversion import Solution, invert
from psfcore.scatter.optics import pick, put
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import Transit
from tests.transit_files import TRUTH, diffraction

FEW = tuple(effect for effect in EFFECTS if effect.name in ("dark_offset", "column_smear"))


@pytest.fixture(scope="module")
def clean() -> Transit:
    plan = default_plan(9, 160, oversampling=1, brightness=4.0)
    return simulate(plan, TRUTH, diffraction(), seed=5).transit


@pytest.fixture(scope="module")
def solution(clean: Transit) -> Solution:
    return invert(clean)


@pytest.fixture(scope="module")
def evidence(solution: Solution) -> Evidence:
    return gather(solution, FEW)


def left_in_disc(solution: Solution, n: int, image: np.ndarray) -> np.ndarray:
    """r of Eq. (1) of cells, forwards."""
    optics, dark = solution.optics, solution.sky.dark[n]
    lanes = optics.lanes(np.ascontiguousarray(image, dtype=np.float32))
    scene = optics.undo(lanes, optics.undo_once(lanes), steps=1)
    put(scene, dark, 0.0)
    return pick(lanes, dark) - pick(optics.see(scene), dark)


def test_cells_share_out_all_dark_pixels(solution: Solution) -> None:
    n = solution.part[3]
    place = solution.sky.found[n].place
    cells = cells_of(solution.sky.dark[n], place.x_px, place.y_px)
    assert cells.pixels.sum() == solution.sky.dark[n][0].size
    assert np.allclose(cells.weights.sum(axis=1), 1.0)
    assert cells.pixels.size == 13 and cells.radius.max() < 1.0


def test_a_sensitivity_is_the_whole_estimate_backwards(solution: Solution) -> None:
    n = solution.part[3]
    place = solution.sky.found[n].place
    cells = cells_of(solution.sky.dark[n], place.x_px, place.y_px)
    planes = sensitivities(solution.optics, solution.sky.dark[n], cells.weights)
    image = np.random.default_rng(1).normal(size=solution.transit.shape).astype(np.float32)
    forwards = cells.weights @ left_in_disc(solution, n, image)
    backwards = np.einsum("cyx,yx->c", planes, image)
    assert backwards == pytest.approx(forwards, abs=1e-4)


def test_an_added_error_moves_the_residual_as_its_sensitivity_says(solution: Solution) -> None:
    n = solution.part[3]
    found, planes = disc_cells(solution, n)
    error = np.full(solution.transit.shape, 5.0, np.float32)
    place = solution.sky.found[n].place
    weights = cells_of(solution.sky.dark[n], place.x_px, place.y_px).weights
    optics, dark = solution.optics, solution.sky.dark[n]
    lanes = optics.lanes(solution.transit.frames[n].pixels + error)
    scene = optics.undo(lanes, steps=8)
    put(scene, dark, 0.0)
    after = weights @ (pick(lanes, dark) - pick(optics.see(scene), dark))
    expected = np.einsum("cyx,yx->c", planes, error)
    assert np.abs(expected).max() > 0.5
    assert after - found.residual == pytest.approx(expected, abs=0.05 * float(np.abs(expected).max()))


def test_a_global_gain_cannot_be_seen_in_a_disc(solution: Solution) -> None:
    view = View(solution)
    n = solution.part[2]
    found, planes = disc_cells(solution, n)
    moved = np.einsum("cyx,yx->c", planes, view.expected[n])
    assert np.abs(moved).max() < 0.01 * float(found.expected.mean())


def test_a_gain_is_the_fall_of_a_plain_least_squares_fit(evidence: Evidence) -> None:
    bare = replace(
        evidence, unocculted=replace(evidence.unocculted, part=np.zeros(len(evidence.image_info), dtype=bool))
    )
    model = LinearModel(bare, 0.003)
    columns = evidence.columns["dark_offset"]

    def chi2(here: list[int]) -> float:
        design, target = [], []
        for disc in evidence.discs:
            covariance = disc.covariance + 0.003**2 * np.outer(disc.expected, disc.expected)
            white = np.linalg.inv(np.linalg.cholesky(covariance))
            design.append(white @ disc.jacobian[here].T)
            target.append(white @ disc.residual)
        # The prior of the effect's parameter is a measurement of 0.
        likely = next(e for e in evidence.effects if e.name == "dark_offset").parameters[0].likely
        prior = [[1 / (UNLIKELY * likely) if c in columns else 0.0 for c in here]]
        a, b = np.vstack([*design, prior]), np.concatenate([*target, [0.0]])
        solved = np.linalg.lstsq(a, b, rcond=None)[0]
        return float(np.sum((b - a @ solved) ** 2))

    base = list(evidence.base)
    assert model.gain(model.fit(columns)) == pytest.approx(
        chi2(base) - chi2([*base, *columns]), rel=1e-4, abs=1e-6
    )


def test_a_field_s_gain_less_its_cost_is_how_much_likelier_it_makes_the_discs(solution: Solution) -> None:
    evidence = gather(solution, [effect for effect in EFFECTS if effect.name == "flat_field_residual"])
    bare = replace(
        evidence, unocculted=replace(evidence.unocculted, part=np.zeros(len(evidence.image_info), dtype=bool))
    )
    model = LinearModel(bare, FLOOR)
    (effect,) = bare.effects
    residual = np.concatenate([disc.residual for disc in model.discs])
    jacobian = np.concatenate([disc.jacobian for disc in model.discs], axis=1)
    base, columns = list(bare.base), list(bare.columns[effect.name])
    # What the PSF's own coordinates absorb is not looked at, and the rest has unit noise.
    free = scipy.linalg.null_space(jacobian[base])
    seen = (jacobian[columns] @ free).T * [parameter.likely for parameter in effect.parameters]
    ours, nothing = (
        multivariate_normal(np.zeros(free.shape[1]), np.eye(free.shape[1]) + more).logpdf(residual @ free)
        for more in (seen @ seen.T, 0.0)
    )
    tried = fitted(model, [effect])
    assert tried.score == pytest.approx(2 * (ours - nothing), abs=1e-3)
    assert tried.gain > 0 and tried.gain - tried.score > 1.0
    # Noise alone gains as much by chance as often as it does in many draws of it.
    rng = np.random.default_rng(2)
    inverse = np.linalg.inv(np.eye(len(columns)) + seen.T @ seen)
    scores = rng.standard_normal((4000, free.shape[1])) @ seen
    gains = np.einsum("nk,kl,nl->n", scores, inverse, scores)
    shares = np.linalg.eigvalsh(seen.T @ seen)
    shares /= 1 + shares
    by_chance = Freedom(float(shares.sum()), float((shares**2).sum()), 1)
    for often in (0.5, 0.1, 0.02):
        at = float(np.quantile(gains, 1 - often))
        assert by_chance.p_value(at) == pytest.approx(often, rel=0.25)
    assert Freedom(3, 3, 1).p_value(9.0) == pytest.approx(0.0293, abs=1e-4)


def with_residuals(evidence: Evidence, values: dict[str, float], noise: float = 0.0) -> LinearModel:
    """A model whose discs show these effects' changes and so much of their noise, and no lit part."""
    rng = np.random.default_rng(4)
    theta = np.zeros(evidence.size)
    for name, value in values.items():
        theta[evidence.columns[name][0]] = value
    discs = tuple(
        replace(
            disc,
            residual=disc.jacobian.T @ theta
            + noise
            * rng.multivariate_normal(np.zeros(disc.expected.size), disc.covariance, check_valid="ignore"),
        )
        for disc in evidence.discs
    )
    unocculted = replace(evidence.unocculted, part=np.zeros(len(evidence.image_info), dtype=bool))
    return LinearModel(replace(evidence, discs=discs, unocculted=unocculted), FLOOR)


def test_what_was_taken_out_of_the_images_counts_against_the_prior_of_what_is_left(
    evidence: Evidence,
) -> None:
    columns = evidence.columns["dark_offset"]
    whole = with_residuals(evidence, {"dark_offset": 400.0}).fit(columns)
    first = len(evidence.base)
    left = with_residuals(evidence, {"dark_offset": 100.0})
    step = left.fit(columns)
    taken_out = np.concatenate([np.zeros(first), [300.0]])
    found = 300.0 + step.values - left.pull_of_prior(step, taken_out)
    assert whole.values[first] < 399.0  # the prior, of 20 DN, holds it back
    assert found[first] == pytest.approx(whole.values[first], rel=1e-6)


def test_another_effect_is_named_beside_one_that_is_enough_where_it_gains_more_than_a_search_lets_it(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    def second(dark: float, smear: float, for_real: float = np.inf) -> Tried | None:
        """for_real: what a refit of the first left in the discs."""
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
    # What the first explains in the model for real, and not to first order, is no smear's.
    both = with_residuals(evidence, {"dark_offset": 10.0, "column_smear": 8.0 * sigma}, noise=1.0)
    discs = float(left_chi2(both, found.step)[0])
    assert second(10.0, 8.0 * sigma, for_real=discs) is None
    # Of so large an offset the form's own error is larger than the smear,
    assert second(1000.0, 8.0 * sigma) is None
    # and so it is of one that explains as much in the discs, but not of one that does in the lit parts: the smear shows
    # in the discs.
    for more, names in (((1e6, 0.0), None), ((0.0, 1e6), {"dark_offset", "column_smear"})):

        def chi2_of(model: LinearModel, step: Step, more: tuple[float, float] = more) -> Vector:
            return left_chi2(model, step) + (np.array(more) if step is model.base else 0.0)

        monkeypatch.setattr(judging, "left_chi2", chi2_of)
        found = second(10.0, 8.0 * sigma)
        assert (None if found is None else set(found.names)) == names


def test_what_would_do_in_place_of_one_of_a_pair_is_named_with_it(solution: Solution) -> None:
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


def test_what_another_floor_cannot_tell_from_one_of_a_pair_is_in_the_answer(
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


def about_fit_with(name: str, model: LinearModel, *, left: float) -> LinearModel:
    """The model about a fit with an effect: so much of the residuals is left, to which the effect answers no more."""
    evidence = model.evidence
    first = len(evidence.base)
    here = [*evidence.base, *evidence.columns[name]]
    discs = tuple(
        replace(
            disc,
            residual=disc.residual * left,
            jacobian=disc.jacobian[here] * (np.arange(len(here)) < first)[:, None],
        )
        for disc in evidence.discs
    )
    unocculted = replace(evidence.unocculted, errors=evidence.unocculted.errors[here])
    effects = tuple(effect for effect in evidence.effects if effect.name == name)
    columns = {name: tuple(range(first, len(here)))}
    return replace(
        model,
        evidence=replace(evidence, discs=discs, unocculted=unocculted, effects=effects, columns=columns),
    )


@pytest.mark.parametrize("lost", [0, 1])
def test_what_a_refit_leaves_counts_where_it_is_of_the_same_images(evidence: Evidence, lost: int) -> None:
    """An offset, and noise that it does not explain, so that a refit is asked for."""
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
def test_an_answer_that_does_not_do_it_in_the_model_for_real_is_none(evidence: Evidence, does: bool) -> None:
    model = with_residuals(evidence, {"dark_offset": 100.0})

    def refit(tried: Tried) -> LinearModel:
        """About the fit with the effect: nothing is left, or all that was there."""
        return about_fit_with(tried.names[0], model, left=0.0 if does else 1.0)

    found = judging.judge(model, refit)
    assert ("dark_offset" in found.answer) is does
    assert found.amiss[:1] == (() if does else ("dark_offset",))
    assert does or "dark_offset" in [tried.label for tried in found.tried][-len(found.amiss) :]
    # What shows a gap shows it still.
    assert found.p_value < 1e-6


def test_an_answer_that_cannot_be_added_to_the_model_is_none(evidence: Evidence) -> None:
    model = with_residuals(evidence, {"dark_offset": 100.0})
    found = judging.judge(model, lambda tried: None)
    assert found.verdict in ("unknown", "inconclusive") and found.amiss[0] == "dark_offset"
    assert judging.judge(model).answer == ("dark_offset",)


def test_of_a_tie_what_fails_in_the_model_for_real_is_left_out(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = with_residuals(evidence, {"dark_offset": 100.0})
    best, other = (fitted(model, [effect]) for effect in evidence.effects)
    tie = Judgement("tie", ("column_smear", "dark_offset"), 0.0, (best, other), (), best)
    monkeypatch.setattr(judging, "_fails_for_real", lambda model, tried, refit: tried is other)
    found, fallen = judging._without_those_that_fail(model, tie, lambda tried: None)
    assert (found.verdict, found.answer, fallen) == ("attributed", best.names, [other])


def test_beside_an_effect_nothing_is_named_that_was_set_aside(evidence: Evidence) -> None:
    """The model with the first in it knows of all effects, the one that is judged no longer of the smear."""
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
    """Of three effects the first taken for one that was measured in the lit parts, which no disc answers to."""
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
def test_a_gap_of_the_discs_is_not_laid_on_what_they_do_not_answer_to(
    with_unocculted: Evidence, monkeypatch: pytest.MonkeyPatch, found_well: bool
) -> None:
    """Beside what shows in the lit parts the discs show a gap of unknown cause."""
    taken = tuple(
        replace(one, described=found_well or n > 0) for n, one in enumerate(with_unocculted.image_info)
    )
    model = LinearModel(replace(with_unocculted, image_info=taken), FLOOR)
    first, other = (fitted(model, [effect], any_sign=True) for effect in with_unocculted.effects[:2])
    unknown = Judgement("unknown", (), 1e-9, (), (), other)
    monkeypatch.setattr(judging, "_judge", lambda *some: unknown)
    found = judging._beside(model, first, lambda tried: model)
    # Where an occulter may be elsewhere, what changes round it may make the gap after all.
    if found_well:
        assert found is not None and (found.verdict, found.discs_unexplained) == ("inconclusive", True)
    else:
        assert found is None
    assert judging._beside(model, other, lambda tried: model) is None


def test_beside_what_the_discs_do_not_answer_to_two_may_act_in_them(
    with_unocculted: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = with_residuals(with_unocculted, {"dark_offset": 10.0, "column_smear": 0.3})
    # All parameters of the first are kept, as a Sun's are that changes much.
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
    assert judging._beside(model, alone, lambda tried: model) is None  # discs answer to it


def test_what_is_fitted_beside_an_effect_does_not_make_it_one_of_the_lit_parts(
    with_unocculted: Evidence,
) -> None:
    """An offset that leaves much unexplained, beside what was measured in the lit parts and is always fitted."""
    base = (*with_unocculted.base, *with_unocculted.columns["intensity_gradient"])
    rest = replace(with_unocculted, base=base, effects=with_unocculted.effects[1:])
    found = judging._judge(with_residuals(rest, {"dark_offset": 30.0}, noise=3.0), no_refit, no_refit)
    assert found.best is not None and found.best.names == ("dark_offset",)
    assert found.verdict == "unknown"


def test_means_fall_by_what_a_brightness_of_each_disc_s_own_explains(evidence: Evidence) -> None:
    model = LinearModel(evidence, 0.003)
    columns = [*evidence.base, *evidence.columns["dark_offset"]]
    step = model.fit(evidence.columns["dark_offset"])
    design = np.concatenate([disc.jacobian[columns] for disc in model.discs], axis=1)
    own = np.zeros((len(model.discs), design.shape[1]))
    start = 0
    for k, (disc, white) in enumerate(zip(evidence.discs, model.discs, strict=True)):
        own[k, start : start + disc.expected.size] = white.white @ disc.expected
        start += disc.expected.size
    left = np.concatenate(model.left(step))

    def chi2(rows: np.ndarray) -> float:
        return float(np.sum((left - rows.T @ np.linalg.lstsq(rows.T, left, rcond=None)[0]) ** 2))

    gain, directions = model.gain_of_patterns(step, model.means, model.left(step))
    assert gain == pytest.approx(chi2(design) - chi2(np.vstack([design, own])), rel=1e-3)
    assert len(model.discs) - len(columns) <= directions <= len(model.discs)


def test_lit_blocks_give_back_what_was_added_and_do_not_mind_brightness(solution: Solution) -> None:
    evidence = gather(solution, FEW)
    (column,) = evidence.columns["dark_offset"]
    unocculted = evidence.unocculted
    before = unocculted.equations([column])
    rng = np.random.default_rng(2)
    waver = 1 + 0.004 * rng.standard_normal(len(evidence.image_info))
    added = replace(unocculted, levels=unocculted.levels * waver[:, None] + 1.5 * unocculted.errors[column])
    after = added.equations([column])
    found, was = (float(e.score[0] / e.normal[0, 0]) for e in (after, before))
    assert found - was == pytest.approx(1.5, abs=0.15)


def test_shares_are_averages_over_orders() -> None:
    worth = {(): 0.0, ("a",): 1.0, ("b",): 2.0, ("a", "b"): 2.5}
    shares = _shapley(["a", "b"], worth)
    assert shares == pytest.approx({"a": 0.75, "b": 1.75})  # (1 + 0.5) / 2 and (2 + 1.5) / 2


def test_a_copy_and_a_patch_are_found_where_they_are(clean: Transit) -> None:
    dx, dy = 66, -30
    frames = tuple(
        replace(f, pixels=f.pixels + 0.05 * displaced(gaussian_filter(f.pixels, 4.0), dx, dy))
        for f in clean.frames
    )
    blur, x, y = PlaceSearch(View(invert(replace(clean, frames=frames)))).copy
    assert (x, y) == pytest.approx((dx, dy), abs=6) and blur in (2.0, 4.0, 8.0)


def test_percents_are_of_the_light_that_was_observed_whatever_was_taken_out(evidence: Evidence) -> None:
    """With an effect's light taken out a disc may be left with less than none."""
    taken_out = replace(
        evidence, discs=tuple(replace(disc, residual=-1.5 * disc.expected) for disc in evidence.discs)
    )
    assert all(disc.observed < 0 for disc in taken_out.discs)
    before, after = evidence, _with_noise_of(evidence, taken_out)
    assert [disc.level for disc in after.discs] == [disc.level for disc in before.discs]
    for one in (after, taken_out):
        model = LinearModel(one, FLOOR)
        held_out = hold_out(model, (), time_blocks(model))
        assert held_out is not None and held_out.noise_pct.min() > 0


def test_closure_and_gap_by_hand() -> None:
    rng = np.random.default_rng(1)
    ones = np.ones(4)

    def held_out(chi2: list[float], residual: list[float]) -> HeldOut:
        return HeldOut((0, 1, 2, 3), np.array(chi2), 10 * ones, 0 * ones, 0 * ones, np.array(residual), ones)

    before, after = held_out([110.0] * 4, [5.0] * 4), held_out([20.0] * 4, [1.0] * 4)
    found = closure(before, after, rng)
    assert found is not None and found.value == pytest.approx(0.9)  # 1 - 10 / 100
    assert gap(before, rng).value == pytest.approx(np.sqrt(24.0))
    assert gap(after, rng).value == 0.0
    assert closure(held_out([9.0] * 4, [0.0] * 4), after, rng) is None


def test_the_interval_of_closure_holds_what_the_cause_would_close() -> None:
    ones = np.ones(6)

    def held_out(chi2: float, expected: float, unocculted: float = 0.0) -> HeldOut:
        return HeldOut(
            tuple(range(6)), chi2 * ones, expected * ones, unocculted * ones, 0 * ones, 0 * ones, ones
        )

    before, after = held_out(110.0, 10.0), held_out(30.0, 10.0)
    # All images alike: nothing is drawn but the form's error.
    same = closure(before, after, np.random.default_rng(1))
    assert same is not None
    assert (same.low, same.value, same.high) == pytest.approx((0.79, 0.80, 0.81))
    # 15 of the 20 that are left are errors of the parameters.
    unsure = closure(before, held_out(30.0, 25.0), np.random.default_rng(1))
    assert unsure is not None and (unsure.value, unsure.high) == pytest.approx((0.80, 0.96))
    # A scale that is known to 20 % alone: chi2 / 1.2 is less, and as much of the gap's 100 is closed more surely.
    wide = closure(before, after, np.random.default_rng(1), 0.2)
    assert wide is not None and wide.low < same.low - 0.02 and same.high + 0.02 < wide.high <= 1.01
    # The lit blocks are asked where they show more, and the effect is what they show.
    for unocculted_before, unocculted_after, closed in (
        (900.0, 0.0, 0.9),
        (90.0, 0.0, 0.0),
        (900.0, 800.0, 0.0),
    ):
        found = closure(
            held_out(110.0, 10.0, unocculted_before),
            held_out(110.0, 10.0, unocculted_after),
            np.random.default_rng(1),
        )
        assert found is not None and found.value == pytest.approx(closed)


def test_deviance_is_how_likely_a_fold_is_as_the_fit_predicts_it() -> None:
    rng = np.random.default_rng(2)
    left, jacobian, root = rng.normal(size=7), rng.normal(size=(3, 7)), rng.normal(size=(3, 3))
    covariance = root @ root.T
    spread = np.eye(7) + jacobian.T @ covariance @ jacobian
    expected = -2 * multivariate_normal(cov=spread).logpdf(left) - 7 * np.log(2 * np.pi)
    assert _deviance(left, jacobian, covariance) == pytest.approx(expected)
    assert _deviance(left, jacobian[:0], covariance[:0, :0]) == pytest.approx(left @ left)


def test_a_fall_is_of_the_folds_that_both_have() -> None:
    ones = np.ones(2)
    before, after = (
        HeldOut((0, 1), ones, ones, ones, ones, ones, ones, of_folds)
        for of_folds in ({(0,): 30.0, (1,): 20.0}, {(0,): 12.0, (2,): 1.0})
    )
    assert fall(before, after) == 18.0


def test_a_probe_counts_where_it_explains_more_and_not_where_it_has_fewer_numbers() -> None:
    def tried(gain: float, numbers: int) -> Tried:
        step = Step((), np.zeros(0), np.zeros((0, 0)), gain)
        values = {str(k): (1.0, 1.0, "") for k in range(numbers)}
        return Tried(("x",), True, values, gain, gain - 2 * numbers, 0.0, Freedom(1, 1, 1), step)

    effect = tried(45.0, 3)
    assert not _explains_more(tried(45.5, 1), effect)
    assert not _explains_more(tried(60.0, 12), effect)
    assert _explains_more(tried(60.0, 2), effect)
    # Eight numbers more gain 17.5 from noise once in forty times, and 30 hardly ever.
    assert tried(62.5, 11).score > effect.score
    assert not _explains_more(tried(62.5, 11), effect)
    assert _explains_more(tried(75.0, 11), effect)


def test_few_numbers_that_gain_nearly_as_much_go_before_what_was_measured_in_the_lit_parts() -> None:
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
        # No two neighbours in one fold: what the lit blocks show so surely is not asked held out.
        (9, "dark_offset", 3.0, False),
    ],
)
def test_what_fits_by_its_freedom_predicts_held_out_images_worse_than_nothing(
    images: int, name: str, offset_dn: float, worse: bool
) -> None:
    """An offset that is there, and three numbers fitted to noise."""
    plan = default_plan(images, 160, oversampling=1, brightness=4.0)
    transit = simulate(plan, TRUTH, diffraction(), seed=5).transit
    frames = tuple(replace(f, pixels=f.pixels + np.float32(offset_dn / f.exposure_s)) for f in transit.frames)
    effects = [effect for effect in EFFECTS if effect.name == name]
    model = LinearModel(gather(invert(replace(transit, frames=frames)), effects), FLOOR)
    best = fitted(model, effects)
    assert best.gain > 0
    answer = Judgement("attributed", best.names, 0.0, (best,), (), best)
    assert _worse_held_out(model, answer, no_refit) is worse
