"""The unit in which two images of a flare are compared."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from psfcore.flare.judge import _same_unit
from psfcore.image import Image


def image(value: float, unit: str | None, exposure_s: float | None) -> Image:
    return Image(np.full((16, 16), value), np.zeros((16, 16), np.uint8), fits.Header(), unit, exposure_s)


@pytest.mark.parametrize(
    ("unit", "exposure_s", "light", "label"),
    [
        ("DN", 2.0, 4.0, "DN/s"),
        ("DN/s", 2.0, 8.0, "DN/s"),
        (None, 2.0, 4.0, "unit unknown, per s"),
        ("DN", None, 8.0, "DN, exposure unknown"),
        (None, None, 8.0, "unit unknown"),
    ],
)
def test_the_unit_is_that_of_the_header(
    unit: str | None, exposure_s: float | None, light: float, label: str
) -> None:
    flaring, quiet, said = _same_unit(image(8.0, unit, exposure_s), image(2.0, unit, exposure_s))
    assert said == label
    assert (flaring == light).all() and (quiet == light / 4).all()
