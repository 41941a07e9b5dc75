"""The photon bound agrees with differences of whole simulations."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.noise import Noise
from psfcore.psf import cumulative_curve
from psfcore.simulate import bound as bound_module
from psfcore.simulate import scatter_truth
from psfcore.simulate import sky as sky_module
from psfcore.simulate.bound import PhotonBound, bound_of_sky
from psfcore.simulate.plan import Plan, default_plan
from psfcore.simulate.scatter_truth import (
    ScatterTruth,
    amplitude_slopes,
    anisotropic_kernel,
    kernel_slopes,
    total_kernel,
)
from psfcore.simulate.scene import drawn_scene
from psfcore.simulate.sky import TrueSky, fully_dark, true_sky
from psfcore.simulate.transit import read_sky, simulate, write
from tests.psfcore.conftest import gaussian

SCATTER = ScatterTruth(6.15, 2.53, 0.411)
DIFFRACTION = gaussian(31, 1.5)
FIELDS = {"b": "b_px", "c": "c", "total": "total", "stretch": "stretch"}
STEPS = {"b": 1e-3, "c": 1e-4, "total": 1e-4, "stretch": 1e-4}
Plane = NDArray[np.float64]
REACH_PX = 512


@pytest.fixture(scope="module", autouse=True)
def small_reach() -> Iterator[None]:
    """Light is counted over 512 px instead of 2048 px, which takes a sixteenth of the time."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (bound_module, scatter_truth, sky_module):
            patch.setattr(module, "REACH_GRID_PX", REACH_PX)
        yield


def moved(scatter: ScatterTruth, name: str, step: float) -> ScatterTruth:
    return dataclasses.replace(scatter, **{FIELDS[name]: getattr(scatter, FIELDS[name]) + step})


@pytest.fixture(scope="module")
def plan() -> Plan:
    return default_plan(6, 96, beyond="on", beyond_px=24)


@pytest.fixture(scope="module")
def scenes(plan: Plan) -> dict[int, Plane]:
    return {pointing: drawn_scene(plan, pointing, 5) for pointing in plan.pointings}


@pytest.fixture(scope="module")
def sky(plan: Plan, scenes: dict[int, Plane]) -> TrueSky:
    return true_sky(plan, SCATTER, DIFFRACTION, 5, scenes=scenes)


@pytest.fixture(scope="module")
def bound(sky: TrueSky) -> PhotonBound:
    return bound_of_sky(sky)


def dark_pixels(sky: TrueSky) -> Plane:
    """Expected values of all fully dark pixels of all images, in a row."""
    size = sky.plan.size_px
    discs = [fully_dark(sky.plan.place(n), (0, 0), (size, size)) for n in range(len(sky.plan.shots))]
    return np.concatenate([sky.expected(n)[disc] for n, disc in enumerate(discs)])


def dark_variances(sky: TrueSky) -> Plane:
    """Their variances, in the same order."""
    size = sky.plan.size_px
    rows = []
    for n, shot in enumerate(sky.plan.shots):
        disc = fully_dark(sky.plan.place(n), (0, 0), (size, size))
        rows.append((6.0 * sky.expected(n)[disc] * shot.exposure_s + 4.0) / shot.exposure_s**2)
    return np.concatenate(rows)


@pytest.fixture(scope="module")
def slopes(plan: Plan, scenes: dict[int, Plane]) -> Plane:
    """The derivatives of the dark pixels with respect to b, c, total and stretch, from differences of whole
    simulations."""
    rows = []
    for name, step in STEPS.items():
        sides = [
            dark_pixels(true_sky(plan, moved(SCATTER, name, side * step), DIFFRACTION, 5, scenes=scenes))
            for side in (1, -1)
        ]
        rows.append((sides[0] - sides[1]) / (2 * step))
    return np.stack(rows)


def test_kernel_slopes_are_differences_of_kernels() -> None:
    scatter = dataclasses.replace(SCATTER, stretch=0.12, angle_deg=35.0, dipole=0.2)
    found, of_a = kernel_slopes(scatter), amplitude_slopes(scatter)
    for name, step in STEPS.items():
        ahead, back = (moved(scatter, name, side * step) for side in (1, -1))
        expected = (anisotropic_kernel(ahead, REACH_PX) - anisotropic_kernel(back, REACH_PX)) / (2 * step)
        np.testing.assert_allclose(found[name], expected, atol=1e-6 * abs(expected).max())
        assert found[name].sum() == pytest.approx(0, abs=1e-9)
        assert of_a[name] == pytest.approx((ahead.a - back.a) / (2 * step), rel=1e-6, abs=1e-9)


def test_the_bound_agrees_with_differences_of_whole_simulations(
    bound: PhotonBound, sky: TrueSky, slopes: Plane
) -> None:
    weighted = slopes / dark_variances(sky)
    information = weighted @ slopes.T
    covariance = np.linalg.inv(information[:3, :3])
    assert (bound.b_px, bound.c, bound.total) == pytest.approx(np.sqrt(np.diag(covariance)), rel=2e-4)
    np.testing.assert_allclose(bound.covariance, covariance, rtol=5e-4)
    assert bound.stretch == pytest.approx(np.sqrt(np.linalg.inv(information)[3, 3]), rel=2e-4)
    assert bound.dark_pixels == slopes.shape[1]
    assert bound.images == 6


