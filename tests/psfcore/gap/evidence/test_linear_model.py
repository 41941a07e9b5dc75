"""The linear model, compared with plain least squares and likelihoods."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from scipy.stats import multivariate_normal

from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.linear_model import FLOOR, UNLIKELY, LinearModel
from psfcore.gap.library.detector import EFFECTS
from psfcore.scatter.inversion import Solution
from tests.psfcore.gap.linear_models import with_residuals


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
    gain = model.gain(model.fit(columns))
    cost = float(np.log1p(model.learned(columns)).sum())
    assert gain - cost == pytest.approx(2 * (ours - nothing), abs=1e-3)
    assert gain > 0 and cost > 1.0
    # What the data tell about the coefficients, from the eigenvalues of their information.
    wanted = np.linalg.eigvalsh(seen.T @ seen)
    assert np.sort(model.learned(columns)) == pytest.approx(np.maximum(wanted, 0.0), rel=1e-3, abs=1e-6)


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
