"""The content of each case of a blind set, drawn at random from the seed of the set and the number of the case.

The same seed and number always give the same case. An effect is known if the gap library contains it; the others are
withheld. A set takes its withheld effects from one of two groups: those of the calibration or those of tests. Of 24
consecutive cases

- 6 are clean: they have no effect;
- 8 have one known effect; every known effect occurs once before any occurs again;
- 3 have two known effects. The first has two effects that are drawn at random; the second has a strong effect and a
  changing Sun (`scene_evolution`); the third has two strong effects. The strong effects beside a changing Sun are taken
  in turn;
- 4 have one withheld effect, in turn as well;
- 3 are mixed: they have one known and one withheld effect, each in turn.

The target of an effect is the residual that this effect alone should leave in the discs after a refit of the PSF. It
is drawn log-uniformly from USUAL_PCT, for a strong effect from STRONG_PCT, and for both effects of a mixed case from
MIXED_PCT. In every fourth case with one known effect, this effect is strong. A withheld effect of the tests gets the
three ranges of TEST_PCT in turn. If the largest plausible strength of an effect leaves less than the target, the
effect gets this strength. A changing Sun beside a strong effect has no target, because the discs hardly show the
changes of the Sun. The relative rms of these changes is drawn log-uniformly from SUN_RMS.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from psfcore.blind.effects.effect import TEST, Effect, Plane
from psfcore.blind.effects.fine_optics import FINE, INSTRUMENT, SYNTHETIC, Glass
from psfcore.blind.effects.registry import KNOWN, WITHHELD, effect_named
from psfcore.blind.effects.scene import patches
from psfcore.errors import DataError
from psfcore.noise import Noise
from psfcore.simulate.plan import WEST, Plan, Shot, default_plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.scene import drawn_scene, scene_from_image

Range = tuple[float, float]
CLEAN, SINGLE, PAIR, FOREIGN, MIXED = "clean", "single", "pair", "unknown", "mixed"
DRAW = 4  # raise it when the same seed and number give another case
_BLOCK = (CLEAN,) * 6 + (SINGLE,) * 8 + (PAIR,) * 3 + (FOREIGN,) * 4 + (MIXED,) * 3
USUAL_PCT, STRONG_PCT, MIXED_PCT = (0.5, 10.0), (10.0, 30.0), (3.0, 15.0)
TEST_PCT = ((0.8, 1.25), (2.4, 3.75), (8.0, 12.5))
SUN_RMS = (0.02, 0.3)
_STRONG_SINGLES = 4  # one case in this number of cases with one known effect has a strong effect
_SUN = "scene_evolution"
_BESIDE_SUN = tuple(name for name in KNOWN if name != _SUN)
# Effects that leave less than MIXED_PCT in the discs at their largest plausible strength.
_HARDLY_IN_DISCS = (_SUN, "occulter_motion", "gain_mismatch", "core_blur", "mesh_pitch")
_IN_DISCS = tuple(name for name in KNOWN if name not in _HARDLY_IN_DISCS)
_BUILT_SHARE = 0.5  # fraction of cases with the diffraction PSF of the instrument
_SATURATING_SHARE = 0.25  # fraction of cases with a saturation level
_KIND_STREAM, _TRUTH_STREAM, _EFFECT_STREAM = 1, 2, 3


@dataclass(frozen=True)
class SetPlan:
    """The plan of a set.

    Attributes
    ----------
    cases
        Number of cases.
    size_px, images
        Edge length and number of the images of each transit.
    only
        Names of effects; every case has one of them, in turn.
    clean_only
        Whether all cases are without effects.
    built_diffraction
        True: half of the cases have the diffraction PSF of the instrument, and half a synthetic one. False: all have a
        synthetic one.
    left_pct
        The residuals (percent) that an effect should leave in the discs after a refit. The values are used in turn,
        each for all names of `only`. Empty: the residuals are drawn at random; for the names of `only` from USUAL_PCT.
    withheld
        The group of withheld effects, a key of WITHHELD.
    """

    cases: int
    seed: int
    size_px: int = 256
    images: int = 18
    only: tuple[str, ...] = ()
    clean_only: bool = False
    built_diffraction: bool = True
    left_pct: tuple[float, ...] = ()
    withheld: str = TEST


@dataclass(frozen=True)
class Case:
    """One case before it is made.

    Attributes
    ----------
    kind
        CLEAN, SINGLE, PAIR, FOREIGN or MIXED.
    law, glass
        The true scatter and the known part of the PSF.
    effects
        The effects, at their nominal strengths.
    target_pct
        The residual that each effect alone should leave in the discs after a refit, percent; None: the strength of the
        effect is already set.
    headroom
        The saturation level divided by the value of the brightest pixel; None: no pixel saturates.
    """

    number: int
    seed: int
    kind: str
    plan: Plan
    law: ScatterTruth
    glass: Glass
    effects: tuple[Effect, ...]
    target_pct: tuple[float | None, ...]
    headroom: float | None


def draw_case(of: SetPlan, number: int) -> Case:
    """Case `number` (from 0) of a set. Raises DataError "unknown-effect", "bad-plan"."""
    kind, content = _content(of, number)
    rng = np.random.default_rng([of.seed, number, _TRUTH_STREAM])
    plan = _plan(of.size_px, of.images, rng)
    law = ScatterTruth(rng.uniform(3, 9), rng.uniform(2.3, 2.8), rng.uniform(0.25, 0.5))
    glass = Glass(
        INSTRUMENT if of.built_diffraction and rng.random() < _BUILT_SHARE else SYNTHETIC,
        of.size_px,
        core_px=float(rng.uniform(0.08, 0.2)),
        wing_px=float(rng.uniform(1.0, 3.0)),
        wing_share=float(rng.uniform(0.05, 0.15)),
        arm_share=float(rng.uniform(0.05, 0.2)),
        pitch_px=float(rng.uniform(5.0, 6.5)),
    )
    headroom = float(rng.uniform(1.2, 2.0)) if rng.random() < _SATURATING_SHARE else None
    own = np.random.default_rng([of.seed, number, _EFFECT_STREAM])
    turn = number // max(len(of.only), 1)
    given = of.left_pct[turn % len(of.left_pct)] if of.left_pct else None
    effects, targets = list[Effect](), list[float | None]()
    for name, ends in content:
        effect, value = effect_named(name).drawn(plan, own), float(np.exp(own.uniform(*np.log(ends))))
        effects.append(effect.at(value) if ends == SUN_RMS else effect)
        targets.append(None if ends == SUN_RMS else given or value)
    own_seed = int(own.integers(2**31))
    return Case(number, own_seed, kind, plan, law, glass, tuple(effects), tuple(targets), headroom)


def _content(of: SetPlan, number: int) -> tuple[str, list[tuple[str, Range]]]:
    """The kind of a case, and for each effect its name and the range (percent) from which its target is drawn.

    SUN_RMS is not a range of targets: it is a range of strengths.
    """
    if of.clean_only:
        return CLEAN, []
    if of.only:
        name = of.only[number % len(of.only)]
        effect_named(name)
        return (SINGLE if name in KNOWN else FOREIGN), [(name, USUAL_PCT)]
    block, place = divmod(number, len(_BLOCK))
    order = np.random.default_rng([of.seed, block, _KIND_STREAM]).permutation(len(_BLOCK))
    *before, kind = [_BLOCK[n] for n in order[: place + 1]]
    count = block * _BLOCK.count(kind) + before.count(kind)  # number of earlier cases of this kind
    withheld = WITHHELD[of.withheld]
    if kind == SINGLE:
        strong = count % _STRONG_SINGLES == _STRONG_SINGLES - 1
        return kind, [(_in_turn(of.seed, count, KNOWN, 0), STRONG_PCT if strong else USUAL_PCT)]
    if kind == FOREIGN:
        name = _in_turn(of.seed, count, withheld, 1)
        step = withheld.index(name) + count // len(withheld)
        return kind, [(name, TEST_PCT[step % len(TEST_PCT)] if of.withheld == TEST else USUAL_PCT)]
    if kind == MIXED:
        groups = ((_IN_DISCS, 3), (withheld, 4))
        return kind, [(_in_turn(of.seed, count, names, stream), MIXED_PCT) for names, stream in groups]
    return kind, _pair(of.seed, count) if kind == PAIR else []


def _pair(seed: int, count: int) -> list[tuple[str, Range]]:
    """The two effects of a pair, as in the result of `_content`.

    Parameters
    ----------
    count
        The number of pairs in the earlier cases.
    """
    turn, place = divmod(count, 3)
    if place == 1:
        return [(_in_turn(seed, turn, _BESIDE_SUN, 2), STRONG_PCT), (_SUN, SUN_RMS)]
    rng = np.random.default_rng([seed, count, _KIND_STREAM, 2])
    # place 0: any two known effects. place 2: two strong effects, but not the changing Sun, because even its largest
    # plausible change leaves little in the discs.
    names = _BESIDE_SUN if place else KNOWN
    first, second = rng.choice(len(names), size=2, replace=False)
    return [(names[n], STRONG_PCT if place else USUAL_PCT) for n in (first, second)]


def _in_turn(seed: int, count: int, names: Sequence[str], stream: int) -> str:
    """Entry `count` of an endless list of the names. The order is random, but every name occurs once before any is
    repeated.
    """
    turn, place = divmod(count, len(names))
    order = np.random.default_rng([seed, turn, _KIND_STREAM, 3 + stream]).permutation(len(names))
    return str(names[order[place]])


def _plan(size_px: int, images: int, rng: np.random.Generator) -> Plan:
    """The default transit with random changes: it may be upside down, and tracks, brightness and noise are
    different.
    """
    plan = default_plan(
        images,
        size_px,
        radius_px=float(rng.uniform(10.3, 11.2)),
        brightness=float(np.exp(rng.uniform(np.log(0.5), np.log(1.5)))),
        noise=Noise(float(rng.uniform(4.5, 7.5)), float(rng.uniform(1.5, 3.0))),
        ephemeris_error_px=float(rng.uniform(0.3, 0.7)),
        oversampling=FINE,
    )
    upside_down = bool(rng.random() < 0.5)
    moves = rng.uniform(-0.06, 0.06, (len(plan.views), 2)) * size_px
    low = plan.radius_px + 6

    def moved(shot: Shot) -> Shot:
        at = np.array((shot.x_px, shot.y_px)) + moves[shot.pointing - 1]
        x, y = np.clip(at, low, size_px - 1 - low).tolist()
        return dataclasses.replace(shot, x_px=x, y_px=size_px - 1 - y if upside_down else y)

    return dataclasses.replace(plan, shots=tuple(map(moved, plan.shots)))


def case_scenes(case: Case, images: Sequence[Plane] = ()) -> dict[int, Plane]:
    """Fine scenes [y, x], DN/s, by pointing: cut from images, or synthetic with random statistics if there are no
    images.

    Raises DataError "bad-scene".

    Parameters
    ----------
    images
        Images [y, x] in DN/s, used in turn. A single image is mirrored for the west limb.
    """
    scenes = {}
    for pointing in case.plan.pointings:
        if images:
            given = images[(case.number + pointing - 1) % len(images)]
            mirrored = len(images) == 1 and case.plan.views[pointing - 1] == WEST
            scene = scene_from_image(given[:, ::-1] if mirrored else given, case.plan)
            scene = np.asarray(gaussian_filter(scene, 0.5 * FINE))  # it is cut from an image with noise
        else:
            scene = _with_own_statistics(drawn_scene(case.plan, pointing, case.seed), case, pointing)
        if scene.max() <= 0:
            raise DataError(
                "bad-scene",
                f"expected light in the scene of pointing {pointing}; all pixels of this scene are 0: "
                "choose another image",
            )
        scenes[pointing] = scene
    return scenes


def _with_own_statistics(scene: Plane, case: Case, pointing: int) -> Plane:
    """Add to a synthetic scene: broad and fine modulation, compact brightenings with power-law brightness, and a
    constant.
    """
    rng = np.random.default_rng([case.seed, pointing, 4])
    n, seed = scene.shape[0], int(rng.integers(2**31))
    broad, fine = patches(n, seed, float(rng.uniform(0.1, 0.4))), patches(n, seed + 1, 0.015)
    lit = scene * np.exp(rng.uniform(0.1, 0.5) * broad + rng.uniform(0.0, 0.35) * fine)
    points, count = np.zeros_like(lit), int(rng.integers(5, 60))
    rows, columns = rng.integers(0, n, (2, count))
    light = rng.pareto(1.7, count) * rng.uniform(0.3, 1.5) * lit[rows, columns]
    np.add.at(points, (rows, columns), np.minimum(light, 40 * lit.mean()))
    width = rng.uniform(0.8, 2.0) * FINE
    lit += 2 * np.pi * width**2 * gaussian_filter(points, width)
    return np.asarray(lit + rng.uniform(0, 3))
