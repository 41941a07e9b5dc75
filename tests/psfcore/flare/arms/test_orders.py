"""Orders lie where Eq. (1) puts them, and only usable ones are fitted."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.flare.arms.orders import (
    Geometry,
    check_enough_orders,
    order_positions,
    orders_between,
    select_pixels,
)

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
