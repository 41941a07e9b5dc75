"""Free fits near the formula: derivatives of the shells, sums over images, and recovery of simulated light."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from psfcore.convolution.convolver import Convolver
from psfcore.psf import REACH_GRID_PX
from psfcore.scatter.optics import Blur
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import TotalPsf
from psfcore.scatter.validation.free_shells import (
    FreeShares,
    free_kernel,
    free_shares,
    law_light,
    looseness_of,
    shells,
)
from tests.psfcore.small_transits import solved, solved_noise_free


@cache
def shares() -> FreeShares:
    return free_shares(solved(), solved().inversion.coordinates)


def once() -> list[int]:
    return [1] * len(solved().transit.frames)


def shell_blur(solution: Solution, shell: int) -> Blur:
    """Change of an image if a unit of light moves from the centre to a shell."""
    size = solution.total.size
    ring = np.where(shells().label_map(size) == shell, 1 / shells().counts[shell], 0.0)
    ring[size // 2, size // 2] = -1.0
    diffract = Convolver(solution.transit.diffraction, (size, size), dtype=np.float64)
    return Blur(np.asarray(diffract.apply(ring)), solution.transit.shape)


def test_slopes_are_those_of_the_inversion() -> None:
    """J^T w J and J^T w r, compared with those of the exact derivatives; all discs are close to the field's edge."""
    solution = solved()
    for shell in (0, 3, 8, 15, 22):
        blur = shell_blur(solution, shell)
        for k, n in list(enumerate(solution.part))[::4]:
            residual, expected = solution.residual(n)
            slope, weight = solution.jacobian(n, blur), solution.weight(n, expected)
            normal = float(weight @ slope**2)
            # The derivatives agree to a tenth, and the score to a tenth of its noise.
            assert shares().normal[k, shell, shell] == pytest.approx(normal, rel=0.2)
            assert abs(shares().score[k, shell] - float(weight @ (slope * residual))) < 0.1 * np.sqrt(normal)


def test_images_add_up() -> None:
    """An image that occurs twice in a bootstrap sample counts as two; a missing image does not count."""
    of = shares()
    twice = [0, 2, *([1] * (len(once()) - 2))]
    listed = [k for k, n in enumerate(of.frames) for _ in range(twice[n])]
    by_hand = FreeShares(
        frames=tuple(range(len(listed))),
        law_light=of.law_light,
        normal=of.normal[listed],
        score=of.score[listed],
    )
    expected = by_hand.fit([1] * len(listed), of.law_light)
    found = of.fit(twice, of.law_light)
    np.testing.assert_allclose(found.light, expected.light, atol=1e-9)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-6, atol=1e-12)
    assert np.abs(found.light - of.fit(once(), of.law_light).light).max() > 1e-4


def test_no_shell_is_negative_and_unconstrained_shells_follow_the_formula() -> None:
    beyond = np.array(shells().edges_px[:-1]) > 200.0  # no two pixels of a 128 px field are that far apart
    for law in (shares().law_light, 1.1 * shares().law_light):
        found = shares().fit(once(), law)
        assert found.light.min() >= 0
        np.testing.assert_allclose(found.light[beyond], law[beyond], rtol=0.02)
        sigma = np.sqrt(np.diag(found.covariance))[beyond]
        np.testing.assert_allclose(sigma, looseness_of(shares().law_light)[beyond], rtol=0.02)


def test_light_that_the_formula_lacks_near_the_centre_is_found() -> None:
    """A noise-free transit, and a formula that lacks 2 % of all light at 3 to 10 px."""
    solution = solved_noise_free()
    right = free_shares(solution, solution.inversion.coordinates)
    missing = np.zeros_like(right.law_light)
    band = (np.array(shells().edges_px[:-1]) >= 2.9) & (np.array(shells().edges_px[1:]) <= 10.0)
    missing[band] = 0.02 / band.sum()
    # To first order, a model without that light leaves the residual J d.
    lacking = FreeShares(
        frames=right.frames,
        law_light=right.law_light,
        normal=right.normal,
        score=right.score + np.einsum("nij,j->ni", right.normal, missing),
    )
    counts = [1] * len(solution.transit.frames)
    excess = lacking.fit(counts, right.law_light).light - right.fit(counts, right.law_light).light
    assert excess[band].sum() == pytest.approx(0.02, rel=0.1)
    assert np.abs(excess[~band]).sum() < 0.004


def test_a_free_kernel_with_the_light_of_the_formula_is_the_formulas_kernel() -> None:
    solution = solved()
    at, shape = solution.inversion.coordinates, SOFTENED_POWER_LAW
    free = shares().fit(once(), shares().law_light)
    same = type(free)(free.law_light, free.law_light, free.covariance)
    diffraction, size = solution.transit.diffraction, solution.total.size
    kernel = free_kernel(same, shape, at, diffraction, size)
    np.testing.assert_allclose(kernel, solution.total.kernel(at), atol=1e-9)
    changed = free_kernel(free, shape, at, diffraction, size)
    point = np.zeros((1, 1)) + 1.0
    scatter = free_kernel(free, shape, at, point, REACH_GRID_PX)
    assert scatter.sum() == pytest.approx(1.0, abs=1e-6) and changed.min() > -1e-6
    light = shells().mean_of_map(scatter) * shells().counts
    np.testing.assert_allclose(light, free.light, atol=1e-6)


def test_light_of_the_formula_is_all_that_is_scattered() -> None:
    at = SOFTENED_POWER_LAW.coordinates({"total": 0.4})
    assert law_light(SOFTENED_POWER_LAW, at).sum() == pytest.approx(0.4, rel=1e-9)
    assert TotalPsf(np.ones((1, 1)), SHAPES["knee"], (64, 64)).shape.isotropic
