"""The search finds angles and spacing to within its own steps."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.flare.arms.search import search_arms

SIZE, CENTRE = 201, (100.0, 100.0)
ANGLES_DEG, SPACING_PX = (-70.0, 20.0), 9.0


def with_orders() -> NDArray[np.float64]:
    y, x = np.indices((SIZE, SIZE))
    image = np.random.default_rng(1).normal(10.0, 1.0, (SIZE, SIZE))
    for angle in np.deg2rad(ANGLES_DEG):
        for k in (*range(-10, 0), *range(1, 11)):
            along = k * SPACING_PX
            apart = np.hypot(x - CENTRE[0] - along * np.cos(angle), y - CENTRE[1] - along * np.sin(angle))
            image += 30 * np.exp(-0.5 * (apart / 1.2) ** 2)
    return image


@pytest.mark.parametrize("near", [None, (-69.0, 21.5)])
def test_angles_and_spacing_are_found(near: tuple[float, ...] | None) -> None:
    image = with_orders()
    angles, spacing = search_arms(
        image, np.ones(image.shape, dtype=bool), CENTRE, 2, (5.0, 15.0), near, (12.0, 95.0)
    )
    assert angles == pytest.approx(ANGLES_DEG, abs=0.5)
    assert spacing == pytest.approx(SPACING_PX, rel=0.01)
