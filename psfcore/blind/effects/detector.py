"""Effects of the detector and of its readout: changes of the light that reaches it, of the charge that its pixels
collect, and of the exposure after its photons were detected.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.ndimage import uniform_filter1d

from psfcore.blind.effects.effect import (
    ADDS_LIGHT,
    ANGLE,
    CALIBRATION,
    DEPENDS_ON_NOISE,
    KNOWN,
    Earlier,
    Effect,
    Moment,
    Plane,
    coin,
    declare,
    direction,
    near_a_disc,
    seed,
    sign,
    unit_coordinates,
)
from psfcore.blind.effects.fine_optics import FINE
from psfcore.blind.effects.scene import patches
from psfcore.simulate.plan import COMBINED, Plan


@declare(
    KNOWN,
    "light",
    ("light_place",),
    "DN/s at its mean",
    0.5,
    20.0,
    ADDS_LIGHT,
    angle_deg=ANGLE,
    curvature=(-0.4, 0.4),
)
def intensity_gradient(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """Sunlight that passes the baffles. It increases towards one side: a plane with a small curvature, 0 in its
    darkest corner.
    """
    along, across = unit_coordinates(seen.shape, effect["angle_deg"])
    plane = along + effect["curvature"] * (along**2 - across**2)
    plane = plane - plane.min()
    return np.asarray(seen + effect.strength * plane / plane.mean())


@declare(
    CALIBRATION,
    "light",
    ("light_place",),
    "DN/s at its peak",
    5.0,
    400.0,
    ADDS_LIGHT,
    at=near_a_disc(0.12),
    scale=(0.06, 0.15),
)
def glow(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """A glow at a fixed position on the detector: an amplifier beside the pixels emits light."""
    r = np.hypot(*unit_coordinates(seen.shape, at=effect["at"])) / effect["scale"]
    return np.asarray(seen + effect.strength / (1 + r**2) ** 2)


def _specks(plan: Plan, rng: np.random.Generator) -> tuple[tuple[float, float, float], ...]:
    near = near_a_disc(3.0 / plan.size_px)
    return tuple((*near(plan, rng), float(rng.uniform(4, 9))) for _ in range(max(1, len(plan.shots) // 5)))


@declare(
    CALIBRATION,
    "light",
    ("gain_place",),
    "share of light blocked",
    0.1,
    0.9,
    {"form_of": "flat_field_residual"},
    specks=_specks,
)
def dust_shadow(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """Dust settled on the detector after the flat field was taken: specks with soft edges near positions of the
    occulter.

    The parameter `specks` lists x, y (fractions of the field) and the radius (px) of each speck.
    """
    passed = np.ones_like(seen)
    for x, y, radius_px in effect["specks"]:
        r_px = np.hypot(*unit_coordinates(seen.shape, at=(x, y))) * seen.shape[0] / FINE
        passed *= 1 - effect.strength / (1 + np.exp(np.minimum((r_px - radius_px) / 0.7, 500.0)))
    return seen * passed


@declare(KNOWN, "expected", ("gain_place",), "share, rms", 0.03, 0.3, seed=seed, patch=(0.05, 0.25))
def flat_field_residual(effect: Effect, rate: Plane, moment: Moment) -> Plane:
    """The flat field was taken long ago: broad patches, whose rms is the strength, and a pixel-to-pixel variation of
    half this rms.
    """
    size = rate.shape[0]
    pattern = patches(size, effect["seed"], effect["patch"]) + 0.5 * _grain(size, effect["seed"])
    return rate * np.maximum(1 + effect.strength * pattern, 0.0)


@cache
def _grain(size: int, seed: int) -> Plane:
    return np.random.default_rng([seed, 1]).standard_normal((size, size))


@declare(CALIBRATION, "expected", ("gain_kind", "gain_place"), "s", 0.05, 0.6, angle_deg=ANGLE)
def shutter_gradient(effect: Effect, rate: Plane, moment: Moment) -> Plane:
    """The shutter moves unevenly: one side of the field is exposed longer. The strength is the difference at the two
    edges, s.
    """
    along, _ = unit_coordinates(rate.shape, effect["angle_deg"])
    return rate * np.maximum(1 + effect.strength * along / moment.shot.exposure_s, 0.0)


@declare(
    CALIBRATION,
    "expected",
    ("light_time", "light_place_time"),
    "DN/s at the end",
    1.0,
    30.0,
    steepness=(0.5, 3.0),
)
def dark_current_drift(effect: Effect, rate: Plane, moment: Moment) -> Plane:
    """The detector warms: a dark current grows during the transit and reaches the strength at its end."""
    steepness = effect["steepness"]
    return np.asarray(rate + effect.strength * np.expm1(steepness * moment.elapsed) / np.expm1(steepness))


@declare(CALIBRATION, "expected", ("response", "core"), "per 1000 DN", 0.02, 0.15)
def brighter_fatter(effect: Effect, rate: Plane, moment: Moment) -> Plane:
    """Collected charge repels new charge into fainter neighbouring pixels.

    The strength is the signal that moves from the brighter to the fainter of two neighbouring pixels, divided by the
    difference of the two pixels. This ratio holds for two pixels with a mean of 1000 DN.
    """
    out = rate.copy()
    for axis in (0, 1):
        full = np.moveaxis(rate, axis, 0)
        mean_dn = 0.5 * (full[1:] + full[:-1]) * moment.shot.exposure_s
        flow = np.minimum(effect.strength * mean_dn / 1000, 0.2) * (full[1:] - full[:-1])
        view = np.moveaxis(out, axis, 0)
        view[1:] -= flow
        view[:-1] += flow
    return out


@declare(KNOWN, "read_out", ("offset_place",), "DN", 1.0, 12.0, sign=sign, seed=seed)
def dark_offset(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """The subtracted bias was measured on another day: a constant, positive or negative, that varies by 5 % from
    image to image.
    """
    own = np.random.default_rng([effect["seed"], moment.index]).normal(1.0, 0.05)
    return np.asarray(dn + effect["sign"] * effect.strength * own)


@declare(KNOWN, "read_out", ("gain_kind",), "share", 0.1, 0.25, sign=sign)
def gain_mismatch(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """The ratio of the two gains is wrong: combined images are too bright or too faint compared with high-only
    images.
    """
    # As in the library, this also changes faint pixels, although a combined image takes them from the high-gain image.
    factor = 1 + effect["sign"] * effect.strength if moment.shot.gain_mode == COMBINED else 1.0
    return dn * factor


@declare(
    KNOWN,
    "read_out",
    ("response",),
    "share lost at the faint end",
    0.1,
    0.6,
    DEPENDS_ON_NOISE,
    knee_dn=(30.0, 150.0),
    trap=coin,
)
def nonlinearity(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """Faint signals are read too low: by a power law below a knee, or because traps keep the first charges."""
    size, knee_dn = np.abs(dn), effect["knee_dn"]
    if effect["trap"]:
        loss = effect.strength * knee_dn * (1 - np.exp(-size / knee_dn))
        return np.asarray(np.sign(dn) * (size - loss))
    # Below the knee the signal is raised to the power 1 + p. The strength is the fraction lost at 1/20 of the knee.
    power = -np.log1p(-effect.strength) / np.log(20)
    return np.asarray(dn * np.minimum(np.maximum(size, 1e-3) / knee_dn, 1.0) ** power)


@declare(KNOWN, "read_out", ("memory",), "share of the column's mean", 0.005, 0.1, passed=(0.0, 0.5))
def column_smear(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """Columns are exposed while they are read out.

    Every pixel gets a fraction of the mean of its column, and of the pixels that its charge passes during the readout.
    """
    passed = 2 * np.cumsum(dn, axis=0) / dn.shape[0]
    smear = (1 - effect["passed"]) * dn.mean(axis=0)[None, :] + effect["passed"] * passed
    return np.asarray(dn + effect.strength * smear)


@declare(KNOWN, "read_out", ("memory",), "share at time 0", 0.01, 0.3, decay=(0.5, 2.0))
def persistence(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """Traps release charge of the four preceding images, of any pointing. The parameter `decay` is the decay time, in
    mean times between images.
    """
    shots = moment.plan.shots
    decay_s = effect["decay"] * (shots[-1].time_s - shots[0].time_s) / max(len(shots) - 1, 1)
    left = np.zeros_like(dn)
    for image in earlier[-4:]:
        left += np.exp(-(moment.shot.time_s - image.time_s) / decay_s) * image.dn
    return dn + effect.strength * left


@declare(
    CALIBRATION, "read_out", ("memory", "ghost"), "share", 0.01, 0.3, lag=(-0.35, 0.35), above=(0.2, 1.0)
)
def row_crosstalk(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """Crosstalk between the channels of the readout: bright pixels cause an echo in their row, at a fixed distance, a
    few pixels wide.
    """
    bright = np.maximum(dn - effect["above"] * max(float(dn.mean()), 0.0), 0.0)
    late = uniform_filter1d(bright, 5, axis=1, mode="constant")
    shift = round(effect["lag"] * dn.shape[1])
    echo = np.roll(late, shift, axis=1)
    echo[:, slice(None, shift) if shift >= 0 else slice(shift, None)] = 0.0
    return dn + effect.strength * echo


def _across(plan: Plan, rng: np.random.Generator) -> float:
    return float(rng.choice([0.0, 90.0])) + float(rng.normal(0, 5))


@declare(
    CALIBRATION,
    "read_out",
    ("offset_place", "light_place"),
    "DN",
    2.0,
    40.0,
    period_px=(25.0, 90.0),
    angle_deg=_across,
    phase_deg=ANGLE,
)
def stripes(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """A ripple of the power supply, in phase with the readout. Its period is longer than the disc."""
    y, x = np.mgrid[: dn.shape[0], : dn.shape[1]]
    cos, sin = direction(effect["angle_deg"])
    wave = np.sin(2 * np.pi * (x * cos + y * sin) / effect["period_px"] + np.deg2rad(effect["phase_deg"]))
    return np.asarray(dn + effect.strength * (wave + 0.3 * wave**3))


@declare(
    CALIBRATION,
    "read_out",
    ("response",),
    "share of the noise",
    0.3,
    3.0,
    DEPENDS_ON_NOISE | {"form_of": "nonlinearity"},
)
def faint_rounding(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """The compression on board truncates values towards zero, to steps that grow as the square root of the signal.

    The strength is the step divided by sqrt(6 signal), which is the photon noise for a gain of 6 DN. A truncation
    loses half a step on average: a smooth function of the counts, which is a nonlinearity whatever its curve.
    """
    # Steps of q in sqrt(|D|) are steps of 2 q sqrt(|D|) in D.
    q = effect.strength * np.sqrt(6.0) / 2
    return np.asarray(np.sign(dn) * (q * np.floor(np.sqrt(np.abs(dn)) / q)) ** 2)
