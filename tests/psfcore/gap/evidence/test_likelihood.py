"""The likelihood of hypotheses, compared with dense Gaussian integrals, and what a template error changes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.linalg import block_diag, null_space
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from psfcore.gap.evidence import likelihood as likelihoods
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.likelihood import TEMPLATE_ERRORS, Likelihood
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from tests.psfcore.gap.linear_models import with_residuals

EXACT = 1e-4  # relative error of the noise scale: so small that the likelihood is Gaussian


def sigma_of(evidence: Evidence, name: str) -> float:
    """The error of the first parameter of an effect."""
    plain = with_residuals(evidence, {})
    return float(np.sqrt(plain.fit([evidence.columns[name][0]]).covariance[-1, -1]))


def gain(model: LinearModel, *names: str) -> float:
    """ln of the evidence of some effects over that of no effect."""
    likelihood = Likelihood(model)
    columns = [list(model.evidence.columns[name]) for name in names]
    return likelihood.weigh(columns).log_evidence - likelihood.weigh([]).log_evidence


def test_the_evidence_is_the_gaussian_integral(evidence: Evidence, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(likelihoods, "TEMPLATE_ERRORS", (0.0,))
    monkeypatch.setattr(likelihoods, "SCALES", (1.0,))
    noisy = replace(with_residuals(evidence, {"dark_offset": 0.3}, noise=1.0), scale_error=EXACT)
    (column,) = evidence.columns["dark_offset"]
    width = next(e for e in evidence.effects if e.name == "dark_offset").parameters[0].likely

    covariance = block_diag(
        *(
            disc.covariance + noisy.floor**2 * np.outer(disc.expected, disc.expected)
            for disc in evidence.discs
        )
    )
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    jacobian = white @ np.concatenate([disc.jacobian.T for disc in evidence.discs])
    residual = white @ np.concatenate([disc.residual for disc in noisy.evidence.discs])
    # The coordinates of the PSF are free: only the part of the data that they cannot change counts.
    unchanged = null_space(jacobian[:, list(evidence.base)].T).T
    change, seen = width * unchanged @ jacobian[:, column], unchanged @ residual
    with_effect = multivariate_normal(cov=np.eye(seen.size) + np.outer(change, change))
    wanted = float(with_effect.logpdf(seen) - multivariate_normal(cov=np.eye(seen.size)).logpdf(seen))
    assert gain(noisy, "dark_offset") == pytest.approx(wanted, abs=1e-3)


def test_an_effect_that_can_only_add_light_explains_no_loss_of_light(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its best strength is 0. Its evidence is the integral over all strengths, so that a weak effect is not excluded."""
    monkeypatch.setattr(likelihoods, "SCALES", (1.0,))
    sigma = sigma_of(evidence, "column_smear")
    columns = [list(evidence.columns["column_smear"])[:1]]
    offset = list(evidence.columns["dark_offset"])
    width = next(p for e in evidence.effects if e.name == "column_smear" for p in e.parameters).likely
    strengths = np.linspace(0, 20 * width, 20001)
    prior = np.sqrt(2 / np.pi) / width * np.exp(-((strengths / width) ** 2) / 2)
    for lost in (-8 * sigma, -0.5 * sigma):
        model = replace(with_residuals(evidence, {"column_smear": lost}), scale_error=EXACT)
        likelihood = Likelihood(model)
        found = likelihood.weigh(columns)
        assert found.columns == ()
        seen = np.exp(((lost / sigma) ** 2 - ((strengths - lost) / sigma) ** 2) / 2)
        wanted = math.log(trapezoid(prior * seen, strengths))
        assert found.log_evidence - likelihood.weigh([]).log_evidence == pytest.approx(wanted, abs=0.02)
        assert wanted < -0.5
        assert likelihood.weigh([offset, *columns]).log_evidence == -math.inf  # the same as the offset alone
    added = Likelihood(with_residuals(evidence, {"column_smear": 8 * sigma})).weigh(columns)
    assert added.values[0] == pytest.approx(8 * sigma, rel=0.2)


