"""The measurement recovers the arms of a simulated flare, and its stated errors cover the true values; and its
parts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.convolution.convolver import linear_convolve
from psfcore.diffraction.mesh_series import order_spacing_px, rotated_mesh_kernel
from psfcore.errors import DataError
from psfcore.flare.arms import (
    ArmMeasurement,
    measure_arms,
    prepared,
    smooth,
    source_centre,
)
from psfcore.flare.arms_fit import (
    Geometry,
    check_enough_orders,
    orders_between,
    select_pixels,
)
from psfcore.flare.plots import arms_png

ANGLE_DEG = 1.3
SPACING_PX = order_spacing_px(
    wavelength_angstrom=174.0, distance_mm=4187.0, pitch_um=1270.0, pixel_pitch_um=10.0
)
SIZE = 240
FINE = 6  # samples a pixel, so that orders do not all lie on pixel centres
CENTRE = (123.3, 118.8)
FLARE_PX = 5
FLARE_PHOTONS = 6e4  # a pixel of the core
SATURATION = 20_000.0
READ_NOISE = 2.0


def flare_light() -> NDArray[np.float64]:
    """Expected light [y, x] of a 5 x 5 px flare of one photon per pixel: mesh orders and a wide halo."""
    n = SIZE * FINE
    kernel = rotated_mesh_kernel(
        FINE * SPACING_PX, pitch_um=1270.0, wire_um=40.0, windows=37, angle_deg=ANGLE_DEG, size=n
    )
    fine = (np.arange(n) + 0.5) / FINE - 0.5
    x, y = fine[None, :] - CENTRE[0], fine[:, None] - CENTRE[1]
    uneven = 1 + 0.3 * x / FLARE_PX - 0.2 * y / FLARE_PX
    flare = np.where((abs(x) < FLARE_PX / 2) & (abs(y) < FLARE_PX / 2), uneven, 0.0)
    flare *= FLARE_PX**2 / flare.sum()
    seen = linear_convolve(flare, kernel, (n, n), threads=2)
    pixels = seen.reshape(SIZE, FINE, SIZE, FINE).sum(axis=(1, 3))
    yy, xx = np.indices((SIZE, SIZE))
    radius = np.hypot(xx - CENTRE[0], yy - CENTRE[1])
    return np.maximum(pixels, 0) + FLARE_PX**2 * 0.152 / (6.15 + radius) ** 2.53


def corona() -> NDArray[np.float64]:
    yy, xx = np.indices((SIZE, SIZE))
    return 50.0 * (1 + 0.3 * np.sin(xx / 90) + 0.2 * np.cos(yy / 70))


@pytest.fixture(scope="module")
def expected() -> NDArray[np.float64]:
    return FLARE_PHOTONS * flare_light() + corona()


def observed(expected: NDArray[np.float64], seed: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    rng = np.random.default_rng(seed)
    image = rng.poisson(expected) + rng.normal(0, READ_NOISE, expected.shape)
    saturated = image >= SATURATION
    return np.minimum(image, SATURATION), saturated


def measured(expected: NDArray[np.float64], seed: int) -> ArmMeasurement:
    image, saturated = observed(expected, seed)
    return measure_arms(image, saturated=saturated)


def check_arms(found: ArmMeasurement) -> None:
    """Check that angles and spacing are the true ones."""
    assert found.angles_deg == pytest.approx((ANGLE_DEG - 90, ANGLE_DEG), abs=0.1)
    assert found.spacing_px == pytest.approx(SPACING_PX, abs=0.02)


def test_angles_and_spacing_are_recovered_and_the_fit_is_plotted(
    expected: NDArray[np.float64], tmp_path: Path
) -> None:
    found = measured(expected, 100)
    check_arms(found)
    assert 0.005 < min(found.angles_sigma_deg) <= max(found.angles_sigma_deg) < 0.05
    assert 0.0005 < found.spacing_sigma_px < 0.005
    assert 0.9 < found.reduced_chi2 < 1.5  # the spline cannot quite follow a flare with sharp edges
    assert len(found.peaks) > 40
    assert "less than" in found.stopped_because
    arms_png(observed(expected, 100)[0], found, tmp_path / "arms.png", unit="DN")
    assert matplotlib.image.imread(tmp_path / "arms.png").std() > 0.05


@pytest.mark.slow
def test_errors_cover_the_true_values(expected: NDArray[np.float64]) -> None:
    pulls = []
    for seed in range(36):
        found = measured(expected, seed)
        truth = (ANGLE_DEG - 90, ANGLE_DEG, SPACING_PX)
        values = (*found.angles_deg, found.spacing_px)
        errors = (*found.angles_sigma_deg, found.spacing_sigma_px)
        pulls.append([(v - t) / e for v, t, e in zip(values, truth, errors, strict=True)])
    mean, width = np.mean(pulls, axis=0), np.std(pulls, axis=0, ddof=1)
    assert np.all(np.abs(mean) < 0.4), mean
    assert np.all((width > 0.7) & (width < 1.4)), width


def test_arms_of_a_difference_and_of_an_inexact_centre(
    expected: NDArray[np.float64],
) -> None:
    image, saturated = observed(expected, 5)
    before = np.random.default_rng(6).poisson(corona()).astype(float)
    check_arms(measure_arms(image, reference=before, saturated=saturated))
    image, saturated = observed(expected, 7)
    image[30:40, 100:140] = np.nan
    found = measure_arms(image, (124.5, 118.0), saturated=saturated)
    check_arms(found)
    assert found.centre_xy == (124.5, 118.0)
    assert not any(30 <= peak.y_px < 40 and 100 <= peak.x_px < 140 for peak in found.peaks)


def test_images_without_measurable_arms_are_refused() -> None:
    image = np.random.default_rng(0).poisson(100, (SIZE, SIZE)).astype(float)
    with_spot = image.copy()
    with_spot[110:115, 110:115] = 1e5
    everything = np.ones(image.shape, dtype=bool)
    cases: list[tuple[str, dict[str, object]]] = [
        ("no-flare", {"image": image}),
        ("all-masked", {"image": image, "saturated": everything}),
        ("all-masked", {"image": np.full(image.shape, np.nan)}),
        ("too-few-peaks", {"image": with_spot, "saturated": with_spot > 1e4}),
        ("arms-bad-input", {"image": image, "reference": image[:100]}),
        ("arms-bad-input", {"image": image, "centre_xy": (1e4, 3.0)}),
        # Every direction scores the same, so the chosen arms leave the image at once.
        ("too-few-peaks", {"image": image, "reference": image, "centre_xy": (1.0, 1.0)}),
        ("too-few-peaks", {"image": image, "reference": image, "centre_xy": (SIZE - 1.0, SIZE - 1.0)}),
    ]
    for code, arguments in cases:
        with pytest.raises(DataError, match=r"expected .*;") as caught:
            measure_arms(**arguments)  # type: ignore[arg-type]
        assert caught.value.code == code


def test_the_arms_of_the_aiapy_psf_are_recovered(real: Callable[[str], Path]) -> None:
    """aiapy built this PSF with a spacing of 16.26 px and four angles.

    The PSF has no noise, so the stated errors are not tested.
    """
    middle = slice(2048 - 150, 2048 + 151)
    path = real("psf/derived_aia171_psf_aiapy0.10.2.fits")
    psf = np.asarray(fits.getdata(path), dtype=np.float64)[middle, middle]
    found = measure_arms(psf, (150.0, 150.0), n_arms=4)
    assert found.angles_deg == pytest.approx((-50.38, -40.13, 39.57, 49.81), abs=0.05)
    assert found.spacing_px == pytest.approx(16.26, abs=0.005)


def test_flare_loops_at_the_limb_are_refused(real: Callable[[str], Path]) -> None:
    """The loops are 100 px across, so their orders, 16 px apart, overlap: an error must come, not a number."""
    files = sorted(real("aia/limbflare_20120719").glob("*.fits"))
    with fits.open(files[1]) as hdus:
        image = np.asarray(next(h.data for h in hdus if h.data is not None), dtype=np.float64)
    with pytest.raises(DataError, match="too-few-peaks"):
        measure_arms(image, saturated=image > 15_000, n_arms=4)


# --- the image -------------------------------------------------------------------------------------------


SHAPE = (61, 81)
ALL = np.ones(SHAPE, dtype=bool)


def test_the_difference_is_zero_where_it_cannot_be_used() -> None:
    image, reference = np.full(SHAPE, 5.0), np.full(SHAPE, 2.0)
    image[3, 4] = np.nan
    saturated = np.zeros(SHAPE, dtype=bool)
    saturated[20:25, 30:35] = saturated[50, 50] = True
    difference, usable, patch = prepared(image, reference, saturated)
    assert difference[3, 4] == difference[22, 32] == 0 and difference[0, 0] == 3
    assert (~usable).sum() == 1 + 25 + 1
    assert patch.sum() == 25 and patch[22, 32]
    difference[~usable] = 1e6
    np.testing.assert_allclose(smooth(difference, usable, 1.5), 3.0)


def test_the_centre_is_the_given_one_or_the_patch_or_the_brightest_pixel() -> None:
    plane, patch = np.random.default_rng(0).normal(size=SHAPE), np.zeros(SHAPE, dtype=bool)
    plane[40, 60] = 1e4
    assert source_centre(plane, ALL, patch, (7.0, 8.0))[0] == (7.0, 8.0)
    assert source_centre(plane, ALL, patch, None)[0] == (60.0, 40.0)
    patch[10:15, 20:25] = True
    centre, radius = source_centre(plane, ALL, patch, None)
    assert centre == (22.0, 12.0) and radius == pytest.approx(5 / np.sqrt(np.pi))
    with pytest.raises(DataError, match=r"expected a centre \(x, y\) on the image of 81 x 61 px; got"):
        source_centre(plane, ALL, patch, (81.0, 3.0))


# --- the orders ------------------------------------------------------------------------------------------


PATTERN = np.array([0.0, np.pi / 2, 10.0])  # two arms, along x and y; orders 10 px apart
GEOMETRY = Geometry((50.0, 50.0), 3.0, (15.0, 40.0))


def test_orders_on_unusable_pixels_are_left_out_and_few_refused() -> None:
    usable = np.ones((85, 101), dtype=bool)  # the order at y = 90 is off the image
    usable[45:56, 66:75] = False  # around the order at x = 70
    arm, k = orders_between(PATTERN, GEOMETRY.radii_px)
    plane = np.arange(usable.size, dtype=float).reshape(usable.shape)
    orders = select_pixels(plane, usable, np.ones(usable.shape), GEOMETRY, PATTERN, arm, k)
    assert sorted(orders.k[orders.arm == 0]) == [-4, -3, -2, 3, 4]
    assert sorted(orders.k[orders.arm == 1]) == [-4, -3, -2, 2, 3]
    assert usable[orders.row, orders.column].all()
    np.testing.assert_array_equal(orders.value, plane[orders.row, orders.column])
    np.testing.assert_array_equal(orders.number[orders.row, orders.column], np.arange(orders.row.size))
    pixels, basis = orders.planes()[0]
    assert (orders.nearest[pixels] == 0).all()
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-12)
    check_enough_orders(np.array([0, 0, 0, 1, 1, 1]), 2)
    with pytest.raises(DataError, match=r"expected at least 3 orders .*; got 3, 1") as caught:
        check_enough_orders(np.array([0, 0, 0, 1]), 2)
    assert caught.value.code == "too-few-peaks"
