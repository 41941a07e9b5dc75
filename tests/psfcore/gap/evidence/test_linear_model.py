"""The linear model, compared with plain least squares and likelihoods; blocks of the unocculted field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from scipy.stats import multivariate_normal

from psfcore.gap.evidence.cells import cells_of, disc_cells, sensitivities
from psfcore.gap.evidence.linear_model import FLOOR, UNLIKELY, LinearModel
from psfcore.gap.evidence.responses import Evidence, gather
from psfcore.gap.library.detector import EFFECTS
from psfcore.gap.view import View
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.total_psf import pick, put
from tests.psfcore.gap.linear_models import dense, discs_only, effect_of, with_residuals


def chi2_left(rows: np.ndarray, left: np.ndarray) -> float:
    """chi2 after a fit of some patterns, the columns of `rows`."""
    return float(np.sum((left - rows @ np.linalg.lstsq(rows, left, rcond=None)[0]) ** 2))


def test_a_gain_is_the_decrease_of_chi2_of_a_plain_least_squares_fit(evidence: Evidence) -> None:
    model = LinearModel(discs_only(evidence), 0.003)
    (column,), base = evidence.columns["dark_offset"], list(evidence.base)
    jacobian, residual = dense(model)
    # The prior of the effect's parameter is a measurement of 0.
    prior = np.zeros((1, len(base) + 1))
    prior[0, -1] = 1 / (UNLIKELY * effect_of(evidence, "dark_offset").parameters[0].likely)
    with_effect = np.vstack([jacobian[:, [*base, column]], prior])
    fall = chi2_left(jacobian[:, base], residual) - chi2_left(with_effect, np.append(residual, 0.0))
    assert model.gain(model.fit([column])) == pytest.approx(fall, rel=1e-4, abs=1e-6)


def test_gain_minus_cost_of_a_random_field_is_its_log_likelihood_ratio(solution: Solution) -> None:
    evidence = gather(solution, [effect for effect in EFFECTS if effect.name == "flat_field_residual"])
    model = LinearModel(discs_only(evidence), FLOOR)
    (effect,) = evidence.effects
    jacobian, residual = dense(model)
    base, columns = list(evidence.base), list(evidence.columns[effect.name])
    # Remove the component that the PSF's coordinates absorb; the rest has unit noise.
    free = scipy.linalg.null_space(jacobian[:, base].T)
    seen = free.T @ jacobian[:, columns] * [parameter.likely for parameter in effect.parameters]
    unit = np.eye(free.shape[1])
    ours, nothing = (
        multivariate_normal(np.zeros(free.shape[1]), unit + more).logpdf(residual @ free)
        for more in (seen @ seen.T, 0.0)
    )
    gain = model.gain(model.fit(columns))
    cost = float(np.log1p(model.learned(columns)).sum())
    assert gain - cost == pytest.approx(2 * (ours - nothing), abs=1e-3)
    assert gain > 0 and cost > 1.0
    # What the data tell about the coefficients, from the eigenvalues of their information.
    information = np.maximum(np.linalg.eigvalsh(seen.T @ seen), 0.0)
    assert np.sort(model.learned(columns)) == pytest.approx(information, rel=1e-3, abs=1e-6)


def test_the_prior_also_counts_what_was_subtracted_from_the_images(evidence: Evidence) -> None:
    columns = evidence.columns["dark_offset"]
    whole = with_residuals(evidence, {"dark_offset": 400.0}).fit(columns)
    first = len(evidence.base)
    left = with_residuals(evidence, {"dark_offset": 100.0})
    step = left.fit(columns)
    taken_out = np.concatenate([np.zeros(first), [300.0]])
    total = 300.0 + step.values - left.pull_of_prior(step, taken_out)
    assert whole.values[first] < 399.0  # the prior, of 20 DN, holds it back
    assert total[first] == pytest.approx(whole.values[first], rel=1e-6)


def test_blocks_recover_an_added_effect_whatever_the_brightness(evidence: Evidence) -> None:
    (column,) = evidence.columns["dark_offset"]
    blocks = evidence.unocculted
    waver = 1 + 0.004 * np.random.default_rng(2).standard_normal(len(evidence.image_info))
    added = replace(blocks, levels=blocks.levels * waver[:, None] + 1.5 * blocks.errors[column])
    equations = (one.equations([column]) for one in (added, blocks))
    after, before = (float(one.score[0] / one.normal[0, 0]) for one in equations)
    assert after - before == pytest.approx(1.5, abs=0.15)


# --- cells and sensitivities, compared with the estimate computed forwards ---


def left_in_disc(solution: Solution, n: int, image: np.ndarray) -> np.ndarray:
    """r of Eq. (1) of cells, computed forwards."""
    optics, dark = solution.optics, solution.sky.dark[n]
    lanes = optics.lanes(np.ascontiguousarray(image, dtype=np.float32))
    scene = optics.invert(lanes, optics.invert_once(lanes), steps=1)
    put(scene, dark, 0.0)
    return pick(lanes, dark) - pick(optics.convolve(scene), dark)


def test_a_sensitivity_of_a_cell_is_the_adjoint_of_the_estimate(
    solution: Solution,
) -> None:
    n = solution.part[3]
    place = solution.sky.found[n].place
    cells = cells_of(solution.sky.dark[n], place.x_px, place.y_px)
    assert cells.pixels.sum() == solution.sky.dark[n][0].size
    assert np.allclose(cells.weights.sum(axis=1), 1.0)
    assert cells.pixels.size == 13 and cells.radius.max() < 1.0
    planes = sensitivities(solution.optics, solution.sky.dark[n], cells.weights)
    image = np.random.default_rng(1).normal(size=solution.transit.shape).astype(np.float32)
    forwards = cells.weights @ left_in_disc(solution, n, image)
    backwards = np.einsum("cyx,yx->c", planes, image)
    assert backwards == pytest.approx(forwards, abs=1e-4)


def test_sensitivities_predict_an_added_error_and_no_global_gain(
    solution: Solution,
) -> None:
    n = solution.part[3]
    found, planes = disc_cells(solution, n)
    error = np.full(solution.transit.shape, 5.0, np.float32)
    place = solution.sky.found[n].place
    weights = cells_of(solution.sky.dark[n], place.x_px, place.y_px).weights
    optics, dark = solution.optics, solution.sky.dark[n]
    lanes = optics.lanes(solution.transit.frames[n].pixels + error)
    scene = optics.invert(lanes, steps=8)
    put(scene, dark, 0.0)
    after = weights @ (pick(lanes, dark) - pick(optics.convolve(scene), dark))
    expected = np.einsum("cyx,yx->c", planes, error)
    assert np.abs(expected).max() > 0.5
    assert after - found.residual == pytest.approx(expected, abs=0.05 * float(np.abs(expected).max()))
    view = View(solution)
    n = solution.part[2]
    found, planes = disc_cells(solution, n)
    moved = np.einsum("cyx,yx->c", planes, view.expected[n])
    assert np.abs(moved).max() < 0.01 * float(found.expected.mean())
