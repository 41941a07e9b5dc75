"""The effects of the blind set: none at strength 0, visible at the nominal strength, and physically consistent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from psfcore.blind.effects.effect import STAGES, Earlier, Effect, Moment, apply_effects
from psfcore.blind.effects.fine_optics import (
    FINE,
    SYNTHETIC,
    FineOptics,
    Glass,
    binned_glass,
    binned_kernel,
    fine_optics,
)
from psfcore.blind.effects.registry import EFFECTS, KNOWN, WITHHELD, effect_named
from psfcore.blind.residuals import LinearEstimator
from psfcore.blind.simulation import EffectFree, Simulation
from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.gap.evidence.tree import FAMILIES
from psfcore.gap.library.registry import LIBRARY
from psfcore.simulate.plan import COMBINED, HIGH, Plan, default_plan
from psfcore.simulate.scatter_truth import ScatterTruth, anisotropic_kernel
from psfcore.simulate.scene import drawn_scene
from psfcore.simulate.sky import binned
from psfcore.transit.transit import Frame

LAW = ScatterTruth(5.0, 2.5, 0.4)
GLASS = Glass(SYNTHETIC, 64)
SIZE_PX = 96


def effect_of(name: str, strength: float, **parameters: Any) -> Effect:
    return Effect(EFFECTS[name], strength, parameters)


@pytest.fixture(scope="module")
def plan() -> Plan:
    return default_plan(6, SIZE_PX, oversampling=FINE)


@pytest.fixture(scope="module")
def optics() -> FineOptics:
    return fine_optics(LAW, GLASS, SIZE_PX)


@pytest.fixture(scope="module")
def effect_free(plan: Plan, optics: FineOptics) -> EffectFree:
    return EffectFree(plan, optics, {pointing: drawn_scene(plan, pointing, 3) for pointing in plan.pointings})


@pytest.fixture(scope="module")
def clean(effect_free: EffectFree) -> Simulation:
    return Simulation(effect_free, (), 5)


def test_the_effects_of_the_library_and_two_groups_of_others_with_the_families_of_the_diagnosis(
    plan: Plan,
) -> None:
    assert set(KNOWN) == {effect.name for effect in LIBRARY}
    assert all(len(names) >= 8 for names in WITHHELD.values())
    assert sorted([*KNOWN, *WITHHELD["calibration"], *WITHHELD["test"]]) == sorted(EFFECTS)
    stages = {name: family.stage for name, family in FAMILIES.items() if not name.startswith("other_")}
    assert stages == STAGES
    truths = {name: kind.drawn(plan, np.random.default_rng(1)).as_json() for name, kind in EFFECTS.items()}
    assert {truths[name]["stage"] for name in WITHHELD["test"]} == {"scene", "optics", "detector"}
    assert {name for name, truth in truths.items() if truth["cause"] == name} == set(KNOWN)
    assert (truths["dust_shadow"]["cause"], truths["glow"]["cause"]) == ("flat_field_residual", None)
    for name, kind in EFFECTS.items():
        assert kind.unit and kind.change.__doc__ and set(kind.families) <= set(STAGES), name
        assert {kind.form_of, *kind.also} <= {None, *KNOWN}, name
    with pytest.raises(DataError, match="unknown-effect"):
        effect_named("gremlins")


def test_an_effect_changes_images_unless_its_strength_is_0(plan: Plan, clean: Simulation) -> None:
    dn = clean.read_out()
    for name, kind in EFFECTS.items():
        effect = kind.drawn(plan, np.random.default_rng(8))
        still, changed = clean.with_effects(effect.at(0.0)), clean.with_effects(effect)
        np.testing.assert_allclose(still.rates, clean.rates, rtol=1e-6, atol=1e-6, err_msg=name)
        np.testing.assert_array_equal(still.read_out(), dn, err_msg=name)
        assert np.isfinite(changed.mean).all(), name
        assert np.abs(np.array(changed.mean) / np.array(clean.rates) - 1).max() > 1e-3, name
    filled = clean.with_effects(EFFECTS["saturation_fill"].drawn(plan, np.random.default_rng(8)).at(0.03))
    exposures, level = zip(filled.rates, plan.shots, strict=True), filled.level
    assert level is not None
    high = np.array([rate * shot.exposure_s for rate, shot in exposures if shot.gain_mode == HIGH])
    assert np.maximum(high - level, 0).sum() / high.sum() == pytest.approx(0.03, abs=0.002)


def test_kernels_follow_the_power_law_sum_to_1_and_rotate(optics: FineOptics) -> None:
    boxed, law = binned_kernel(optics.scatter), anisotropic_kernel(LAW, 2 * SIZE_PX)
    middle = SIZE_PX
    assert boxed[middle, middle] == pytest.approx(1 - LAW.total, abs=1e-9)
    near = (slice(middle - 20, middle + 21), slice(middle + 1, middle + 21))
    np.testing.assert_allclose(boxed[near], law[near], rtol=0.02)
    kernel = binned_glass(GLASS)
    assert kernel.sum() == pytest.approx(1.0, abs=1e-12)
    assert np.unravel_index(kernel.argmax(), kernel.shape) == (32, 32)
    straight, turned = GLASS.fine(), GLASS.fine(turn_deg=90.0)
    np.testing.assert_allclose(turned, straight, atol=1e-12)  # a square mesh, a quarter turn
    assert np.abs(GLASS.fine(turn_deg=5.0) - straight).sum() > 0.01


def test_a_scene_uniform_within_pixels_gives_the_same_with_fine_and_binned_kernels() -> None:
    rng = np.random.default_rng(4)
    coarse = rng.random((32, 32))
    fine = np.kron(coarse, np.ones((FINE, FINE)))
    kernel = Glass(SYNTHETIC, 32).fine()
    seen = binned(Convolver(kernel, fine.shape, dtype=np.float64).apply(fine), FINE)
    boxed = Convolver(binned_kernel(kernel), coarse.shape, dtype=np.float64).apply(coarse)
    np.testing.assert_allclose(seen, boxed, atol=2e-4)  # the outermost fine row has no partner


def test_effects_of_the_optics_and_charge_that_repels_conserve_light(
    plan: Plan, optics: FineOptics, clean: Simulation
) -> None:
    for name in ("anisotropic_scatter", "one_sided_scatter", "core_blur", "focus_drift"):
        effect = EFFECTS[name].drawn(plan, np.random.default_rng(2))
        after = apply_effects([effect], "optics", optics, Moment(plan, len(plan.shots) - 1))
        assert after.scatter.sum() == pytest.approx(optics.scatter.sum(), abs=2e-3), name
        assert after.diffraction.sum() == pytest.approx(1.0, abs=3e-3), name
    rate = clean.rates[2]
    spread = apply_effects([effect_of("brighter_fatter", 0.05)], "expected", rate, Moment(plan, 2))
    assert spread.sum() == pytest.approx(rate.sum(), rel=1e-12)
    assert spread.std() < rate.std()


def test_effects_change_light_where_and_as_they_say(
    plan: Plan, optics: FineOptics, clean: Simulation
) -> None:
    effect = effect_of("field_dependent_scatter", 0.5, angle_deg=0.0, bowl=0.5)
    lit = np.zeros(optics.field)
    lit[SIZE_PX, 2 * SIZE_PX - 40] = 1.0  # a point away from the centre along +x: more scatter
    added = apply_effects([effect], "spread", np.zeros_like(lit), lit, optics, Moment(plan, 0))
    assert added[SIZE_PX, 2 * SIZE_PX - 40] < 0
    assert added[SIZE_PX + 21, SIZE_PX] > 0  # off the mesh's orders, which follow the core
    effect = effect_of("occulter_motion", 1.0, angle_deg=0.0)
    shot = plan.shots[0]
    moved = clean.with_effects(effect).rates[0] - clean.rates[0]
    row, column, radius = round(shot.y_px), round(shot.x_px), int(plan.radius_px)
    ends = moved[row, [column - radius + 1, column + radius - 1]]
    sides = moved[[row - radius + 2, row + radius - 2], column]
    assert ends.min() > 5 * np.abs(sides).max()
    tail = effect_of("occulter_tail", 10.0, angle_deg=0.0, length=2.0, fading=1.0)
    rates, last = clean.with_effects(tail).rates, len(plan.shots) - 1
    added = [rates[index] - clean.rates[index] for index in (0, last)]
    for index, light in zip((0, last), added, strict=True):
        row, column = np.unravel_index(light.argmax(), light.shape)
        assert np.hypot(row - plan.shots[index].y_px, column - plan.shots[index].x_px) < 3
    assert added[1].max() == pytest.approx(added[0].max() / 2, rel=0.1)
    # Two effects that switch, and lines finer than 0.05 of the field.
    jolt = clean.with_effects(effect_of("dust_release", 0.2, instant=0.5)).rates
    lamp = clean.with_effects(effect_of("encoder_lamp", 3.0, period=1.0, phase=0.0)).rates
    for index, rate in enumerate(clean.rates):
        late = Moment(plan, index).elapsed >= 0.5
        assert (np.abs(jolt[index] - rate).max() > 0.1) == late
        np.testing.assert_allclose(lamp[index] - rate, 3.0 if not late or index == last else 0.0, atol=1e-9)
    crease = effect_of("foil_creases", 4.0, creases=((0.5, 0.5, 90.0, 0.02),))
    line = (clean.with_effects(crease).rates[0] - clean.rates[0]).mean(axis=0)
    assert line.argmax() in (SIZE_PX // 2 - 1, SIZE_PX // 2) and (line > 1e-3).sum() <= 0.05 * SIZE_PX


def test_effects_of_the_readout_change_dn_as_defined(plan: Plan) -> None:
    """Persistence decays, a gain mismatch changes combined images only, a nonlinearity reduces faint signals only."""
    nothing, earlier = np.zeros((4, 4)), Earlier(np.full((4, 4), 100.0), plan.shots[0].time_s)
    persistence = effect_of("persistence", 0.1, decay=1.5)
    assert np.all(apply_effects([persistence], "read_out", nothing, Moment(plan, 0), []) == 0)
    wait_s = plan.shots[1].time_s - plan.shots[0].time_s
    left = apply_effects([persistence], "read_out", nothing, Moment(plan, 1), [earlier])
    cadence_s = (plan.shots[-1].time_s - plan.shots[0].time_s) / (len(plan.shots) - 1)
    np.testing.assert_allclose(left, 10.0 * np.exp(-wait_s / (1.5 * cadence_s)))
    mismatch, dn = effect_of("gain_mismatch", 0.1, sign=1), np.full((4, 4), 50.0)
    for index, shot in enumerate(plan.shots):
        factor = {COMBINED: 1.1, HIGH: 1.0}[shot.gain_mode]
        after = apply_effects([mismatch], "read_out", dn, Moment(plan, index), [])
        np.testing.assert_allclose(after, factor * dn)
    faint = effect_of("nonlinearity", 0.2, knee_dn=100.0, trap=False)
    dn = np.array([[5.0, 100.0, 1000.0]])
    after = apply_effects([faint], "read_out", dn, Moment(plan, 0), [])
    np.testing.assert_allclose(after, [[4.0, 100.0, 1000.0]])
    trails = effect_of("charge_trails", 0.1, trail_px=5.0)
    for row, lost in ((99, 10.0), (9, 1.0)):
        dn = np.zeros((100, 3))
        dn[row, 1] = 100.0
        after = apply_effects([trails], "read_out", dn, Moment(plan, 0), [])
        assert after[row, 1] == pytest.approx(100 - lost)
        assert (after[:row] == 0).all() and (after[:, [0, 2]] == 0).all()
    assert after.sum() == pytest.approx(100.0, abs=1e-6)  # of row 9, whose trail ends before the last row


def test_every_effect_of_the_tests_leaves_a_residual_in_the_discs(plan: Plan, clean: Simulation) -> None:
    frames = [
        Frame(f"{n}.fits", rate.astype("f4"), shot.pointing, plan.place(n), shot.exposure_s, shot.time_s)
        for n, (rate, shot) in enumerate(zip(clean.rates, plan.shots, strict=True))
    ]
    estimator = LinearEstimator(frames, binned_glass(GLASS), LAW, plan.noise)
    for name in WITHHELD["test"]:
        effect = EFFECTS[name].drawn(plan, np.random.default_rng(4))
        strengths = (effect.strength, effect.kind.largest)
        nominal, largest = (estimator.left_pct(clean.with_effects(effect.at(one)).mean) for one in strengths)
        assert 0.1 < nominal < largest and largest > 3, (name, nominal, largest)
