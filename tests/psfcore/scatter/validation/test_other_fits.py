"""Tests of a fit: other shapes, shells without a formula, and wrong dark levels."""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest

from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import Blur, TotalPsf
from psfcore.scatter.validation import robustness
from psfcore.scatter.validation.free_shells import (
    FreeShares,
    free_kernel,
    free_shares,
    law_light,
    looseness_of,
    shells,
)
from psfcore.scatter.validation.robustness import (
    ComparedShape,
    compare_shapes,
    dark_offset_study,
    with_offset,
)
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import folds
from tests.psfcore.evaluation.small_evaluations import offsets
from tests.psfcore.small_transits import SIZE_PX, STRETCHED, observed, sky, solved, solved_noise_free
from tests.transit_files import drawn_truth, hri_diffraction

# --- other shapes --------------------------------------------------------------------------------------------


@cache
def compared_stretched() -> dict[str, ComparedShape]:
    return by_name(compare_shapes(invert(observed(sky(STRETCHED)).transit)))


def by_name(compared: tuple[ComparedShape, ...]) -> dict[str, ComparedShape]:
    return {shape.name: shape for shape in compared}


def test_a_simulated_stretch_is_found_and_gains_most() -> None:
    """To first order, near the best fit without a stretch."""
    log, turn = math.log(1.15), math.radians(2 * -15.0)
    found = compared_stretched()["stretched"].added
    for name, true in (("stretch_p", log * math.cos(turn)), ("stretch_q", log * math.sin(turn))):
        value, sigma = found[name]
        assert abs(value - true) < 3 * sigma
        assert abs(value) > 8 * sigma
    compared = compared_stretched()
    by_gain = sorted(compared, key=lambda name: -compared[name].gain)
    held_out = {name: shape.held_out_gain or 0.0 for name, shape in compared.items()}
    assert by_gain[0] == "stretched" == max(held_out, key=lambda name: held_out[name])
    assert compared["stretched"].gain > compared["stretched-along-x"].gain > 100


def test_gains_agree_with_the_residuals() -> None:
    """Steps of each fold, and chi2 of the held-out images before and after, computed from pixels."""
    solution = solved()
    with patch.object(robustness, "SHAPES", {"knee": SHAPES["knee"]}):  # quicker than all shapes
        (found,) = compare_shapes(solution)
    slopes = [*solution.total.slopes(solution.inversion.coordinates), bend_slope(solution)]
    blurs = [Blur(slope, solution.transit.shape) for slope in slopes]
    frames = []
    for n in solution.part:
        residual, expected, jacobian = solution.residual_with_jacobian(n, blurs)
        frames.append((residual, jacobian, solution.weight(n, expected)))

    def step(of: list[int], size: int) -> np.ndarray:
        lines = np.concatenate([(frames[n][1][:size] * np.sqrt(frames[n][2])).T for n in of])
        target = np.concatenate([frames[n][0] * np.sqrt(frames[n][2]) for n in of])
        return np.linalg.lstsq(lines, target, rcond=None)[0]

    def chi2(of: list[int], moved: np.ndarray) -> float:
        return sum(
            float(np.sum(frames[n][2] * (frames[n][0] - moved @ frames[n][1][: moved.size]) ** 2)) for n in of
        )

    everything = list(range(len(frames)))
    whole, alone = step(everything, 4), step(everything, 3)
    assert found.added["bend"][0] == pytest.approx(whole[3], rel=1e-3)
    assert found.gain == pytest.approx(chi2(everything, alone) - chi2(everything, whole), abs=0.01)
    gained = 0.0
    for fold in folds(len(frames)):
        fitted_frames, held = list(fold.fitted), list(fold.held_out)
        gained += chi2(held, step(fitted_frames, 3)) - chi2(held, step(fitted_frames, 4))
    assert found.held_out_gain == pytest.approx(gained, rel=0.01, abs=0.05)


def bend_slope(solution: Solution) -> np.ndarray:
    shape = SHAPES["knee"]
    total = TotalPsf(solution.transit.diffraction, shape, solution.transit.shape)
    return total.slope(shape.coordinates(solution.inversion.values), 3)


