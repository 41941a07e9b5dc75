"""The likelihood of hypotheses, compared with dense Gaussian integrals and grids, and what a template error changes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.linalg import null_space
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from psfcore.gap.evidence import likelihood as likelihoods
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.likelihood import Likelihood
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.evidence.one_sided import log_odds_above_zero, log_odds_at_zero, log_of_any_number
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from tests.psfcore.gap.linear_models import dense, effect_of, noise_of, sigma_of, with_left, with_residuals

EXACT = 1e-4  # relative error of the noise scale: so small that the likelihood is Gaussian


@pytest.fixture
def gaussian(monkeypatch: pytest.MonkeyPatch) -> None:
    """Templates without error, and one width of the prior."""
    monkeypatch.setattr(likelihoods, "TEMPLATE_ERRORS", (0.0,))
    monkeypatch.setattr(likelihoods, "SCALES", (1.0,))


def gain(model: LinearModel, *names: str) -> float:
    """ln of the evidence of some effects over that of no effect."""
    likelihood = Likelihood(model)
    columns = [list(model.evidence.columns[name]) for name in names]
    return likelihood.weigh(columns).log_evidence - likelihood.weigh([]).log_evidence


def likely_of(evidence: Evidence, name: str) -> float:
    return effect_of(evidence, name).parameters[0].likely


def free_of_psf(model: LinearModel) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian and residuals of the part of the data that the coordinates of the PSF cannot change."""
    jacobian, residual = dense(model)
    unchanged = null_space(jacobian[:, list(model.evidence.base)].T).T
    return unchanged @ jacobian, unchanged @ residual


def half_normal(values: np.ndarray, width: float) -> np.ndarray:
    return np.asarray(np.sqrt(2 / np.pi) / width * np.exp(-((values / width) ** 2) / 2))


def test_the_evidence_is_the_gaussian_integral(evidence: Evidence, gaussian: None) -> None:
    noisy = replace(with_residuals(evidence, {"dark_offset": 0.3}, noise=1.0), scale_error=EXACT)
    jacobian, seen = free_of_psf(noisy)
    change = likely_of(evidence, "dark_offset") * jacobian[:, evidence.columns["dark_offset"][0]]
    unit = np.eye(seen.size)
    with_effect = multivariate_normal(cov=unit + np.outer(change, change)).logpdf(seen)
    odds = float(with_effect - multivariate_normal(cov=unit).logpdf(seen))
    assert gain(noisy, "dark_offset") == pytest.approx(odds, abs=1e-3)


