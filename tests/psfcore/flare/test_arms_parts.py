"""The parts of the measurement of arms: the prepared image, the search, and the orders that are used."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.flare.arms_fit import (
    Geometry,
    check_enough_orders,
    order_positions,
    orders_between,
    select_pixels,
)
from psfcore.flare.arms_search import prepared, ring_halo, search_arms, smooth, source_centre

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


def test_smoothing_ignores_unusable_pixels() -> None:
    plane, usable = np.full(SHAPE, 4.0), ALL.copy()
    plane[30:33, 40:43], usable[30:33, 40:43] = 1e6, False
    np.testing.assert_allclose(smooth(plane, usable, 1.5), 4.0)


def test_the_halo_is_the_ring_median_without_the_arms() -> None:
    y, x = np.indices(SHAPE)
    radius = np.hypot(x - 40, y - 30)
    halo = 100 / (1 + radius)
    image = halo + np.where(np.abs(y - 30) <= 1, 50.0, 0.0)
    found = ring_halo(image, ALL, (40.0, 30.0), np.array([0.0]), 3.0)
    away = (radius > 5) & (radius < 28)
    np.testing.assert_allclose(found[away], halo[away], rtol=0.15)


# --- the search ------------------------------------------------------------------------------------------


SEARCHED_PX, SEARCHED_CENTRE = 201, (100.0, 100.0)
ANGLES_DEG, SPACING_PX = (-70.0, 20.0), 9.0


def with_orders() -> NDArray[np.float64]:
    y, x = np.indices((SEARCHED_PX, SEARCHED_PX))
    image = np.random.default_rng(1).normal(10.0, 1.0, (SEARCHED_PX, SEARCHED_PX))
    for angle in np.deg2rad(ANGLES_DEG):
        for k in (*range(-10, 0), *range(1, 11)):
            along = k * SPACING_PX
            apart = np.hypot(
                x - SEARCHED_CENTRE[0] - along * np.cos(angle), y - SEARCHED_CENTRE[1] - along * np.sin(angle)
            )
            image += 30 * np.exp(-0.5 * (apart / 1.2) ** 2)
    return image


def test_angles_and_spacing_are_found() -> None:
    image = with_orders()
    everywhere = np.ones(image.shape, dtype=bool)
    angles, spacing = search_arms(image, everywhere, SEARCHED_CENTRE, 2, (12.0, 95.0))
    assert angles == pytest.approx(ANGLES_DEG, abs=0.5)
    assert spacing == pytest.approx(SPACING_PX, rel=0.01)


# --- the orders ------------------------------------------------------------------------------------------


PATTERN = np.array([0.0, np.pi / 2, 10.0])  # two arms, along x and y; orders 10 px apart
GEOMETRY = Geometry((50.0, 50.0), 3.0, (15.0, 40.0))


def test_orders_lie_at_multiples_of_the_spacing() -> None:
    arm, k = orders_between(PATTERN, GEOMETRY.radii_px)
    assert sorted(set(np.abs(k))) == [2, 3, 4] and arm.tolist() == [0] * 6 + [1] * 6
    x, y = order_positions(GEOMETRY.centre, PATTERN, arm, k)
    np.testing.assert_allclose(x[:6], 50 + 10 * k[:6])
    np.testing.assert_allclose(y[:6], 50.0)
    np.testing.assert_allclose(y[6:], 50 + 10 * k[6:])


def test_orders_on_unusable_pixels_or_off_the_image_are_left_out() -> None:
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


def test_an_arm_of_few_orders_is_refused() -> None:
    check_enough_orders(np.array([0, 0, 0, 1, 1, 1]), 2)
    with pytest.raises(DataError, match=r"expected at least 3 orders .*; got 3, 1") as caught:
        check_enough_orders(np.array([0, 0, 0, 1]), 2)
    assert caught.value.code == "too-few-peaks"
