"""Effects that neither the gap library nor its calibration contains. The diagnosis is tested with them."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.signal import lfilter

from psfcore.blind.effects.effect import (
    ADDS_LIGHT,
    ANGLE,
    DEPENDS_ON_NOISE,
    TEST,
    Earlier,
    Effect,
    Moment,
    Plane,
    coin,
    declare,
    direction,
    near_a_disc,
    sign,
    unit_coordinates,
)
from psfcore.blind.effects.fine_optics import FINE, FineOptics, turned_offsets
from psfcore.simulate.plan import Plan
from psfcore.simulate.sky import Behind


@declare(
    TEST,
    "foreground",
    ("edge_time", "light_time"),
    "DN/s",
    2.0,
    100.0,
    angle_deg=ANGLE,
    length=(1.0, 6.0),
    fading=(0.5, 4.0),
)
def occulter_tail(effect: Effect, lit: Plane, moment: Moment) -> Plane:
    """Gas of the occulter emits light in front of it and in a tail, which moves with the disc. The light fades during
    the transit.

    The parameter `length` is the length of the tail, in radii of the disc. The brightness at time t of 0 to 1 is 1 / (1
    + `fading` t).
    """
    place, n = moment.plan.place(moment.index), lit.shape[0]
    x, y = ((np.arange(n) + 0.5) / FINE - 0.5 - at for at in (place.x_px, place.y_px))
    cos, sin = direction(effect["angle_deg"])
    along = (x[None, :] * cos + y[:, None] * sin) / place.radius_px
    across = (y[:, None] * cos - x[None, :] * sin) / place.radius_px
    away = np.minimum(np.hypot(np.minimum(along, 0.0), across), 50.0)
    tail = np.exp(-np.maximum(along, 0.0) / effect["length"]) / np.cosh(away) ** 2
    return np.asarray(lit + effect.strength / (1 + effect["fading"] * moment.elapsed) * tail)


@declare(TEST, "covered", ("edge",), "share at the limb", 0.1, 0.9, depth_px=(2.0, 6.0), angle_deg=ANGLE)
def transparent_limb(effect: Effect, share: Plane, around: Behind, moment: Moment) -> Plane:
    """Gas around the occulter refracts sunlight into the disc: a ring inside its limb, brighter on one side.

    The fraction of the light that passes decreases exponentially with the depth inside the limb.
    """
    place = moment.plan.place(moment.index)
    rows, columns = (
        first + (np.arange(FINE * n) + 0.5) / FINE - 0.5
        for first, n in zip(around.first, around.shape, strict=True)
    )
    x, y = columns[None, :] - place.x_px, rows[:, None] - place.y_px
    depth = np.maximum(place.radius_px - np.hypot(x, y), 0.0) / effect["depth_px"]
    side = 0.5 + 0.5 * np.cos(np.arctan2(y, x) - np.deg2rad(effect["angle_deg"]))
    return np.asarray(share * (1 - effect.strength * side * np.exp(-depth)))


@declare(TEST, "spread", ("psf_time",), "share of the scatter", 0.05, 0.6, instant=(0.25, 0.75))
def dust_release(effect: Effect, seen: Plane, lit: Plane, optics: FineOptics, moment: Moment) -> Plane:
    """A jolt of the filter wheel shakes dust onto a mirror: from one image to the next the total of the scatter jumps.

    The parameter `instant` is the elapsed fraction of the transit at the jolt.
    """
    if moment.elapsed < effect["instant"]:
        return seen
    return np.asarray(seen + optics.more_scatter.apply(effect.strength * lit))


@declare(
    TEST,
    "optics",
    ("psf",),
    "share of light",
    0.05,
    0.5,
    angle_deg=ANGLE,
    width_px=(0.5, 2.0),
    length_px=(10.0, 60.0),
)
def groove_streak(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """Parallel grooves on a mirror scatter light into a streak: a Lorentzian across it, and a slow decrease along
    it.
    """
    along, across = turned_offsets(optics, effect["angle_deg"])
    streak = 1 / (1 + (across / effect["width_px"]) ** 2) / (1 + np.abs(along) / effect["length_px"]) ** 2
    scatter = (1 - effect.strength) * optics.scatter + effect.strength * streak / streak.sum()
    return dataclasses.replace(optics, scatter=scatter)


def _drops(plan: Plan, rng: np.random.Generator) -> tuple[tuple[float, ...], ...]:
    near, count = near_a_disc(0.05), int(rng.integers(3, 8))
    return tuple((*near(plan, rng), *rng.uniform((0.06, 0.0), (0.12, 0.7)).tolist()) for _ in range(count))


@declare(TEST, "spread", ("psf_place_time", "psf_place"), "share of the scatter", 0.2, 1.0, drops=_drops)
def condensation(effect: Effect, seen: Plane, lit: Plane, optics: FineOptics, moment: Moment) -> Plane:
    """Vapour condenses on a cold filter near the focus: drops with an edge appear one after another. The scatter there
    is stronger.

    The parameter `drops` lists x, y and radius (fractions of the field) of each drop, and the elapsed fraction of the
    transit at which the drop appears.
    """
    wet = [
        np.hypot(*unit_coordinates(lit.shape, at=(x, y))) < radius
        for x, y, radius, instant in effect["drops"]
        if moment.elapsed >= instant
    ]
    return np.asarray(seen + optics.more_scatter.apply(effect.strength * np.any(wet, axis=0) * lit))


def _off_axis(plan: Plan, rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(0.3, 0.7)), float(rng.uniform(0.3, 0.7))


@declare(
    TEST,
    "spread",
    ("psf_place",),
    "share of the scatter, half a field from the axis",
    0.1,
    0.8,
    axis=_off_axis,
    exponent=(3.0, 6.0),
)
def rough_rim(effect: Effect, seen: Plane, lit: Plane, optics: FineOptics, moment: Moment) -> Plane:
    """The rim of a mirror is polished badly, and light from far off the axis meets it: the scatter rises as a steep
    power.

    The parameter `axis` is the point x, y of the axis, fractions of the field. The scatter at most doubles.
    """
    away = 2 * np.hypot(*unit_coordinates(lit.shape, at=effect["axis"]))
    more = np.minimum(effect.strength * away ** effect["exponent"], 1.0)
    return np.asarray(seen + optics.more_scatter.apply(more * lit))


@declare(
    TEST,
    "light",
    ("light_place",),
    "DN/s at its peak",
    2.0,
    400.0,
    ADDS_LIGHT,
    at=near_a_disc(0.05),
    angle_deg=ANGLE,
    radius=(0.25, 0.6),
    width=(0.02, 0.05),
    span_deg=(40.0, 120.0),
)
def mount_arc(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """The round mount of a filter reflects light: a part of a ring, as wide as the mount is thick, on the same pixels
    in every image.
    """
    along, across = unit_coordinates(seen.shape, effect["angle_deg"], effect["at"])
    along = along + effect["radius"]  # from the centre of the ring; the arc passes through the point
    turn = np.arctan2(across, along) / np.deg2rad(effect["span_deg"])
    away = (np.hypot(along, across) - effect["radius"]) / effect["width"]
    return np.asarray(seen + effect.strength * np.cos(np.pi * np.clip(turn, -0.5, 0.5)) / (1 + away**2))


@declare(
    TEST,
    "light",
    ("light_place",),
    "DN/s at its peak",
    2.0,
    400.0,
    ADDS_LIGHT,
    at=near_a_disc(0.08),
    radius=(0.08, 0.2),
)
def filter_pinhole(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """A pinhole in the filter before the detector projects the Sun in visible light: a darkening disc with an edge."""
    r = np.hypot(*unit_coordinates(seen.shape, at=effect["at"])) / effect["radius"]
    return seen + effect.strength * np.where(r < 1, 0.4 + 0.6 * np.sqrt(np.maximum(1 - r**2, 0.0)), 0.0)


def _creases(plan: Plan, rng: np.random.Generator) -> tuple[tuple[float, ...], ...]:
    near, count = near_a_disc(0.02), int(rng.integers(3, 7))
    return tuple((*near(plan, rng), *rng.uniform((0, 0.008), (180, 0.02)).tolist()) for _ in range(count))


@declare(TEST, "light", ("light_place",), "DN/s at their peak", 5.0, 400.0, ADDS_LIGHT, creases=_creases)
def foil_creases(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """The foil of a filter before the detector has creases, through which visible sunlight passes: narrow straight
    lines.

    The parameter `creases` lists x and y of a point (fractions of the field), direction (degrees) and half width
    (fraction of the field) of each crease.
    """
    light = np.zeros_like(seen)
    for x, y, angle_deg, half_width in effect["creases"]:
        _, across = unit_coordinates(seen.shape, angle_deg, (x, y))
        light += np.maximum(1 - np.abs(across) / half_width, 0.0)
    return seen + effect.strength * light


@declare(TEST, "expected", ("light_time",), "DN/s", 1.0, 60.0, period=(0.25, 0.6), phase=(0.0, 1.0))
def encoder_lamp(effect: Effect, rate: Plane, moment: Moment) -> Plane:
    """The lamp of a position encoder is lit half of the time, at regular intervals: a uniform light, a square wave in
    time.
    """
    lit = (moment.elapsed / effect["period"] + effect["phase"]) % 1 < 0.5
    return np.asarray(rate + effect.strength * lit)


@declare(
    TEST,
    "light",
    ("light_pointing",),
    "DN/s",
    3.0,
    200.0,
    at=near_a_disc(0.1),
    angle_deg=ANGLE,
    step_deg=(15.0, 60.0),
    half_width=(0.05, 0.15),
    edge=(0.005, 0.03),
)
def stray_beam(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """Sunlight between two baffles crosses the field as a beam with soft edges. Its angle changes with the pointing."""
    angle_deg = effect["angle_deg"] + moment.shot.pointing * effect["step_deg"]
    _, across = unit_coordinates(seen.shape, angle_deg, effect["at"])
    left, right = ((across + side * effect["half_width"]) / effect["edge"] for side in (1, -1))
    return np.asarray(seen + effect.strength * (np.arctan(left) - np.arctan(right)) / np.pi)


@declare(
    TEST, "expected", ("light_time",), "DN/s at its peak", 2.0, 100.0, start=(-0.1, 0.5), rise=(0.05, 0.25)
)
def particle_shower(effect: Effect, rate: Plane, moment: Moment) -> Plane:
    """A solar particle event hits the detector: a uniform light that rises fast and decays slowly, with noise."""
    since = max(moment.elapsed - effect["start"], 0.0) / effect["rise"]
    return np.asarray(rate + effect.strength * since * np.exp(1 - since))


@declare(
    TEST,
    "read_out",
    ("memory", "response"),
    "share lost in the last row",
    0.1,
    0.9,
    DEPENDS_ON_NOISE,
    trail_px=(4.0, 25.0),
)
def charge_trails(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """Radiation damage: traps keep charge that is moved to the readout, and release it into the rows behind.

    A pixel with 100 DN in the last row loses the strength; the loss grows with the row, and as the power 0.7 of the
    charge.
    """
    row = (np.arange(dn.shape[0])[:, None] + 1) / dn.shape[0]
    lost = effect.strength * row * 100 * (np.maximum(dn, 0.0) / 100) ** 0.7
    keeps = np.exp(-1 / effect["trail_px"])
    return np.asarray(dn - lost + lfilter([0.0, 1 - keeps], [1.0, -keeps], lost, axis=0))


@declare(
    TEST,
    "read_out",
    ("offset_place", "offset_place_time", "offset_time"),
    "DN in the first row",
    3.0,
    60.0,
    sign=sign,
    rows=(0.1, 0.4),
    reversed=coin,
)
def bias_settling(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """The amplifier cools while it waits: its level settles exponentially during the readout, by more after a longer
    wait.
    """
    shots = moment.plan.shots
    wait = (moment.shot.time_s - earlier[-1].time_s) if earlier else np.inf
    cold = -np.expm1(-wait * len(shots) / max(shots[-1].time_s - shots[0].time_s, 1e-9))
    settling = np.exp(-np.arange(dn.shape[0]) / (effect["rows"] * dn.shape[0]))
    level = settling[::-1] if effect["reversed"] else settling
    return np.asarray(dn + effect["sign"] * effect.strength * cold * level[:, None])
