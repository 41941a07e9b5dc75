"""The effects of the blind set: none at strength 0, visible at the nominal strength, and physically consistent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from psfcore.blind.chain import Chain, EffectFree
from psfcore.blind.effects.effect import Earlier, Effect, Moment, apply_effects
from psfcore.blind.effects.fine_optics import (
    FINE,
    SYNTHETIC,
    FineOptics,
    Glass,
    binned_glass,
    binned_kernel,
    fine_optics,
)
from psfcore.blind.effects.registry import EFFECTS, KNOWN, UNKNOWN, WITHHELD, effect_named
from psfcore.blind.leftover import LinearEstimator
from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
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
def clean(effect_free: EffectFree) -> list[np.ndarray]:
    return Chain(effect_free, ()).all_expected()


def test_the_effects_of_the_library_and_two_groups_of_others(plan: Plan) -> None:
    assert set(KNOWN) == {effect.name for effect in LIBRARY}
    assert set(WITHHELD) == {"calibration", "test"} and all(len(names) >= 8 for names in WITHHELD.values())
    assert sorted([*KNOWN, *UNKNOWN]) == sorted(EFFECTS)
    rng = np.random.default_rng(1)
    stages = {EFFECTS[name].drawn(plan, rng).as_json()["stage"] for name in WITHHELD["test"]}
    assert stages == {"scene", "optics", "detector"}
    assert all(effect.unit and effect.change.__doc__ for effect in EFFECTS.values())
    with pytest.raises(DataError, match="unknown-effect"):
        effect_named("gremlins")


def test_an_effect_changes_images_unless_its_strength_is_0(
    plan: Plan, effect_free: EffectFree, clean: list[np.ndarray]
) -> None:
    dn = Chain(effect_free, ()).read_out(clean, 5)
    for name, kind in EFFECTS.items():
        effect = kind.drawn(plan, np.random.default_rng(8))
        still, changed = Chain(effect_free, (effect.at(0.0),)), Chain(effect_free, (effect,))
        np.testing.assert_allclose(still.all_expected(), clean, rtol=1e-6, atol=1e-6, err_msg=name)
        np.testing.assert_array_equal(still.read_out(clean, 5), dn, err_msg=name)
        moved = np.array(changed.mean_rate(changed.all_expected(), 5))
        assert np.isfinite(moved).all(), name
        assert np.abs(moved / np.array(clean) - 1).max() > 1e-3, name
    exposures = [rate * shot.exposure_s for rate, shot in zip(clean, plan.shots, strict=True)]
    level = Chain(effect_free, [effect_of("saturation_fill", 0.03)]).saturation_dn(clean)
    assert level is not None
    high = np.concatenate(
        [dn.ravel() for dn, shot in zip(exposures, plan.shots, strict=True) if shot.gain_mode == HIGH]
    )
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
    plan: Plan, optics: FineOptics, clean: list[np.ndarray]
) -> None:
    for name in ("anisotropic_scatter", "one_sided_scatter", "core_blur", "focus_drift"):
        effect = EFFECTS[name].drawn(plan, np.random.default_rng(2))
        after = apply_effects([effect], "optics", optics, Moment(plan, len(plan.shots) - 1))
        assert after.scatter.sum() == pytest.approx(optics.scatter.sum(), abs=2e-3), name
        assert after.diffraction.sum() == pytest.approx(1.0, abs=3e-3), name
    spread = apply_effects([effect_of("brighter_fatter", 0.05)], "expected", clean[2], Moment(plan, 2))
    assert spread.sum() == pytest.approx(clean[2].sum(), rel=1e-12)
    assert spread.std() < clean[2].std()


def test_effects_change_light_where_and_as_they_say(
    plan: Plan, optics: FineOptics, effect_free: EffectFree, clean: list[np.ndarray]
) -> None:
    effect = effect_of("field_dependent_scatter", 0.5, angle_deg=0.0, bowl=0.5)
    lit = np.zeros(optics.field)
    lit[SIZE_PX, 2 * SIZE_PX - 40] = 1.0  # a point away from the centre along +x: more scatter
    added = apply_effects([effect], "spread", np.zeros_like(lit), lit, optics, Moment(plan, 0))
    assert added[SIZE_PX, 2 * SIZE_PX - 40] < 0
    assert added[SIZE_PX + 21, SIZE_PX] > 0  # off the mesh's orders, which follow the core
    effect = effect_of("occulter_motion", 1.0, angle_deg=0.0)
    shot = plan.shots[0]
    moved = Chain(effect_free, (effect,)).expected(0) - clean[0]
    row, column, radius = round(shot.y_px), round(shot.x_px), int(plan.radius_px)
    ends = moved[row, [column - radius + 1, column + radius - 1]]
    sides = moved[[row - radius + 2, row + radius - 2], column]
    assert ends.min() > 5 * np.abs(sides).max()
    tail = effect_of("occulter_tail", 10.0, angle_deg=0.0, length=2.0, fading=1.0)
    chain, last = Chain(effect_free, [tail]), len(plan.shots) - 1
    added = [chain.expected(index) - clean[index] for index in (0, last)]
    for index, light in zip((0, last), added, strict=True):
        row, column = np.unravel_index(light.argmax(), light.shape)
        assert np.hypot(row - plan.shots[index].y_px, column - plan.shots[index].x_px) < 3
    assert added[1].max() == pytest.approx(added[0].max() / 2, rel=0.1)


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


def test_every_effect_of_the_tests_leaves_a_residual_in_the_discs(
    plan: Plan, effect_free: EffectFree, clean: list[np.ndarray]
) -> None:
    frames = [
        Frame(f"{n}.fits", rate.astype("f4"), shot.pointing, plan.place(n), shot.exposure_s, shot.time_s)
        for n, (rate, shot) in enumerate(zip(clean, plan.shots, strict=True))
    ]
    estimator = LinearEstimator(frames, binned_glass(GLASS), LAW, plan.noise)
    for name in WITHHELD["test"]:
        effect = EFFECTS[name].drawn(plan, np.random.default_rng(4))
        left_pct = []
        for strength in (effect.strength, effect.kind.largest):
            chain = Chain(effect_free, [effect.at(strength)])
            left_pct.append(estimator.left(chain.mean_rate(chain.all_expected(), 5)).after_refit_pct)
        assert 0.1 < left_pct[0] < left_pct[1] and left_pct[1] > 3, (name, left_pct)
