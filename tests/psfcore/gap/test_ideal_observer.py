"""The ideal observer: what hypotheses leave, compared with dense least squares; an effect that the library knows leaves nothing."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.linear_model import UNLIKELY
from psfcore.gap.ideal_observer import IdealObserver, Left, ideal_observer, left_by_hypotheses
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import SimulatedTransit, simulate
from psfcore.transit.transit import Transit
from tests.psfcore.gap.linear_models import FEW, dense, effect_of, with_residuals
from tests.psfcore.gap.small_gaps import changed
from tests.transit_files import TRUTH, diffraction


@cache
def simulated() -> SimulatedTransit:
    return simulate(default_plan(9, 96, oversampling=1, brightness=4.0), TRUTH, diffraction(), seed=5)


def expected(offset_dn: float = 0.0) -> Transit:
    """A transit without noise, with an offset of every readout."""
    rates = simulated().sky.noise_free
    return changed(simulated().transit, lambda n, frame: rates[n] + offset_dn / frame.exposure_s)


@cache
def observed(offset_dn: float) -> IdealObserver:
    return ideal_observer(expected(offset_dn), expected(), FEW)


def left_of(found: tuple[Left, ...], *names: str) -> Left:
    return next(one for one in found if set(one.effects) == set(names))


def test_the_true_effect_leaves_nothing_and_its_rival_much() -> None:
    once, twice, nothing = observed(2.0), observed(4.0), observed(0.0)
    assert once.noncentrality > 10
    assert left_of(once.left, "dark_offset").chi2 < 0.02 * once.noncentrality
    assert left_of(once.left, "column_smear").chi2 > 0.1 * once.noncentrality
    assert left_of(once.left, "dark_offset", "column_smear").chi2 <= left_of(once.left, "dark_offset").chi2
    # The noncentrality grows with the square of the strength.
    assert twice.noncentrality == pytest.approx(4 * once.noncentrality, rel=0.15)
    assert twice.left_after_refit_pct == pytest.approx(2 * once.left_after_refit_pct, rel=0.15)
    # Without an effect nothing is left, and the sampling leaves little.
    assert (nothing.noncentrality, nothing.left_after_refit_pct) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert nothing.sampling_chi2 < 1
    # The report holds every hypothesis once.
    told = once.to_json()
    assert told["schema"] == "gap-ideal/1"
    assert told["noncentrality"] == told["hypotheses"][0]["chi2"]
    names = [tuple(one["effects"]) for one in told["hypotheses"]]
    assert len(set(names)) == len(names) == 4


def test_every_hypothesis_leaves_what_dense_least_squares_leave(evidence: Evidence) -> None:
    model = with_residuals(evidence, {"dark_offset": 0.3}, noise=1.0)
    jacobian, residual = dense(model)
    base, (column,) = list(evidence.base), evidence.columns["dark_offset"]
    prior = np.zeros((1, len(base) + 1))
    prior[0, -1] = 1 / (UNLIKELY * effect_of(evidence, "dark_offset").parameters[0].likely)
    designs = {(): jacobian[:, base], ("dark_offset",): np.vstack([jacobian[:, [*base, column]], prior])}
    for names, design in designs.items():
        data = np.append(residual, np.zeros(len(names)))
        rest = data - design @ np.linalg.lstsq(design, data, rcond=None)[0]
        assert left_of(left_by_hypotheses(model), *names).chi2 == pytest.approx(float(rest @ rest), rel=1e-6)


def test_a_negative_share_of_light_is_no_rival(evidence: Evidence) -> None:
    smear = evidence.columns["column_smear"]
    model = with_residuals(evidence, {"column_smear": -0.01})
    left = left_by_hypotheses(model)
    assert left_of(left).chi2 > 1
    assert model.fit(smear).values[-len(smear)] < 0
    assert left_of(left, "column_smear").chi2 > 0.5 * left_of(left).chi2
