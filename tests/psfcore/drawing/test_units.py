"""Pictures name the unit that the header gives."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from psfcore.drawing.units import rate_label, unit_label
from psfcore.image import Image


@pytest.mark.parametrize(
    ("unit", "exposure_s", "cards", "label", "rate"),
    [
        ("DN/s", 2.0, {}, "DN/s", "DN/s"),
        ("DN", 2.000096, {}, "DN in 2 s", "DN/s"),
        ("DN", None, {}, "DN, exposure unknown", "DN/s"),
        (None, 2.0, {"PIXLUNIT": "DN"}, "DN in 2 s", "DN/s"),
        (None, 2.0, {}, "unit unknown", "unit unknown, per s"),
        ("counts", 0.5, {}, "counts in 0.5 s", "counts/s"),
        ("W m-2 sr-1", 2.0, {}, "W m-2 sr-1", "W m-2 sr-1"),
        (r"$\frac{$", 2.0, {}, r"\frac{", r"\frac{"),
        ("$", 2.0, {}, "unit unknown", "unit unknown, per s"),
    ],
)
def test_the_label_is_the_unit_of_the_header(
    unit: str | None, exposure_s: float | None, cards: dict[str, str], label: str, rate: str
) -> None:
    image = Image(np.ones((16, 16)), np.zeros((16, 16), np.uint8), fits.Header(cards), unit, exposure_s)
    assert (unit_label(image), rate_label(image)) == (label, rate)
