"""Fits with dark offsets: how the PSF changes with a wrong dark level."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from psfcore.scatter.validation.dark_offsets import dark_offset_study, with_offset
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from tests.psfcore.evaluation.small_evaluations import offsets
from tests.psfcore.small_transits import SIZE_PX, observed, sky
from tests.transit_files import drawn_truth, hri_diffraction


def test_an_offset_is_divided_by_the_exposure() -> None:
    transit = observed(sky()).transit
    for before, after in zip(transit.frames, with_offset(transit, -3.0).frames, strict=True):
        np.testing.assert_allclose(
            after.pixels, before.pixels - 3.0 / before.exposure_s, rtol=1e-5, atol=1e-4
        )


def test_a_positive_offset_is_fitted_as_more_scatter() -> None:
    study = offsets()
    low, high = study.offsets
    assert (low.offset_dn, high.offset_dn) == (-5.0, 5.0)
    assert (high.curve_change_points > 0).all() and (low.curve_change_points < 0).all()
    assert (high.total_curve_change_points > 0).all()
    assert high.values["total"] > study.nominal["total"] > low.values["total"]
    assert study.radii_px[0] == 1 and study.radii_px[-1] == SIZE_PX - 1
    assert study.curve_radii_px[0] == 0.5
    # Outside the central pixel, the curve is the total.
    for offset in study.offsets:
        change = offset.values["total"] - study.nominal["total"]
        assert offset.curve_change_points[0] == pytest.approx(100 * change, rel=1e-6)
    changes = [np.abs(o.weight_change_pct).max() for o in study.offsets]
    assert study.largest_weight_change_pct == max(changes) > 2
    assert 0.5 < study.largest_curve_change_points < 4


def test_weights_change_as_the_fitted_formulas_do() -> None:
    study = offsets()
    nominal, other = ({**v} for v in (study.nominal, study.offsets[1].values))
    kernels = [SOFTENED_POWER_LAW.kernel(SOFTENED_POWER_LAW.coordinates(v), 512) for v in (other, nominal)]
    at = np.flatnonzero(study.radii_px == 20)[0]
    ratio = kernels[0][256, 276] / kernels[1][256, 276]
    assert study.offsets[1].weight_change_pct[at] == pytest.approx(100 * (ratio - 1), abs=0.02)


@pytest.mark.slow
def test_dark_offsets_of_a_transit_of_the_usual_size() -> None:
    for brightness in (1.0, 3.0):
        plan = default_plan(30, 512, brightness=brightness)
        study = dark_offset_study(simulate(plan, drawn_truth(0), hri_diffraction(1024), 0).transit)
        assert study.largest_weight_change_pct < 60 / brightness
        assert study.largest_curve_change_points < 5 / brightness