def test_an_effect_that_can_only_add_light_explains_no_loss_of_light(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its best strength is 0. Its evidence is the integral over all strengths, so that a weak effect is not excluded."""
    monkeypatch.setattr(likelihoods, "SCALES", (1.0,))
    sigma = sigma_of(evidence, "column_smear")
    columns = [list(evidence.columns["column_smear"])[:1]]
    offset = list(evidence.columns["dark_offset"])
    width = likely_of(evidence, "column_smear")
    strengths = np.linspace(0, 20 * width, 20001)
    for lost in (-8 * sigma, -0.5 * sigma):
        model = replace(with_residuals(evidence, {"column_smear": lost}), scale_error=EXACT)
        likelihood = Likelihood(model)
        smear = likelihood.weigh(columns)
        assert smear.columns == ()
        seen = np.exp(((lost / sigma) ** 2 - ((strengths - lost) / sigma) ** 2) / 2)
        odds = math.log(trapezoid(half_normal(strengths, width) * seen, strengths))
        assert smear.log_evidence - likelihood.weigh([]).log_evidence == pytest.approx(odds, abs=0.02)
        assert odds < -0.5
        assert likelihood.weigh([offset, *columns]).log_evidence == -math.inf  # the same as the offset alone
    added = Likelihood(with_residuals(evidence, {"column_smear": 8 * sigma})).weigh(columns)
    assert added.values[0] == pytest.approx(8 * sigma, rel=0.2)


def test_one_sided_parameters_are_integrated_for_every_choice_of_those_that_act(
    evidence: Evidence, gaussian: None
) -> None:
    """Two one-sided shares of a smear, of which one has its best value at 0: either acts, or both, on a grid of values."""
    sigma = sigma_of(evidence, "column_smear")
    below, above = evidence.columns["column_smear"]
    plain = replace(with_residuals(evidence, {"column_smear": 8 * sigma}), scale_error=EXACT)
    # Light is missing above: the best value of the second share is below 0.
    model = with_left(plain, lambda disc: disc.residual - 4 * sigma * disc.jacobian[above])
    jacobian, seen = free_of_psf(model)
    changes = jacobian[:, [below, above]]
    values = np.linspace(0, 30 * sigma, 601)
    steps = (values[1] - values[0]) * np.where(np.arange(values.size) == 0, 0.5, 1.0)
    prior = half_normal(values, likely_of(evidence, "column_smear")) * steps
    normal, (first, second) = changes.T @ changes, changes.T @ seen
    x, y = values[:, None], values[None, :]
    ln_l = first * x + second * y - (normal[0, 0] * x**2 + 2 * normal[0, 1] * x * y + normal[1, 1] * y**2) / 2
    parts = [
        logsumexp(ln_l[:, 0], b=prior),
        logsumexp(ln_l[0], b=prior),
        logsumexp(ln_l, b=prior[:, None] * prior[None, :]),
    ]
    odds = float(logsumexp(parts, b=[1 / 4, 1 / 4, 1 / 2]))
    likelihood = Likelihood(model)
    smear = likelihood.weigh([[below, above]])
    assert smear.columns == (below,)
    assert smear.log_evidence - likelihood.weigh([]).log_evidence == pytest.approx(odds, abs=0.2)
    # The second share costs nothing.
    without = likelihood.weigh([[below]]).log_evidence
    assert without - math.log(4) < smear.log_evidence < without - math.log(4 / 3)


def test_the_odds_of_one_sided_parameters_are_integrals_and_means_over_all_choices() -> None:
    """ln L is a parabola around `best` with the curvature 4; the odds are relative to the value 0."""
    curvature, width = 4.0, 0.7
    values = np.linspace(0, 10, 200001)
    for best in (-3.0, -0.4, 0.0, 0.4, 3.0):
        growth = np.exp(curvature * (best * values - values**2 / 2))
        odds = math.log(trapezoid(half_normal(values, width) * growth, values))
        total = curvature + width**-2
        if best <= 0:
            one = log_odds_at_zero(np.array([curvature * best]), np.array([curvature]), np.array([width]))
        else:
            at, error = np.array([curvature * best / total]), np.array([total**-0.5])
            one = log_odds_above_zero(at, error, np.array([width]))
        assert one[0] == pytest.approx(odds, abs=1e-4), best
    some = np.array([8.0, 0.3, 1e-4, 2.0])
    of_number = [np.mean([math.prod(n) for n in itertools.combinations(some, k)]) for k in range(1, 5)]
    assert log_of_any_number(np.log(some)) == pytest.approx(math.log(np.mean(of_number)))
    with_none = math.log(np.mean([1.0, *of_number]))
    assert log_of_any_number(np.log(some), least=0) == pytest.approx(with_none)
    assert log_of_any_number(np.log(some[:1])) == pytest.approx(
        math.log(8.0)
    )  # a single parameter always acts
    # If all sides had to act, eleven dark sides with odds of 1e-3 each would cost ln 1e33 beside a bright one.
    sides = np.append(np.full(11, math.log(1e-3)), 50.0)
    assert log_of_any_number(sides) == pytest.approx(50.0 - math.log(12 * 12), abs=0.02)


def test_what_an_error_of_the_first_template_explains_is_credited_less_to_a_second_effect(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A weak smear beside a strong offset counts less if the template of the offset is not exact."""
    sigma = sigma_of(evidence, "column_smear")
    weak, strong = (
        Likelihood(with_residuals(evidence, {"dark_offset": size, "column_smear": 20 * sigma}))
        for size in (3.0, 300.0)
    )
    offset, smear = (list(evidence.columns[name]) for name in ("dark_offset", "column_smear"))
    assert weak.weigh([offset]).visible_error < 9 < strong.weigh([offset]).visible_error

    def credit(likelihood: Likelihood, errors: tuple[float, ...]) -> float:
        with monkeypatch.context() as patched:
            patched.setattr(likelihoods, "TEMPLATE_ERRORS", errors)
            alone, both = (likelihood.weigh(some) for some in ([offset], [offset, smear]))
            return both.log_evidence - alone.log_evidence

    exact, usual = (0.0, 0.0), likelihoods.TEMPLATE_ERRORS
    assert credit(weak, usual) == pytest.approx(credit(weak, exact), abs=1)
    assert 100 < credit(strong, usual) < credit(strong, exact) - 10


def test_the_template_error_leaves_out_what_a_change_of_the_psf_absorbs(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A template that also contains a change of the PSF describes the same hypothesis."""
    (offset,), base = evidence.columns["dark_offset"], evidence.base[0]
    plain = with_residuals(evidence, {"dark_offset": 1000.0}, noise=1.0)
    sizes = [np.linalg.norm([disc.jacobian[k].mean() for disc in evidence.discs]) for k in (offset, base)]
    discs = []
    for disc in plain.evidence.discs:
        jacobian = disc.jacobian.copy()
        jacobian[offset] += 5 * sizes[0] / sizes[1] * jacobian[base]
        discs.append(replace(disc, jacobian=jacobian))
    mixed = replace(plain, evidence=replace(plain.evidence, discs=tuple(discs)))
    one, other = (Likelihood(model).weigh([[offset]]).log_evidence for model in (plain, mixed))
    monkeypatch.setattr(likelihoods, "TEMPLATE_ERRORS", (0.0, 0.0))
    exact = Likelihood(plain).weigh([[offset]]).log_evidence
    assert other == pytest.approx(one, abs=0.01)
    assert abs(one - exact) > 1


def test_the_curvature_is_that_of_the_scatter_kernel() -> None:
    """The light in rings around a disc, after a step of a coordinate, minus its first order and what the PSF absorbs."""
    shape, size = SOFTENED_POWER_LAW, 257
    r = np.hypot(*np.mgrid[-128:129, -128:129])
    bounds = (15, 20, 30, 45, 70, 100, 180)
    laws: list[dict[str, float]] = [
        {},
        {"b_px": 3.0, "c": 2.3, "total": 0.3},
        {"b_px": 9.0, "c": 2.8, "total": 0.5},
    ]
    for law in laws:
        at = shape.coordinates(law)

        def light(step: np.ndarray, at: np.ndarray = at) -> np.ndarray:
            kernel = shape.kernel(at + step, size)
            return np.array(
                [kernel[(r >= low) & (r < high)].sum() for low, high in itertools.pairwise(bounds)]
            )

        start, unit = light(np.zeros(at.size)), np.eye(at.size)
        slopes = np.array([(light(1e-3 * one) - light(-1e-3 * one)) / 2e-3 for one in unit]) / start
        absorbed = slopes.T @ np.linalg.pinv(slopes.T)
        curvatures = []
        for parameter, one in zip(shape.parameters, unit, strict=True):
            for steps in (-4, -1, 1, 4):
                step = steps * parameter.largest_step * one
                rest = light(step) / start - 1 - step @ slopes
                bent = np.linalg.norm(rest - absorbed @ rest) / np.linalg.norm(step @ slopes)
                curvatures.append((abs(steps), float(bent)))
        single = max(bent for steps, bent in curvatures if steps == 1)
        assert pytest.approx(single, rel=0.25) == likelihoods.CURVATURE, law
        assert max(bent for _, bent in curvatures) < likelihoods.MOST_CURVATURE, law


def test_what_a_long_step_and_a_misfit_of_all_hypotheses_change(
    evidence: Evidence,
) -> None:
    """The curvature of the PSF grows with the fourth power of the step: with its relative error and its change. A very long step
    is at most wrong by a fixed part of its change, for example along a coordinate that hardly matters."""
    longest, base = float(evidence.longest_step[0]), evidence.base[0]
    plain = with_residuals(evidence, {})

    def visible(steps: float) -> float:
        model = with_left(plain, lambda disc: steps * longest * disc.jacobian[base])
        return Likelihood(model).weigh([]).visible_error

    assert visible(0.0) == 0 < visible(0.1)
    assert visible(1.0) / visible(0.1) == pytest.approx(1e4, rel=0.01)
    assert visible(2000.0) / visible(1000.0) == pytest.approx(4, rel=0.01)
    # An offset beside residuals that no column describes: the larger these are, the less the offset counts.
    rng = np.random.default_rng(2)
    sigma = sigma_of(evidence, "dark_offset")
    plain = replace(with_residuals(evidence, {"dark_offset": 8 * sigma}), scale_error=0.1)

    def with_noise(noise: float) -> LinearModel:
        return with_left(plain, lambda disc: disc.residual + noise * noise_of(disc, rng))

    usual, noisy = (gain(with_noise(noise), "dark_offset") for noise in (1.0, 4.0))
    assert usual > 15 and noisy < usual / 3


def test_what_a_refit_subtracted_counts_as_a_part_of_the_strength(evidence: Evidence) -> None:
    """Whether the change was subtracted from the images or not, the hypothesis has the same evidence."""
    sigma = sigma_of(evidence, "dark_offset")
    columns = [list(evidence.columns["dark_offset"])]
    whole = Likelihood(with_residuals(evidence, {"dark_offset": 10 * sigma})).weigh(columns)
    rest = Likelihood(with_residuals(evidence, {"dark_offset": 4 * sigma}))
    part = rest.weigh(columns, subtracted=[6 * sigma])
    assert part.log_evidence == pytest.approx(whole.log_evidence, abs=0.1)
    assert part.values[0] == pytest.approx(whole.values[0] - 6 * sigma, rel=0.02)
    # A one-sided parameter that was subtracted too much is put back: the images do not contain this smear.
    sigma = sigma_of(evidence, "column_smear")
    columns = [list(evidence.columns["column_smear"])[:1]]
    whole = Likelihood(with_residuals(evidence, {"column_smear": -3 * sigma})).weigh(columns)
    part = Likelihood(with_residuals(evidence, {"column_smear": -5 * sigma})).weigh(
        columns, subtracted=[2 * sigma]
    )
    assert whole.columns == part.columns == ()
    assert part.log_evidence == pytest.approx(whole.log_evidence, abs=0.1)
