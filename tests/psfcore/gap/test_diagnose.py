"""The diagnosis of small simulated transits: clean data show no gap, and a simulated effect is found.

The diagnosis of clean images uses the whole library; others use fewer effects. `test_known_effects.py` has slow ones.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.gap.diagnose import Diagnosis, caution_of_closure, diagnose
from psfcore.gap.evidence.measured_noise import measured_noise
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.report.report import gap_report
from psfcore.gap.verdict import axes
from psfcore.gap.verdict.calibration import Calibration
from psfcore.gap.verdict.limits import limits
from psfcore.noise import Noise
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import Transit
from tests.psfcore.gap import small_gaps
from tests.psfcore.gap.small_gaps import changed
from tests.transit_files import TRUTH, diffraction

# Without those that search for a position or a form.
FEW = tuple(effect for effect in small_gaps.FEW if effect.held is None)


@pytest.fixture(autouse=True)
def fewer_sign_flips(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(axes, "SIGN_FLIPS", 99)


@pytest.fixture(scope="module")
def clean() -> Transit:
    """Twelve images of 96 px, bright enough that the noise is measured well."""
    plan = default_plan(12, 96, oversampling=1, brightness=8.0)
    return simulate(plan, TRUTH, diffraction(), seed=3).transit


def check_no_gap(found: Diagnosis) -> None:
    """No cause is the most probable hypothesis, and none is told."""
    assert next(iter(found.answer.hypotheses)) == frozenset() and found.answer.causes == ()
    assert found.told is None and found.corrected is None and found.p_value > 1e-3


def test_clean_images_have_no_gap_and_the_report_is_json(clean: Transit) -> None:
    found = diagnose(clean, solution=small_gaps.fit(clean))
    check_no_gap(found)
    assert found.answer.verdict == "none" and found.answer.closed.misfit[0] < 1.5
    report = json.loads(json.dumps(gap_report(found), allow_nan=False))
    assert report["schema"] == "gap/3" and "no gap" in report["lines"][0]
    names = {effect["name"] for effect in report["effects"]} | {e["name"] for e in report["untestable"]}
    assert names == {effect.name for effect in LIBRARY}
    assert all(effect["closure"] is None for effect in report["effects"])
    assert sum(axis["share"] for axis in report["where"]) == pytest.approx(1.0, abs=0.05)


def test_a_read_pattern_is_not_attributed_to_an_effect(clean: Transit) -> None:
    stripes = 20 * np.sin(2 * np.pi * np.arange(clean.shape[1]) / 45) * np.ones((clean.shape[0], 1))
    found = diagnose(changed(clean, lambda n, f: f.pixels + stripes / f.exposure_s), library=FEW, refit=False)
    assert all(one.effect is None for cause in found.answer.causes for one in cause.alternatives)
    assert found.answer.verdict == "unknown" and found.corrected is None and found.shapes


def test_a_dark_offset_is_found_with_its_size_and_taken_out() -> None:
    full = small_gaps.found()
    assert full.answer.verdict == "attributed" and full.answer.named == ("dark_offset",)
    fit = full.corrected
    assert fit is not None and full.told is not None and full.told.names == ("dark_offset",)
    value, sigma, unit = fit.values["offset"]
    assert unit == "DN" and value == pytest.approx(small_gaps.OFFSET_DN, abs=4 * sigma) and sigma < 0.5
    shrinking = full.shrinking_of_told
    assert (
        shrinking is not None
        and shrinking.closure_by_pointing is not None
        and shrinking.closure_by_pointing.low > 0.7
    )
    assert shrinking.held_out_fall is not None and shrinking.held_out_fall > 10
    assert full.after.value < min(1.0, full.rms.value / 2)
    # A wrong dark level biases the fit of the PSF; with the effect in the model the bias is gone.
    bent, straight = (s.inversion.values["total"] for s in (full.solution, fit.solution))
    assert abs(straight - TRUTH.total) < abs(bent - TRUTH.total) - 0.005
    # The limit of the offset is that of the full refit, and above the truth; the strength that would be found stays.
    linear = limits(full.answer.closed)
    (limit,), (before,) = (one.effects["dark_offset"].parameters for one in (full.limits, linear))
    assert before.found_90 == limit.found_90 and before.excluded_95 != limit.excluded_95
    assert limit.excluded_95 == pytest.approx(value + 1.645 * sigma, rel=1e-3)
    assert limit.excluded_95 is not None and 0 < limit.excluded_95 - small_gaps.OFFSET_DN < 1.0
    assert full.p_value < 1e-10


def test_light_lost_by_clipping_is_attributed_to_saturation_fill(clean: Transit) -> None:
    """One pointing's images are clipped around a place, so no image shows the true scene there."""
    y, x = np.indices(clean.shape)
    inside = 24 - np.hypot(y - 48, x - 64)
    lost = np.sqrt(np.maximum(inside, 0)) / 7
    frames = tuple(
        replace(f, pixels=(f.pixels * (1 - lost)).astype(np.float32), filled=inside > 0)
        if f.pointing == 2
        else f
        for f in clean.frames
    )
    found = diagnose(replace(clean, frames=frames), library=FEW, refit=False)
    assert found.answer.named == ("saturation_fill",) and found.corrected is None
    fit = found.fits["saturation_fill"]
    # The loss is larger inside than at the rim, as simulated.
    value, sigma, _ = fit.values["excess_inside"]
    assert value < -2 * sigma