def test_errors_of_curves_follow_from_their_slopes(bound: PhotonBound) -> None:
    radii = [at.radius_px for at in bound.curve]
    assert radii == [0.5, 2, 5, 10, 20, 50, 100, 200, 300]
    covariance = np.array(bound.covariance)
    slopes = {"total": [], "diffuse": []}  # type: dict[str, list[Plane]]
    for name in ("b", "c", "total"):
        sides = [moved(SCATTER, name, side * STEPS[name]) for side in (1, -1)]
        for which, kernels in (
            ("total", [total_kernel(side, DIFFRACTION, REACH_PX) for side in sides]),
            ("diffuse", [anisotropic_kernel(side, REACH_PX) for side in sides]),
        ):
            ahead, back = (cumulative_curve(kernel, radii) for kernel in kernels)
            slopes[which].append((ahead - back) / (2 * STEPS[name]))
    for which, found in slopes.items():
        rows = np.stack(found)
        expected = np.sqrt(np.einsum("jr,jk,kr->r", rows, covariance, rows))
        stated = [getattr(at, f"{which}_sigma") for at in bound.curve]
        np.testing.assert_allclose(stated, expected, rtol=2e-3)
    total = cumulative_curve(total_kernel(SCATTER, DIFFRACTION, REACH_PX), radii)
    np.testing.assert_allclose([at.total_pct for at in bound.curve], total)
    assert bound.curve[0].diffuse_pct == pytest.approx(41.1)
    assert bound.curve[0].diffuse_sigma == pytest.approx(100 * bound.total)


def test_errors_of_places_agree_with_whole_simulations(
    bound: PhotonBound, plan: Plan, scenes: dict[int, Plane], sky: TrueSky
) -> None:
    step = 0.002
    y, x = np.mgrid[:96, :96]
    for index in (0, 3, 4):
        shot, slopes = plan.shots[index], []
        for axis in ("x_px", "y_px"):
            sides = []
            for side in (1, -1):
                shifted = dataclasses.replace(shot, **{axis: getattr(shot, axis) + side * step / 2})
                shots = (*plan.shots[:index], shifted, *plan.shots[index + 1 :])
                one = dataclasses.replace(plan, shots=shots)
                sides.append(true_sky(one, SCATTER, DIFFRACTION, 5, scenes=scenes).expected(index))
            slopes.append((sides[0] - sides[1]) / step)
        near = np.hypot(x - shot.x_px, y - shot.y_px) <= 10.75 + 5
        variance = (6.0 * sky.expected(index)[near] * shot.exposure_s + 4.0) / shot.exposure_s**2
        rows = np.stack([slope[near] for slope in slopes])
        expected = np.sqrt(np.diag(np.linalg.inv((rows / variance) @ rows.T)))
        assert bound.places_px[index] == pytest.approx(expected, rel=2e-5)


def test_four_times_the_light_halves_the_errors_without_clipping(bound: PhotonBound, sky: TrueSky) -> None:
    photons_only = dataclasses.replace(sky.plan, noise=Noise(6.0, 0.0))
    longer = tuple(dataclasses.replace(shot, exposure_s=4 * shot.exposure_s) for shot in sky.plan.shots)
    once = bound_of_sky(dataclasses.replace(sky, plan=photons_only))
    four = bound_of_sky(dataclasses.replace(sky, plan=dataclasses.replace(photons_only, shots=longer)))
    for name in ("b_px", "c", "total", "a", "stretch"):
        assert getattr(four, name) == pytest.approx(getattr(once, name) / 2, rel=1e-6)
    np.testing.assert_allclose(np.array(four.places_px), np.array(once.places_px) / 2, rtol=1e-6)
    np.testing.assert_allclose(
        [at.total_sigma for at in four.curve], [at.total_sigma / 2 for at in once.curve], rtol=1e-6
    )
    assert 1.001 * once.total < bound.total < 1.2 * once.total  # what 2 DN of readout cost
    clipped = dataclasses.replace(sky.plan, saturation_dn=600.0)
    found = bound_of_sky(dataclasses.replace(sky, plan=clipped))
    assert found.total == pytest.approx(bound.total, rel=1e-9)  # dark pixels are far below it
    assert found.places_px[3][0] > 1.05 * bound.places_px[3][0]
    assert found.places_px[0] == pytest.approx(bound.places_px[0])  # combined gain does not clip


def test_the_bound_of_a_folder_is_that_of_its_transit(
    tmp_path: Path,
) -> None:
    simulated = simulate(default_plan(3, 64), dataclasses.replace(SCATTER, stretch=0.1), DIFFRACTION, 2)
    write(simulated, tmp_path)
    kept, read = bound_of_sky(simulated.sky), bound_of_sky(read_sky(tmp_path))
    for name in ("b_px", "c", "total", "stretch"):
        assert getattr(read, name) == pytest.approx(getattr(kept, name), rel=0.02)
    np.testing.assert_allclose(read.places_px, kept.places_px, rtol=0.1)
    content = json.loads(json.dumps(read.to_json(), allow_nan=False))
    assert content["sigma"]["total"] == read.total
    assert content["curve"][0]["radius_px"] == 0.5
    assert len(content["places"]) == 3
    simulated = simulate(default_plan(1, 64), dataclasses.replace(SCATTER, total=0.0), DIFFRACTION, 1)
    with pytest.raises(DataError, match="no-bound"):
        bound_of_sky(simulated.sky)
