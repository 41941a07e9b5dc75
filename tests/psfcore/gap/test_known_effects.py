"""Diagnoses with the whole library of small transits with one effect: each is named, with its size. All are slow."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.blind.effects.scene import patches
from psfcore.gap.diagnose import Diagnosis, diagnose
from psfcore.gap.report.report import gap_report
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import Frame, Transit
from tests.psfcore.gap.small_gaps import changed
from tests.transit_files import TRUTH, diffraction

pytestmark = pytest.mark.slow  # test_diagnose.py and gap/library run the same paths


@pytest.fixture(scope="module")
def clean() -> Transit:
    """Twelve images of 160 px with some tens of photons per pixel in the discs."""
    plan = default_plan(12, 160, oversampling=1, brightness=4.0)
    return simulate(plan, TRUTH, diffraction(), seed=8).transit


def verdict(transit: Transit) -> Diagnosis:
    """The diagnosis by the linear model alone."""
    return diagnose(transit, refit=False)


def fitted(found: Diagnosis, name: str) -> dict[str, tuple[float, float, str]]:
    return found.fits[name].values


def test_a_gain_mismatch_shows_in_the_unocculted_field_and_hardly_in_the_discs(clean: Transit) -> None:
    found = verdict(changed(clean, lambda n, f: f.pixels * (1.08 if f.gain_mode == "combined" else 1.0)))
    assert found.answer.named == ("gain_mismatch",)
    value, sigma, _ = fitted(found, "gain_mismatch")["excess"]
    assert value == pytest.approx(0.08, abs=max(5 * sigma, 0.02))
    assert found.rms.value < 3.0  # percent: the discs hardly show it
    assert found.where[0].name in ("gain_mode", "exposure")


def test_persistence_whatever_its_decay_time(clean: Transit) -> None:
    frames = clean.frames
    fades_s = 1.6 * (frames[-1].time_s - frames[0].time_s) / (len(frames) - 1)

    def remembered(n: int, f: Frame) -> np.ndarray:
        left = sum(
            np.exp((earlier.time_s - f.time_s) / fades_s) * earlier.pixels * earlier.exposure_s / f.exposure_s
            for earlier in frames[:n]
        )
        return np.asarray(f.pixels + 0.06 * left, dtype=np.float32)

    found = verdict(changed(clean, remembered))
    assert found.answer.named == ("persistence",)
    values = fitted(found, "persistence").values()
    assert sum(value for value, _, _ in values) == pytest.approx(0.06, rel=0.3)
    closure = found.shrinking["persistence"].closure
    assert closure is not None and closure.value > 0.9


def test_a_patchy_flat_field_error(clean: Transit) -> None:
    uneven = 1 + 0.15 * patches(clean.shape[0], seed=3, patch=0.2)
    found = diagnose(changed(clean, lambda n, f: f.pixels * uneven))
    (first, *_) = found.answer.causes
    assert first.effects == ("flat_field_residual",)
    closure = found.shrinking["flat_field_residual"].closure
    assert closure is not None and closure.value > 0.3
    # Parameters that the discs do not constrain stay near 0, so together they are no larger than the patches.
    values = fitted(found, "flat_field_residual")
    assert np.linalg.norm([value for value, _, _ in values.values()]) < 0.2


def test_a_sun_that_changes_faster_than_the_images_follow_is_still_named() -> None:
    plan = default_plan(18, 128, oversampling=1, brightness=4.0)
    one, other = (patches(128, seed=seed, patch=0.1) for seed in (3, 4))

    def flickering(n: int, f: Frame) -> np.ndarray:
        return np.asarray(f.pixels * np.exp(0.3 * (one * np.sin(0.9 * n) + other * np.cos(0.9 * n))))

    found = verdict(changed(simulate(plan, TRUTH, diffraction(), seed=8).transit, flickering))
    # The effect does not change the discs. In so strong a change, however, the places of some occulters are wrong,
    # and the discs show a gap. A second effect is named for this gap.
    assert any("The fitted position of the occulter may be wrong" in caution for caution in found.cautions)
    assert "scene_evolution" in found.answer.causes[0].effects


def test_a_patch_of_light_is_not_attributed_to_an_effect(clean: Transit) -> None:
    ny, nx = clean.shape
    glow = 40 * np.exp(-0.5 * ((np.arange(nx) - 60) / 14) ** 2) * np.ones((ny, 1))
    found = verdict(changed(clean, lambda n, f: f.pixels + glow))
    (cause,) = gap_report(found)["causes"]
    assert cause["alternatives"][0]["family"] == "light_place" and cause["field"] is not None


def test_brightness_that_varies_between_images_is_not_a_gap(clean: Transit) -> None:
    waver = 1 + 0.01 * np.random.default_rng(3).standard_normal(len(clean.frames))
    found = verdict(changed(clean, lambda n, f: f.pixels * waver[n]))
    assert next(iter(found.answer.hypotheses)) == frozenset() and found.answer.causes == ()
    assert found.p_value > 1e-3
