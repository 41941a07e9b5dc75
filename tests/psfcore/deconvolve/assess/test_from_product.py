"""A row of the contact sheet from a product: the figures come back from JSON as they went in."""

from __future__ import annotations

import json

import numpy as np
from astropy.io.fits import Header

from psfcore.deconvolve.assess.changes import measure_changes
from psfcore.deconvolve.assess.from_product import changes_from_json
from psfcore.image import Image
from psfcore.psf import Psf


def test_figures_come_back_from_json() -> None:
    rng = np.random.default_rng(1)
    before = rng.poisson(50, (96, 128)) + 400.0 * (rng.random((96, 128)) > 0.99)
    image = Image(before, np.zeros(before.shape, np.uint8), Header(), "DN", 1.0)
    kernel = np.zeros((17, 17))
    kernel[8, 8] = 1.0
    after = before * 1.1
    after[40:60:5, 30:90:9] = -100
    found = measure_changes(image, after, Psf(kernel, "point", "1", None, "draft"))
    again = changes_from_json(json.loads(json.dumps(found.as_json())), found.artefacts.suspected)
    assert again.as_json() == found.as_json()
    assert again.structures == found.structures and again.ranges == found.ranges
    np.testing.assert_array_equal(again.artefacts.suspected, found.artefacts.suspected)