def test_wrong_noise_figures_are_noticed_and_are_not_a_gap(clean: Transit) -> None:
    """The answer has the level of the coverage that was asked for, by the calibration of 39 cases."""
    wrong = replace(clean, noise=Noise(clean.noise.photon_gain_dn * 2.0, clean.noise.read_noise_dn * 2.0))
    calibration = Calibration((0.97,) * 39, {})
    found = diagnose(wrong, library=FEW, refit=False, coverage=0.95, calibration=calibration)
    check_no_gap(found)
    assert any("times the stated variance" in caution for caution in found.cautions)
    assert found.answer.level == 0.97 and found.calibration is calibration
    for library, coverage, code in ((FEW, 0.98, "bad-coverage"), ((), 0.95, "bad-library")):
        with pytest.raises(DataError, match=code):
            diagnose(clean, library=library, coverage=coverage, calibration=calibration)
    # The noise of the images is measured.
    noise = measured_noise(clean)
    assert noise is not None and noise.agrees
    # Not 10 %: for pixels with a few photons the median deviation is smaller than a normal distribution's by that much.
    assert noise.noise.photon_gain_dn == pytest.approx(clean.noise.photon_gain_dn, rel=0.2)
    first, second = clean.frames[:2]
    assert measured_noise(replace(clean, frames=(first, replace(second, pointing=2)))) is None


def test_cautions_tell_what_one_pointing_and_few_images_cannot_show(clean: Transit) -> None:
    one = replace(clean, frames=tuple(f for f in clean.frames if f.pointing == 2))
    found = diagnose(one, library=FEW, refit=False)
    assert found.answer.verdict == "inconclusive"  # four images: a gap may exist
    check_no_gap(found)
    for said in ("the same pointing", "the same exposure time"):
        assert any(said in caution for caution in found.cautions), said
    assert {"gain_mismatch", "saturation_fill"} <= {e["name"] for e in gap_report(found)["untestable"]}
    few = diagnose(replace(clean, frames=(one.frames[0], *one.frames[2:])), library=FEW, refit=False)
    assert few.answer.verdict == "inconclusive"
    assert any("held out" in caution for caution in few.cautions)
    with pytest.raises(DataError, match="too-few-frames"):
        diagnose(replace(clean, frames=one.frames[:2]), library=FEW)
    # So does a closure whose prediction is less exact than the gap.
    (caution,) = caution_of_closure("ghost", gap_pct=6.4, error_pct=6.8)
    assert "closure by ghost" in caution and "6.8 %" in caution and "6.4 %" in caution
    assert caution_of_closure("ghost", gap_pct=6.4, error_pct=2.0) == ()
