"""Effects of the scene: changes of the Sun and of the occulter, and light that comes from the Sun around the field."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter, zoom
from scipy.optimize import brentq

from psfcore.blind.effects.effect import (
    ADDS_LIGHT,
    ANGLE,
    CALIBRATION,
    KNOWN,
    Effect,
    Moment,
    Plane,
    declare,
    direction,
    seed,
    unit_coordinates,
)
from psfcore.blind.effects.fine_optics import FINE
from psfcore.simulate.plan import HIGH, Plan
from psfcore.simulate.sky import Behind, covered_share
from psfcore.transit.transit import Place


@declare(
    KNOWN, "covered", ("edge",), "px/s", 0.4, 1.5, angle_deg=lambda plan, rng: float(rng.normal(3.0, 8.0))
)
def occulter_motion(effect: Effect, share: Plane, around: Behind, moment: Moment) -> Plane:
    """The disc moves along a straight line during the exposure, in steps of at most a fifth of a pixel."""
    way = effect.strength * moment.shot.exposure_s
    steps = max(5, int(np.ceil(5 * way)))
    along = way * ((np.arange(steps) + 0.5) / steps - 0.5)
    cos, sin = direction(effect["angle_deg"])
    disc = moment.plan.place(moment.index)
    moved = (Place(disc.x_px + s * cos, disc.y_px + s * sin, disc.radius_px) for s in along)
    return np.asarray(sum(covered_share(at, around.first, around.shape, FINE) for at in moved) / steps)


@declare(KNOWN, "scene", ("sun",), "share, rms", 0.2, 0.6, seed=seed, patch=(0.02, 0.08), period=(0.15, 0.6))
def scene_evolution(effect: Effect, scene: Plane, moment: Moment) -> Plane:
    """Patches of the Sun brighten and fade with the same period, but with different phases."""
    phase = 2 * np.pi * moment.elapsed / effect["period"]
    first, second = (
        patches(scene.shape[0], effect["seed"] + 10 * moment.shot.pointing + k, effect["patch"])
        for k in (0, 1)
    )
    change = effect.strength * (first * np.sin(phase) + second * (np.cos(phase) - 1))
    return np.asarray(scene * np.exp(change - change.var() / 2))


@declare(
    KNOWN,
    "light",
    ("outside",),
    "DN/s",
    400.0,
    4000.0,
    edges=lambda plan, rng: tuple(int(edge) for edge in rng.integers(0, 4, len(plan.views))),
    levels=lambda plan, rng: tuple(float(level) for level in rng.uniform(0.3, 1.0, len(plan.views))),
    b_px=(4.0, 8.0),
    c=(2.4, 2.6),
    a=(0.3, 0.7),
)
def out_of_field_light(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """In each pointing, a bright band beyond one edge of the field scatters light into the field.

    The brightness of the band in a pointing is the strength times the entry of `levels`. The band is half as wide as
    the field, and begins a twelfth of the field beyond the edge. `edges` holds the edge of each pointing: 0 left, 1
    right, 2 below, 3 above. `b_px`, `c` and `a` are the parameters of the power law that scatters the light of the
    band.
    """
    pointing = moment.shot.pointing - 1
    band = _band(seen.shape[0], effect["edges"][pointing], effect["b_px"], effect["c"], effect["a"])
    return np.asarray(seen + effect.strength * effect["levels"][pointing] * band)


@cache
def _band(fine_size: int, edge: int, b_px: float, c: float, a: float) -> Plane:
    """The light [y, x] that is scattered into the field from a band of 1 DN/s beyond one edge.

    This light is smooth, so it is computed on a coarse grid and interpolated.
    """
    size = fine_size // FINE
    step = size / 32
    at = (np.arange(32) + 0.5) * step
    sources = -(size / 12) - (np.arange(16) + 0.5) * step
    along = np.linspace(-size / 2, 1.5 * size, 64)
    area = step * (along[1] - along[0])
    far = (at[:, None] - sources[None, :]) ** 2
    beside = (at[:, None] - along[None, :]) ** 2
    distance = np.sqrt(far[None, :, :, None] + beside[:, None, None, :])
    coarse = a * area * ((b_px + distance) ** -c).sum(axis=(2, 3))  # [y, x], the band to the left
    plane = zoom(coarse, fine_size / 32, order=3, mode="nearest", grid_mode=True)
    turned = {0: plane, 1: plane[:, ::-1], 2: plane.T, 3: plane.T[::-1]}[edge]
    return np.ascontiguousarray(np.maximum(turned, 0.0))


@declare(
    CALIBRATION,
    "light",
    ("light_pointing",),
    "DN/s",
    1.0,
    60.0,
    ADDS_LIGHT,
    pointing=lambda plan, rng: int(rng.choice([1, len(plan.views)])),
    angle_deg=ANGLE,
    rays=lambda plan, rng: int(rng.integers(2, 6)),
    phase_deg=ANGLE,
)
def limb_glint(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """In one pointing an edge of the baffle reflects sunlight: rays that spread from a point beyond the edge of the
    field.
    """
    if moment.shot.pointing != effect["pointing"]:
        return seen
    cos, sin = direction(effect["angle_deg"])
    x, y = unit_coordinates(seen.shape, at=(0.5 + 0.8 * cos, 0.5 + 0.8 * sin))
    fan = np.cos(2 * effect["rays"] * np.arctan2(y, x) + np.deg2rad(effect["phase_deg"])) ** 2
    return np.asarray(seen + effect.strength * (0.2 + fan) * np.exp(-np.hypot(x, y) / 0.5) / np.exp(-1.6))


def _saturation_level(effect: Effect, exposures: list[Plane], plan: Plan) -> float:
    """The level at which high-only images clip."""
    high = [dn for dn, shot in zip(exposures, plan.shots, strict=True) if shot.gain_mode == HIGH]
    values = np.concatenate([np.maximum(dn, 0.0).ravel() for dn in high])
    lost = effect.strength * values.sum()
    level = brentq(lambda dn: np.maximum(values - dn, 0.0).sum() - lost, 0.0, values.max(), xtol=0.1)
    return float(np.rint(level))


@declare(
    KNOWN,
    "scene",
    ("response",),
    "share of the light above the level",
    0.03,
    0.15,
    {"saturation_dn": _saturation_level, "also": ("scene_evolution",)},
    seed=seed,
    flicker=(0.15, 0.5),
)
def saturation_fill(effect: Effect, scene: Plane, moment: Moment) -> Plane:
    """Clipped pixels are filled from another image, or stay clipped. The strength is the fraction of the light that
    is lost by clipping.

    The bright pixels that clip also flicker, so other images show other values in them.
    """
    bright = scene > np.quantile(scene[::4, ::4], 0.98)
    phase = patches(scene.shape[0], effect["seed"] + moment.shot.pointing, 0.1)
    swing = effect["flicker"] * effect.strength / (effect.strength + 0.005)
    factor = 1 + swing * np.sin(40 * moment.elapsed + 2 * phase)
    return np.where(bright, scene * factor, scene)


@cache
def patches(size: int, seed: int, patch: float) -> Plane:
    """A smooth random plane [y, x] with mean 0 and rms 1.

    Parameters
    ----------
    patch
        The size of the patches, as a fraction of the field.
    """
    rng = np.random.default_rng(seed)
    coarse = max(8, int(np.ceil(4 / patch)))
    drawn = gaussian_filter(rng.standard_normal((coarse, coarse)), 1.5)
    plane = zoom(drawn, size / coarse, order=3, grid_mode=True, mode="nearest")
    return np.asarray((plane - plane.mean()) / plane.std())