def test_few_images_have_no_held_out_gain_and_other_shapes_are_refused() -> None:
    five = dataclasses.replace(solved().inversion, frames=solved().inversion.frames[3:8])
    few = dataclasses.replace(solved(), part=solved().part[3:8], inversion=five)
    inversion = dataclasses.replace(solved().inversion, shape=SHAPES["knee"])
    with patch.object(robustness, "SHAPES", {"knee": SHAPES["knee"]}):
        assert all(shape.held_out_gain is None for shape in compare_shapes(few))
    with pytest.raises(DataError, match=r"unknown-shape.*softened-power-law.*knee"):
        compare_shapes(dataclasses.replace(solved(), inversion=inversion))


# --- free shells ---------------------------------------------------------------------------------------------


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
            residual, expected, (slope,) = solution.residual_with_jacobian(n, [blur])
            weight = solution.weight(n, expected)
            normal = float(weight @ slope**2)
            # The derivatives agree to a tenth, and the score to a tenth of its noise.
            assert shares().normal[k, shell, shell] == pytest.approx(normal, rel=0.2)
            assert abs(shares().score[k, shell] - float(weight @ (slope * residual))) < 0.1 * np.sqrt(normal)


def test_images_add_up_and_no_shell_is_negative_or_unconstrained() -> None:
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
    at = SOFTENED_POWER_LAW.coordinates({"total": 0.4})
    assert law_light(SOFTENED_POWER_LAW, at).sum() == pytest.approx(0.4, rel=1e-9)
    assert TotalPsf(np.ones((1, 1)), SHAPES["knee"], (64, 64)).shape.isotropic


# --- dark offsets --------------------------------------------------------------------------------------------


def test_an_offset_is_divided_by_the_exposure() -> None:
    transit = observed(sky()).transit
    for before, after in zip(transit.frames, with_offset(transit, -3.0).frames, strict=True):
        np.testing.assert_allclose(
            after.pixels, before.pixels - 3.0 / before.exposure_s, rtol=1e-5, atol=1e-4
        )


def test_a_positive_offset_is_fitted_as_more_scatter() -> None:
    study = offsets()
    low, high = study.offsets
    assert (low.offset_dn, high.offset_dn) == (-5.0, 5.0)
    assert (high.curve_change_points > 0).all() and (low.curve_change_points < 0).all()
    assert (high.total_curve_change_points > 0).all()
    assert high.values["total"] > study.nominal["total"] > low.values["total"]
    assert study.radii_px[0] == 1 and study.radii_px[-1] == SIZE_PX - 1
    assert study.curve_radii_px[0] == 0.5
    # Outside the central pixel, the curve is the total.
    for offset in study.offsets:
        change = offset.values["total"] - study.nominal["total"]
        assert offset.curve_change_points[0] == pytest.approx(100 * change, rel=1e-6)
    changes = [np.abs(o.weight_change_pct).max() for o in study.offsets]
    assert study.largest("weight_change_pct") == max(changes) > 2
    assert 0.5 < study.largest("curve_change_points") < 4
    nominal, other = ({**v} for v in (study.nominal, study.offsets[1].values))
    kernels = [SOFTENED_POWER_LAW.kernel(SOFTENED_POWER_LAW.coordinates(v), 512) for v in (other, nominal)]
    at = np.flatnonzero(study.radii_px == 20)[0]
    ratio = kernels[0][256, 276] / kernels[1][256, 276]
    assert study.offsets[1].weight_change_pct[at] == pytest.approx(100 * (ratio - 1), abs=0.02)


@pytest.mark.slow
def test_dark_offsets_of_a_transit_of_the_usual_size() -> None:
    for brightness in (1.0, 3.0):
        plan = default_plan(30, 512, brightness=brightness)
        study = dark_offset_study(simulate(plan, drawn_truth(0), hri_diffraction(1024), 0).transit)
        assert study.largest("weight_change_pct") < 60 / brightness
        assert study.largest("curve_change_points") < 5 / brightness
