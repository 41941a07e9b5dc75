"""The total PSF is scatter convolved with diffraction, and its slopes are the derivatives of its kernel."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.convolution.convolver import linear_convolve
from psfcore.psf import REACH_GRID_PX, crop_centred, cumulative_curve
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import CURVE_RADII_PX, TotalPsf
from psfcore.simulate.scatter_truth import total_kernel
from tests.psfcore.small_transits import DIFFRACTION, SCATTER

AT = SOFTENED_POWER_LAW.coordinates({"b_px": 6.15, "c": 2.53, "total": 0.411})


def test_scatter_and_diffraction_convolve() -> None:
    """The square agrees with the full reach, except for light that is diffracted back from outside it."""
    total = TotalPsf(DIFFRACTION, SOFTENED_POWER_LAW, (100, 131))
    assert total.size == 262
    assert TotalPsf(DIFFRACTION, SOFTENED_POWER_LAW, (1500, 10)).size == REACH_GRID_PX, (
        "not more than the full reach"
    )
    kernel = total.kernel(AT)
    by_hand = linear_convolve(SOFTENED_POWER_LAW.kernel(AT, 262), DIFFRACTION, (262, 262))
    np.testing.assert_allclose(kernel, by_hand, atol=1e-15)
    truth = total_kernel(SCATTER, DIFFRACTION, 262)
    inner = (slice(16, -16), slice(16, -16))
    np.testing.assert_allclose(kernel[inner], truth[inner], rtol=1e-10)
    np.testing.assert_allclose(kernel, truth, atol=1e-7)


def test_a_pattern_larger_than_the_square_counts_where_it_reaches() -> None:
    wide = np.zeros((401, 401))
    wide[200, 200], wide[200, 390] = 0.9, 0.1  # the second is farther than two pixels of a 64 px field
    total = TotalPsf(wide, SOFTENED_POWER_LAW, (64, 64))
    scatter = SOFTENED_POWER_LAW.kernel(AT, 128)
    np.testing.assert_allclose(total.kernel(AT), 0.9 * scatter, rtol=1e-9, atol=1e-15)


def test_slopes_are_differences_of_kernels() -> None:
    for name, k in (*(("softened-power-law", k) for k in range(3)), ("stretched", 4)):
        shape = SHAPES[name]
        total = TotalPsf(DIFFRACTION, shape, (64, 64))
        at = shape.coordinates({"b_px": 6.15, "c": 2.53, "total": 0.411})
        axis = np.eye(at.size)[k]
        near, far = (
            (total.kernel(at + h * axis) - total.kernel(at - h * axis)) / (2 * h) for h in (4e-3, 8e-3)
        )
        expected = (4 * near - far) / 3
        largest = np.abs(expected).max()
        assert largest > 1e-4
        np.testing.assert_allclose(total.slope(at, k), expected, atol=1e-5 * largest)


def test_curve_slopes_are_differences_of_curves() -> None:
    total = TotalPsf(DIFFRACTION, SOFTENED_POWER_LAW, (64, 64))
    assert total.radii_px.tolist() == [0.5, 2, 5, 10, 20, 50]
    assert set(total.radii_px) < set(CURVE_RADII_PX)
    slopes = total.slopes(AT)
    for k, slope in enumerate(slopes):
        np.testing.assert_array_equal(slope, total.slope(AT, k))
    found = total.curve_slopes(slopes)
    assert found.shape == (6, 3)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-3
        ahead, behind = (cumulative_curve(total.kernel(AT + side * step), total.radii_px) for side in (1, -1))
        np.testing.assert_allclose(found[:, k], (ahead - behind) / 2e-3, rtol=1e-8)
    assert (found[:, 2] > 0).all()  # more scatter, more light beyond every distance
    crop = crop_centred(total.kernel(AT), (64, 64))
    assert cumulative_curve(crop, [20.0]) == pytest.approx(cumulative_curve(total.kernel(AT), [20.0]))