def test_one_sided_parameters_are_integrated_for_every_choice_of_those_that_act(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two one-sided shares of a smear, of which one has its best value at 0: either acts, or both, on a grid of values."""
    monkeypatch.setattr(likelihoods, "TEMPLATE_ERRORS", (0.0,))
    monkeypatch.setattr(likelihoods, "SCALES", (1.0,))
    sigma = sigma_of(evidence, "column_smear")
    below, above = evidence.columns["column_smear"]
    plain = replace(with_residuals(evidence, {"column_smear": 8 * sigma}), scale_error=EXACT)
    lost = next(p for e in evidence.effects if e.name == "column_smear" for p in e.parameters).likely
    # Light is missing above: the best value of the second share is below 0.
    discs = tuple(
        replace(disc, residual=disc.residual - 4 * sigma * disc.jacobian[above])
        for disc in plain.evidence.discs
    )
    model = replace(plain, evidence=replace(plain.evidence, discs=discs))

    white = np.linalg.inv(
        np.linalg.cholesky(
            block_diag(
                *(disc.covariance + model.floor**2 * np.outer(disc.expected, disc.expected) for disc in discs)
            )
        )
    )
    jacobian = white @ np.concatenate([disc.jacobian.T for disc in discs])
    unchanged = null_space(jacobian[:, list(evidence.base)].T).T
    seen = unchanged @ white @ np.concatenate([disc.residual for disc in discs])
    changes = unchanged @ jacobian[:, [below, above]]
    values = np.linspace(0, 30 * sigma, 3001)
    left = (values[1] - values[0]) * np.where(np.arange(values.size) == 0, 0.5, 1.0)
    prior = np.sqrt(2 / np.pi) / lost * np.exp(-((values / lost) ** 2) / 2) * left
    normal, score = changes.T @ changes, changes.T @ seen
    first, second = values[:, None], values[None, :]
    ln_l = (
        score[0] * first
        + score[1] * second
        - (normal[0, 0] * first**2 + 2 * normal[0, 1] * first * second + normal[1, 1] * second**2) / 2
    )
    only_first, only_second, both = (
        float(logsumexp(ln_l[:, 0], b=prior)),
        float(logsumexp(ln_l[0], b=prior)),
        float(logsumexp(ln_l, b=prior[:, None] * prior[None, :])),
    )
    wanted = float(logsumexp([only_first, only_second, both], b=[1 / 4, 1 / 4, 1 / 2]))
    likelihood = Likelihood(model)
    found = likelihood.weigh([[below, above]])
    assert found.columns == (below,)
    assert found.log_evidence - likelihood.weigh([]).log_evidence == pytest.approx(wanted, abs=0.2)
    without = likelihood.weigh([[below]]).log_evidence
    assert without - math.log(4) < found.log_evidence < without - math.log(4 / 3), (
        "the second share costs nothing"
    )


def test_what_an_error_of_the_first_template_explains_is_credited_less_to_a_second_effect(
    evidence: Evidence,
) -> None:
    """A weak smear beside a strong offset counts less if the template of the offset is not exact."""
    sigma = sigma_of(evidence, "column_smear")
    weak, strong = (
        with_residuals(evidence, {"dark_offset": size, "column_smear": 8 * sigma}) for size in (3.0, 300.0)
    )
    offset, smear = (list(evidence.columns[name]) for name in ("dark_offset", "column_smear"))
    seen = [Likelihood(one).weigh([offset]) for one in (weak, strong)]
    assert seen[0].visible_error < 9 < seen[1].visible_error

    def credit(model: LinearModel, error: float) -> float:
        likelihood = Likelihood(model)
        alone, both = (likelihood._weigh(some, 1.0, {}, error)[0] for some in ([offset], [offset, smear]))
        return both.log_evidence - alone.log_evidence

    largest = TEMPLATE_ERRORS[-1]
    assert credit(weak, largest) == pytest.approx(credit(weak, 0.0), abs=1)
    assert 5 < credit(strong, largest) < credit(strong, 0.0) - 3


@pytest.mark.parametrize(
    "values", [{}, {"b_px": 3.0, "c": 2.3, "total": 0.3}, {"b_px": 9.0, "c": 2.8, "total": 0.5}]
)
def test_the_curvature_is_that_of_the_scatter_kernel(values: dict[str, float]) -> None:
    """The light in rings around a disc, after a step of a coordinate, minus its first order and what the PSF absorbs."""
    shape, size = SOFTENED_POWER_LAW, 257
    at = shape.coordinates(values)
    r = np.hypot(*np.mgrid[-128:129, -128:129])
    bounds = (15, 20, 30, 45, 70, 100, 180)

    def light(step: np.ndarray) -> np.ndarray:
        kernel = shape.kernel(at + step, size)
        return np.array([kernel[(r >= low) & (r < high)].sum() for low, high in itertools.pairwise(bounds)])

    start, unit = light(np.zeros(at.size)), np.eye(at.size)
    slopes = np.array([(light(1e-3 * one) - light(-1e-3 * one)) / 2e-3 for one in unit]) / start
    absorbed = slopes.T @ np.linalg.pinv(slopes.T)

    def curvature(step: np.ndarray) -> float:
        linear = step @ slopes
        rest = light(step) / start - 1 - linear
        return float(np.linalg.norm(rest - absorbed @ rest) / np.linalg.norm(linear))

    steps = [
        sign * parameter.largest_step * one
        for parameter, one in zip(shape.parameters, unit, strict=True)
        for sign in (-1, 1)
    ]
    assert pytest.approx(max(curvature(step) for step in steps), rel=0.25) == likelihoods.CURVATURE
    assert max(curvature(4 * step) for step in steps) < likelihoods.MOST_CURVATURE


def test_a_long_step_of_the_psf_is_not_linear(evidence: Evidence) -> None:
    """The curvature of the PSF grows with the fourth power of the step: with its relative error and its change. A very long step
    is at most wrong by a fixed part of its change, for example along a coordinate that hardly matters."""
    longest = float(evidence.longest_step[0])
    disc_change = np.concatenate([disc.jacobian[evidence.base[0]] for disc in evidence.discs])
    assert disc_change.any()

    def visible(steps: float) -> float:
        discs = tuple(
            replace(disc, residual=steps * longest * disc.jacobian[evidence.base[0]])
            for disc in evidence.discs
        )
        plain = with_residuals(evidence, {})
        return (
            Likelihood(replace(plain, evidence=replace(plain.evidence, discs=discs))).weigh([]).visible_error
        )

    short, long = visible(0.1), visible(1.0)
    assert 0 < short < long
    assert long / short == pytest.approx(1e4, rel=0.01)
    assert visible(2000.0) / visible(1000.0) == pytest.approx(4, rel=0.01)
    assert Likelihood(with_residuals(evidence, {})).weigh([]).visible_error == 0


def test_the_template_error_leaves_out_what_a_change_of_the_psf_absorbs(evidence: Evidence) -> None:
    likelihood = Likelihood(with_residuals(evidence, {}))
    by_psf = likelihood._jacobian[:, :, evidence.base[0]]
    (offset,) = evidence.columns["dark_offset"]
    change = likelihood._jacobian[:, :, offset]
    np.testing.assert_allclose(likelihood._net(by_psf), 0.0, atol=1e-6 * np.abs(by_psf).max())
    net = likelihood._net(change + 5.0 * by_psf)
    np.testing.assert_allclose(net, likelihood._net(change), atol=1e-6 * np.abs(by_psf).max())
    assert np.abs(net).max() > 0


def test_a_misfit_that_every_hypothesis_has_decides_less(evidence: Evidence) -> None:
    """An offset beside residuals that no column describes: the larger these are, the less the offset counts."""
    rng = np.random.default_rng(2)
    sigma = sigma_of(evidence, "dark_offset")
    gains = []
    for noise in (1.0, 4.0):
        model = replace(with_residuals(evidence, {"dark_offset": 8 * sigma}), scale_error=0.1)
        discs = tuple(
            replace(
                disc,
                residual=disc.residual
                + noise * rng.multivariate_normal(0 * disc.residual, disc.covariance, check_valid="ignore"),
            )
            for disc in model.evidence.discs
        )
        gains.append(gain(replace(model, evidence=replace(model.evidence, discs=discs)), "dark_offset"))
    assert gains[0] > 15 and gains[1] < gains[0] / 3


def test_what_a_refit_subtracted_counts_as_a_part_of_the_strength(evidence: Evidence) -> None:
    """Whether the change was subtracted from the images or not, the hypothesis has the same evidence."""
    sigma = sigma_of(evidence, "dark_offset")
    columns = [list(evidence.columns["dark_offset"])]
    whole = Likelihood(with_residuals(evidence, {"dark_offset": 10 * sigma})).weigh(columns)
    rest = Likelihood(with_residuals(evidence, {"dark_offset": 4 * sigma}))
    part = rest.weigh(columns, subtracted=[6 * sigma])
    assert part.log_evidence == pytest.approx(whole.log_evidence, abs=0.1)
    assert part.values[0] == pytest.approx(whole.values[0] - 6 * sigma, rel=0.02)


def test_a_one_sided_parameter_that_was_subtracted_too_much_is_put_back(evidence: Evidence) -> None:
    """A refit subtracted a smear that the images do not contain; the evidence is that of the images before."""
    sigma = sigma_of(evidence, "column_smear")
    columns = [list(evidence.columns["column_smear"])[:1]]
    whole = Likelihood(with_residuals(evidence, {"column_smear": -3 * sigma})).weigh(columns)
    rest = Likelihood(with_residuals(evidence, {"column_smear": -5 * sigma}))
    part = rest.weigh(columns, subtracted=[2 * sigma])
    assert whole.columns == part.columns == ()
    assert part.log_evidence == pytest.approx(whole.log_evidence, abs=0.1)
