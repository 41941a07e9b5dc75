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
    """r of Eq. (1) of cells, computed forwards."""
    optics, dark = solution.optics, solution.sky.dark[n]
    lanes = optics.lanes(np.ascontiguousarray(image, dtype=np.float32))
    scene = optics.undo(lanes, optics.undo_once(lanes), steps=1)
    put(scene, dark, 0.0)
    return pick(lanes, dark) - pick(optics.see(scene), dark)


def test_every_dark_pixel_belongs_to_one_cell(solution: Solution) -> None:
    n = solution.part[3]
    place = solution.sky.found[n].place
    cells = cells_of(solution.sky.dark[n], place.x_px, place.y_px)
    assert cells.pixels.sum() == solution.sky.dark[n][0].size
    assert np.allclose(cells.weights.sum(axis=1), 1.0)
    assert cells.pixels.size == 13 and cells.radius.max() < 1.0


def test_a_sensitivity_is_the_adjoint_of_the_whole_estimate(solution: Solution) -> None:
    n = solution.part[3]
    place = solution.sky.found[n].place
    cells = cells_of(solution.sky.dark[n], place.x_px, place.y_px)
    planes = sensitivities(solution.optics, solution.sky.dark[n], cells.weights)
    image = np.random.default_rng(1).normal(size=solution.transit.shape).astype(np.float32)
    forwards = cells.weights @ left_in_disc(solution, n, image)
    backwards = np.einsum("cyx,yx->c", planes, image)
    assert backwards == pytest.approx(forwards, abs=1e-4)


def test_sensitivities_predict_the_effect_of_an_added_error(solution: Solution) -> None:
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


def test_a_disc_does_not_show_a_global_gain(solution: Solution) -> None:
    view = View(solution)
    n = solution.part[2]
    found, planes = disc_cells(solution, n)
    moved = np.einsum("cyx,yx->c", planes, view.expected[n])
    assert np.abs(moved).max() < 0.01 * float(found.expected.mean())


def test_a_gain_is_the_decrease_of_chi2_of_a_plain_least_squares_fit(evidence: Evidence) -> None:
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


def test_gain_minus_cost_of_a_random_field_is_its_log_likelihood_ratio(solution: Solution) -> None:
    evidence = gather(solution, [effect for effect in EFFECTS if effect.name == "flat_field_residual"])
    bare = replace(
        evidence, unocculted=replace(evidence.unocculted, part=np.zeros(len(evidence.image_info), dtype=bool))
    )
    model = LinearModel(bare, FLOOR)
    (effect,) = bare.effects
    residual = np.concatenate([disc.residual for disc in model.discs])
    jacobian = np.concatenate([disc.jacobian for disc in model.discs], axis=1)
    base, columns = list(bare.base), list(bare.columns[effect.name])
    # Remove the component that the PSF's coordinates absorb; the rest has unit noise.
    free = scipy.linalg.null_space(jacobian[base])
    seen = (jacobian[columns] @ free).T * [parameter.likely for parameter in effect.parameters]
    ours, nothing = (
        multivariate_normal(np.zeros(free.shape[1]), np.eye(free.shape[1]) + more).logpdf(residual @ free)
        for more in (seen @ seen.T, 0.0)
    )
    tried = fitted(model, [effect])
    assert tried.score == pytest.approx(2 * (ours - nothing), abs=1e-3)
    assert tried.gain > 0 and tried.gain - tried.score > 1.0
    # The p-value of a gain agrees with many noise realisations.
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
    """A model whose discs show these effects and noise times this factor; the unocculted field is not used."""
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


def test_the_prior_also_counts_what_was_subtracted_from_the_images(
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


def about_fit_with(name: str, model: LinearModel, *, left: float) -> LinearModel:
    """The model of a full refit with an effect: this fraction of the residuals is left, and the effect changes them no more."""
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


def test_the_gain_of_means_is_that_of_a_free_brightness_of_each_disc(evidence: Evidence) -> None:
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


def test_blocks_recover_an_added_effect_whatever_the_brightness(solution: Solution) -> None:
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


def test_a_copy_is_found_at_its_place(clean: Transit) -> None:
    dx, dy = 66, -30
    frames = tuple(
        replace(f, pixels=f.pixels + 0.05 * displaced(gaussian_filter(f.pixels, 4.0), dx, dy))
        for f in clean.frames
    )
    blur, x, y = PlaceSearch(View(invert(replace(clean, frames=frames)))).copy
    assert (x, y) == pytest.approx((dx, dy), abs=6) and blur in (2.0, 4.0, 8.0)


def test_percentages_refer_to_the_observed_light_after_a_subtraction(evidence: Evidence) -> None:
    """After the subtraction of an effect a disc may have a negative mean."""
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


def test_the_interval_of_closure_contains_its_known_errors() -> None:
    ones = np.ones(6)

    def held_out(chi2: float, expected: float, unocculted: float = 0.0) -> HeldOut:
        return HeldOut(
            tuple(range(6)), chi2 * ones, expected * ones, unocculted * ones, 0 * ones, 0 * ones, ones
        )

    before, after = held_out(110.0, 10.0), held_out(30.0, 10.0)
    # All images are equal, so the interval contains only the error of form.
    same = closure(before, after, np.random.default_rng(1))
    assert same is not None
    assert (same.low, same.value, same.high) == pytest.approx((0.79, 0.80, 0.81))
    # Of the remaining 20, 15 come from errors of the parameters.
    unsure = closure(before, held_out(30.0, 25.0), np.random.default_rng(1))
    assert unsure is not None and (unsure.value, unsure.high) == pytest.approx((0.80, 0.96))
    # A noise scale with an error of 20 % widens the interval on both sides.
    wide = closure(before, after, np.random.default_rng(1), 0.2)
    assert wide is not None and wide.low < same.low - 0.02 and same.high + 0.02 < wide.high <= 1.01
    # The unocculted blocks count if they show more of the gap and the effect explains them.
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


def test_deviance_is_the_log_likelihood_of_a_fold() -> None:
    rng = np.random.default_rng(2)
    left, jacobian, root = rng.normal(size=7), rng.normal(size=(3, 7)), rng.normal(size=(3, 3))
    covariance = root @ root.T
    spread = np.eye(7) + jacobian.T @ covariance @ jacobian
    expected = -2 * multivariate_normal(cov=spread).logpdf(left) - 7 * np.log(2 * np.pi)
    assert _deviance(left, jacobian, covariance) == pytest.approx(expected)
    assert _deviance(left, jacobian[:0], covariance[:0, :0]) == pytest.approx(left @ left)


def test_a_decrease_of_deviance_uses_the_common_folds() -> None:
    ones = np.ones(2)
    before, after = (
        HeldOut((0, 1), ones, ones, ones, ones, ones, ones, of_folds)
        for of_folds in ({(0,): 30.0, (1,): 20.0}, {(0,): 12.0, (2,): 1.0})
    )
    assert fall(before, after) == 18.0


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
