"""Bands over the fits of a cross-validation, and the free fit compared with the formula."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import norm

from psfcore.scatter.inversion import invert
from psfcore.scatter.shapes import SHAPES
from psfcore.scatter.validation.bands import LIMITS, ONE_SIGMA, TWO_SIGMA, Excess, bands, shell_bands
from psfcore.scatter.validation.cross_validation import (
    FoldShells,
    bootstrap_samples,
    shared_fits,
)
from psfcore.scatter.validation.cross_validation_plot import cross_validation_png
from psfcore.scatter.validation.free_shells import shells
from tests.psfcore.scatter.validation.test_cross_validation import in_bands, shared
from tests.psfcore.small_transits import IMAGES, observed, sky, solved


def test_percentiles_are_a_gaussians() -> None:
    assert np.array(ONE_SIGMA) / 100 == pytest.approx(norm.cdf([-1, 1]), abs=1e-12)
    assert np.array(TWO_SIGMA) / 100 == pytest.approx(norm.cdf([-2, 2]), abs=1e-12)
    assert list(LIMITS) == sorted(LIMITS)


def test_free_fit_and_formula_agree_if_the_formula_is_true() -> None:
    found = in_bands().shells
    assert found is not None
    assert not found.largest.parts
    assert abs(found.near_centre.points) < 3 * found.near_centre.sigma
    assert found.near_centre.within_px == pytest.approx(3.1)
    assert (found.free_weight >= 0).all() and (np.diff(found.free_weight, axis=0) >= 0).all()
    total = found.law_beyond_pct[2, 0] / 100
    assert total == pytest.approx(np.median([f.values["total"] for f in shared()]), rel=1e-6)


def made(extra: float, sigma: float, seed: int) -> FoldShells:
    """A sample whose free fit has `extra` more light in its fourth shell, with a small random difference."""
    law = np.full(shells().size, 0.4 / shells().size)
    free = law.copy()
    free[3] += extra + 1e-4 * np.random.default_rng(seed).standard_normal()
    return FoldShells(tuple(free), tuple(law), (sigma,) * shells().size)


def test_an_excess_has_the_larger_of_its_two_errors() -> None:
    found = shell_bands([made(0.05, 0.01, seed) for seed in range(200)])
    near = found.near_centre
    assert near.points == pytest.approx(5.0, abs=0.01) and near.sigma == pytest.approx(1.0)
    assert near.of_formula_pct == pytest.approx(100 * 0.05 / (6 * 0.4 / shells().size), rel=0.01)
    assert found.largest.parts and near.parts
    assert not Excess(3.1, points=2.9, sigma=1.0, of_formula_pct=10.0).parts
    by_draws = shell_bands([made(0.05, 1e-9, seed) for seed in range(200)])
    assert by_draws.near_centre.sigma == pytest.approx(0.01, rel=0.2)
    beyond = by_draws.free_beyond_pct[2] - by_draws.law_beyond_pct[2]
    np.testing.assert_allclose(beyond[:4], 5.0, atol=0.02)
    np.testing.assert_allclose(beyond[4:], 0.0, atol=1e-9)


def test_a_stretched_shape_has_no_shells() -> None:
    start = SHAPES["stretched"].coordinates(solved().inversion.values)
    solution = invert(observed(sky()).transit, SHAPES["stretched"], start=start)
    found = bands(shared_fits(solution, bootstrap_samples(IMAGES, runs=1)), solution.inversion.radii_px)
    assert found.shells is None and found.to_json()["shells"] is None


def test_the_plot_has_a_second_row_with_a_free_fit(tmp_path) -> None:  # type: ignore[no-untyped-def]
    heights = []
    for fits in (shared(), tuple(dataclasses.replace(fit, shells=None) for fit in shared())):
        path = tmp_path / "p.png"
        cross_validation_png(bands(fits, solved().inversion.radii_px), fits, [1] * IMAGES, path)
        heights.append(int.from_bytes(path.read_bytes()[20:24], "big"))
    assert heights[0] == 2 * heights[1]
