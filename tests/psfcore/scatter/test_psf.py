"""The total PSF, its slopes and its convolution with a field."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.deconvolve.iterations.linear import inverse_filter, solve_linear
from psfcore.noise import Noise
from psfcore.psf import CURVE_RADII_PX, REACH_GRID_PX, cumulative_curve
from psfcore.scatter.power_law import scatter_kernel
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import (
    NOISE_REACH_PX,
    Blur,
    Optics,
    TotalPsf,
    around_disc,
    noise_covariance,
    pick,
    put,
)
from psfcore.simulate.scatter_truth import ScatterTruth, total_kernel
from psfcore.transit.occulter import fully_dark
from psfcore.transit.transit import Frame, Place
from tests.psfcore.small_transits import DIFFRACTION, SCATTER

AT = SOFTENED_POWER_LAW.coordinates({"b_px": 6.15, "c": 2.53, "total": 0.411})


def test_scatter_and_diffraction_convolve_for_any_size() -> None:
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
    wide = np.zeros((401, 401))
    wide[200, 200], wide[200, 390] = 0.9, 0.1  # the second is farther than two pixels of a 64 px field
    total = TotalPsf(wide, SOFTENED_POWER_LAW, (64, 64))
    scatter = SOFTENED_POWER_LAW.kernel(AT, 128)
    np.testing.assert_allclose(total.kernel(AT), 0.9 * scatter, rtol=1e-9, atol=1e-15)


def test_curve_slopes_are_differences_of_curves() -> None:
    total = TotalPsf(DIFFRACTION, SOFTENED_POWER_LAW, (64, 64))
    assert total.radii_px.tolist() == [0.5, 2, 5, 10, 20, 50]
    assert set(total.radii_px) < set(CURVE_RADII_PX)
    slopes = total.slopes(AT)
    found = total.curve_slopes(slopes)
    assert found.shape == (6, 3)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-3
        ahead, behind = (cumulative_curve(total.kernel(AT + side * step), total.radii_px) for side in (1, -1))
        np.testing.assert_allclose(found[:, k], (ahead - behind) / 2e-3, rtol=1e-8)
    assert (found[:, 2] > 0).all()  # more scatter, more light beyond every distance


# --- convolution in the order of the engine --------------------------------------------------------------


FIELDS = [(64, 64), (100, 131), (97, 40), (33, 64), (17, 50), (47, 48)]
LOPSIDED = total_kernel(
    ScatterTruth(6.15, 2.53, 0.411, stretch=0.2, angle_deg=30.0, dipole=0.3), DIFFRACTION, 200
)


def scene(shape: tuple[int, int], seed: int = 1) -> NDArray[np.float64]:
    """A bright field with point sources, some at its edge."""
    rng = np.random.default_rng(seed)
    return np.asarray(rng.uniform(50, 150, shape) + 2000 * (rng.random(shape) > 0.98))


def test_it_is_the_convolution_with_a_kernel_of_any_sign() -> None:
    more = scatter_kernel(6.2, 2.5, 0.42, 128) - scatter_kernel(6.1, 2.5, 0.41, 128)
    for kernel, shape in itertools.product((LOPSIDED, more), FIELDS):
        blur, plain, x = Blur(kernel, shape), Convolver(kernel, shape, dtype=np.float64), scene(shape)
        seen, back = blur.convolve(blur.lanes(x)), blur.correlate(blur.lanes(x))
        for lanes, expected in ((seen, plain.apply(x)), (back, plain.adjoint(x))):
            np.testing.assert_allclose(blur.field(lanes), expected, atol=1e-5 * np.abs(expected).max())


def test_nothing_is_left_beyond_the_fields_last_row() -> None:
    """Two passes give the same result as two passes with a crop between them."""
    for shape in FIELDS:
        optics, x = Optics(LOPSIDED, shape), scene(shape)
        lanes = optics.lanes(x)
        once = optics.convolve(lanes)
        np.testing.assert_array_equal(once, optics.lanes(optics.field(once)))
        undone = optics.invert_once(lanes, adjoint=True)
        np.testing.assert_array_equal(undone, optics.lanes(optics.field(undone)))
        np.testing.assert_array_equal(lanes, optics.lanes(x))  # the input is not modified


def dot(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    return float(np.vdot(a.astype(np.float64), b.astype(np.float64)))


def test_adjoints() -> None:
    for shape in FIELDS:
        optics = Optics(LOPSIDED, shape)
        points = scene(shape) - 150
        x, y = (optics.lanes(plane) for plane in (points, np.roll(points, (2, 3), axis=(0, 1))))
        size = np.sqrt(dot(x, x) * dot(y, y))
        assert dot(optics.convolve(x), y) == pytest.approx(dot(x, optics.correlate(y)), abs=1e-6 * size)
        back = dot(x, optics.invert_once(y, adjoint=True))
        assert dot(optics.invert_once(x), y) == pytest.approx(back, abs=1e-6 * size)
        # This PSF is not symmetric.
        assert abs(dot(optics.convolve(x), y) - dot(x, optics.convolve(y))) > 1e-4 * size


def test_inversion_recovers_the_scene() -> None:
    kernel = total_kernel(SCATTER, DIFFRACTION, 280)
    for shape in FIELDS[:2]:
        optics, x = Optics(kernel, shape), scene(shape)
        observed = optics.lanes(Convolver(kernel, shape, dtype=np.float64).apply(x))
        off = {n: np.abs(optics.field(optics.invert(observed, steps=n)) - x).max() for n in (0, 1, 2, 5, 8)}
        assert off[0] > 500
        assert off[8] == off[5] <= off[2] < off[1], "it ends when it is settled"
        assert off[5] < 0.5
        nearly = optics.invert(observed, optics.lanes(x + 1.0), steps=3)
        np.testing.assert_allclose(optics.field(nearly), x, atol=0.1)


def test_a_settled_scene_scatters_the_light_of_one_with_many_steps() -> None:
    kernel = total_kernel(SCATTER, DIFFRACTION, 280)
    for shape in FIELDS[:2]:
        optics = Optics(kernel, shape)
        observed, pixels = optics.lanes(scene(shape)), np.nonzero(np.eye(*shape))
        many = solve_linear(optics.engine, inverse_filter(optics.engine), observed, observed.copy(), 20)
        settled, exact = (
            pick(optics.convolve(scene), pixels) for scene in (optics.invert(observed, steps=20), many)
        )
        np.testing.assert_allclose(settled, exact, rtol=1e-4)


def test_light_in_pixels_is_that_of_whole_fields() -> None:
    """Eq. (5), one operator after the other."""
    kernel = total_kernel(SCATTER, DIFFRACTION, 200)
    slopes = [kernel - LOPSIDED, LOPSIDED * np.indices(LOPSIDED.shape)[1] / 200]
    for shape in FIELDS:
        optics, blurs = Optics(kernel, shape), [Blur(slope, shape) for slope in slopes]
        disc = np.hypot(*(np.indices(shape) - np.array(shape)[:, None, None] + 11)) < 10  # near the last row
        pixels, x = np.nonzero(disc), scene(shape) * ~disc
        lanes = optics.lanes(x)
        expected = pick(optics.convolve(lanes), pixels)
        for twin in (optics, *Optics(kernel, shape, threads=2).twins()):
            found, responses = twin.light_in(pixels, lanes, blurs)
            np.testing.assert_allclose(found, expected, rtol=1e-5)
            for response, blur in zip(responses, blurs, strict=True):
                changed = blur.convolve(lanes)
                estimated = optics.invert_once(changed)
                put(estimated, pixels, 0.0)
                by_hand = pick(changed, pixels) - pick(optics.convolve(estimated), pixels)
                scale = np.abs(pick(changed, pixels)).max()
                np.testing.assert_allclose(response, by_hand, atol=1e-5 * scale)
        np.testing.assert_array_equal(optics.field(lanes), x.astype(np.float32))
        nothing = (np.zeros(0, np.intp), np.zeros(0, np.intp))
        assert optics.light_in(nothing, lanes, blurs)[1].shape == (2, 0)
        with pytest.raises(ValueError, match="derivatives"):
            optics.light_in(pixels, lanes, [Blur(kernel, (300, 300))])


def test_noise_far_from_a_disc_adds_nothing() -> None:
    """Also if the field ends near the disc."""
    size, reach = 2 * NOISE_REACH_PX + 160, NOISE_REACH_PX + 11
    field, part = (size, size), (2 * reach, 2 * reach)
    kernel = TotalPsf(DIFFRACTION, SOFTENED_POWER_LAW, field).kernel(AT)
    optics, near = Optics(kernel, field), Optics(kernel, part)
    for place in (Place(280.2, 285.0, 10.75), Place(14.0, 300.0, 10.75)):
        dark = np.nonzero(fully_dark(field, place))
        pixels = 200 * (1 + np.indices(field)[1] / 100).astype(np.float32)
        pixels[dark] *= 0.02
        frame = Frame("a", pixels, 1, place, 1.0, 0.0)
        templates = [np.full(dark[0].size, 1 / dark[0].size), (dark[0] - place.y_px) / dark[0].size]
        whole = noise_covariance(optics, frame, dark, templates, Noise(6.0, 2.0))
        cut, here = around_disc(frame, dark, part)
        assert cut.pixels.shape == part
        np.testing.assert_array_equal(cut.pixels[here], pixels[dark])
        found = noise_covariance(near, cut, here, templates, Noise(6.0, 2.0))
        size_of = np.sqrt(np.diag(whole))
        np.testing.assert_allclose(found, whole, rtol=0, atol=2e-5 * np.outer(size_of, size_of).min())


def test_single_pixels_are_the_right_ones() -> None:
    rng = np.random.default_rng(0)
    for shape in FIELDS:
        blur, x = Blur(DIFFRACTION, shape), scene(shape)
        rows, columns = (np.append(rng.integers(0, n, 60), (0, n - 1)) for n in shape)
        lanes, expected = blur.lanes(x), x.astype(np.float32)
        np.testing.assert_array_equal(pick(lanes, (rows, columns)), expected[rows, columns])
        expected[rows, columns] = 0.0
        put(lanes, (rows, columns), 0.0)
        np.testing.assert_array_equal(blur.field(lanes), expected)
        one = (np.array([shape[0] - 1]), np.array([3]))
        put(lanes, one, np.array([7.0]))
        assert pick(lanes, one) == 7.0 and blur.field(lanes)[-1, 3] == 7.0
