"""Every shape of scatter contains its total of light and follows its formula."""

from __future__ import annotations

import math

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX, crop_centred
from psfcore.scatter import shapes
from psfcore.scatter.power_law import scatter_kernel
from psfcore.scatter.shapes import (
    CORE_PX,
    HALO_B_PX,
    KNEE_PX,
    SHAPES,
    SOFTENED_POWER_LAW,
    Shape,
    shape_named,
    stretch_of,
)
from psfcore.simulate.scatter_truth import ScatterTruth, anisotropic_kernel

LAW = {"b_px": 6.15, "c": 2.53, "total": 0.411}
MORE = {
    "stretch_p": 0.1,
    "stretch_q": -0.06,
    "x_share": 0.2,
    "y_share": -0.1,
    "bend": 0.4,
    "halo_share": 0.07,
    "core_share": 0.05,
}
MIDDLE = REACH_GRID_PX // 2
REACH_PX = 256


def kernel_of(shape: Shape, size: int = 64, **values: float) -> np.ndarray:
    return shape.kernel(shape.coordinates(LAW | values), size)


@pytest.fixture
def small_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light is counted over 256 px instead of 2048 px."""
    monkeypatch.setattr(shapes, "REACH_GRID_PX", REACH_PX)


def test_light_outside_the_centre_is_the_total() -> None:
    for shape in SHAPES.values():
        kernel = kernel_of(shape, REACH_GRID_PX, **MORE)
        assert kernel[MIDDLE, MIDDLE] == pytest.approx(1 - 0.411, abs=1e-14), shape.name
        assert kernel.sum() == pytest.approx(1, abs=1e-12), shape.name
        assert kernel.min() >= 0, shape.name


def test_slopes_are_those_of_the_kernel(small_reach: None) -> None:
    """Compared with two wider differences, extrapolated to zero width."""
    for shape in SHAPES.values():
        at = shape.coordinates(LAW | MORE)
        for k, axis in enumerate(np.eye(at.size)):
            wide, wider = (
                (shape.kernel(at + h * axis, 64) - shape.kernel(at - h * axis, 64)) / (2 * h)
                for h in (4e-3, 8e-3)
            )
            expected = (4 * wide - wider) / 3
            largest = np.abs(expected).max()
            assert largest > 1e-5
            slope = shape.slope(at, k, 64)
            np.testing.assert_allclose(slope, expected, atol=1e-5 * largest, err_msg=f"{shape.name} {k}")


def test_with_zero_additional_parameters_every_shape_is_the_softened_power_law() -> None:
    law = scatter_kernel(6.15, 2.53, 0.411, 256)
    for shape in SHAPES.values():
        assert all(p.start == 0 for p in shape.parameters[3:])
        np.testing.assert_allclose(kernel_of(shape, 256), law, rtol=1e-11, err_msg=shape.name)


def test_stretch_and_one_side_are_those_of_the_simulator() -> None:
    for angle_deg in (-15.0, 90.0):
        turn = math.radians(angle_deg)
        p, q = (math.log(1.15) * f(2 * turn) for f in (math.cos, math.sin))
        stretched = kernel_of(SHAPES["stretched"], 128, stretch_p=p, stretch_q=q)
        truth = ScatterTruth(6.15, 2.53, 0.411, stretch=0.15, angle_deg=angle_deg)
        np.testing.assert_allclose(stretched, anisotropic_kernel(truth, 128), rtol=1e-10)
        assert stretch_of({"stretch_p": p, "stretch_q": q}) == pytest.approx((0.15, angle_deg))
        x, y = 0.25 * math.cos(turn), 0.25 * math.sin(turn)
        one_sided = kernel_of(SHAPES["one-sided"], 128, x_share=x, y_share=y)
        truth = ScatterTruth(6.15, 2.53, 0.411, dipole=0.25, angle_deg=angle_deg)
        np.testing.assert_allclose(one_sided, anisotropic_kernel(truth, 128), rtol=1e-10, atol=1e-18)
    along_x = kernel_of(SHAPES["stretched-along-x"], 128, stretch_p=math.log(0.9))
    truth = ScatterTruth(6.15, 2.53, 0.411, stretch=-0.1)
    np.testing.assert_allclose(along_x, anisotropic_kernel(truth, 128), rtol=1e-10)
    assert stretch_of({"stretch_p": math.log(1.05)}) == pytest.approx((0.05, 0.0))
    assert stretch_of(LAW) == (0.0, 0.0)


def test_a_knee_steepens_the_law_beyond_it() -> None:
    kernel, law = kernel_of(SHAPES["knee"], 1024, bend=0.4), kernel_of(SOFTENED_POWER_LAW, 1024)
    ratio = kernel[512] / law[512]
    r = np.array([1, 50, 100, 200, 500])
    expected = ((1 + (r / KNEE_PX) ** 2) / (1 + 1 / KNEE_PX**2)) ** -0.2
    np.testing.assert_allclose(ratio[512 + r] / ratio[513], expected, rtol=1e-12)
    assert ratio[513] > 1 > ratio[1012]  # light lost at large distances is gained at small ones


def test_a_second_power_law_and_a_core_contain_their_fraction(small_reach: None) -> None:
    middle = REACH_PX // 2
    law = kernel_of(SOFTENED_POWER_LAW, REACH_PX)
    r = np.hypot(*(np.indices(law.shape) - middle))
    wide = (HALO_B_PX + r) ** -2.53
    core = np.exp(-0.5 * (r / CORE_PX) ** 2)
    for name, share, added in (("two-power-laws", "halo_share", wide), ("core", "core_share", core)):
        added[middle, middle] = 0
        expected = 0.93 * law + 0.07 * 0.411 * added / added.sum()
        expected[middle, middle] = 1 - 0.411
        found = kernel_of(SHAPES[name], REACH_PX, **{share: 0.07})
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_any_size_is_a_crop_of_the_same_kernel(small_reach: None) -> None:
    """Weights are scaled on the full reach, for smaller and for larger arrays."""
    for name in ("softened-power-law", "stretched", "two-power-laws"):
        whole = kernel_of(SHAPES[name], REACH_PX, **MORE)
        for size in (65, 128):
            part = kernel_of(SHAPES[name], size, **MORE)
            np.testing.assert_allclose(part, crop_centred(whole, (size, size)), rtol=1e-12)
        larger = kernel_of(SHAPES[name], REACH_PX + 2, **MORE)
        assert larger.shape == (REACH_PX + 2, REACH_PX + 2)
        np.testing.assert_allclose(crop_centred(larger, whole.shape), whole, rtol=1e-12)
        assert larger.sum() > 1 + 1e-6


def test_coordinates_and_values_are_inverse_functions_within_bounds() -> None:
    for shape in SHAPES.values():
        values = {name: (LAW | MORE)[name] for name in shape.names}
        assert shape.values(shape.coordinates(values)) == pytest.approx(values, rel=1e-14)
        at = np.linspace(-0.7, 1.9, len(shape.parameters))
        np.testing.assert_allclose(shape.coordinates(shape.values(at)), at, rtol=1e-12)
        np.testing.assert_allclose(shape.coordinates({}), shape.start)
    for parameter in SHAPES["stretched"].parameters[:4]:
        coordinate = parameter.coordinate(0.3)
        ahead, behind = parameter.value(coordinate + 1e-5), parameter.value(coordinate - 1e-5)
        assert parameter.slope(coordinate) == pytest.approx((ahead - behind) / 2e-5, rel=1e-7)
    for at in (-30.0, 30.0):
        values = SOFTENED_POWER_LAW.values(np.array([at, 2.5, at]))
        assert values["b_px"] > 0 and 0 < values["total"] < 1
    for beyond in ([800.0, 2.5, 0.0], [0.0, 2.5, -800.0], [np.nan, 2.5, 0.0]):
        with pytest.raises(DataError, match=r"transit-says-too-little.*expected images that determine"):
            SOFTENED_POWER_LAW.values(np.array(beyond))
    step = np.array([4.0, 0.3, -0.4])  # eight times the largest of b
    shorter, whole = SOFTENED_POWER_LAW.shortened(step)
    assert not whole
    np.testing.assert_allclose(shorter, step / 8)
    same, whole = SOFTENED_POWER_LAW.shortened(shorter)
    assert whole and np.array_equal(same, shorter)


def test_an_unknown_shape_is_refused_with_the_known_ones() -> None:
    assert shape_named("knee") is SHAPES["knee"]
    with pytest.raises(DataError, match=r"unknown-shape.*softened-power-law.*'spiral'"):
        shape_named("spiral")
