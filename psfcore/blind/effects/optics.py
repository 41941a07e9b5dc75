"""Effects of the optics: changes of the true PSF that the fitted PSF does not contain, and ghosts."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter

from psfcore.blind.effects.effect import Effect, Kind, Moment, angle, direction, sign, unit_coordinates
from psfcore.blind.effects.fine_optics import FINE, FineOptics, scaled_scatter, turned_offsets
from psfcore.convolution.convolver import linear_convolve
from psfcore.simulate.plan import Plan

Plane = NDArray[np.float64]


def _anisotropic_scatter(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """Scatter that is stretched along a direction. The stretch grows with the distance r as r / (r + b)."""
    law = optics.law
    along, across = turned_offsets(optics, effect["angle_deg"])
    r = np.hypot(along, across)
    factor = 1 + effect.strength * r / (r + law.b_px)
    falloff = (law.b_px + np.hypot(along / factor, across * factor)) ** -law.c
    return _rescaled(optics, falloff, (law.b_px + r) ** -law.c)


def _one_sided_scatter(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """Scatter that is stronger towards one side, similar to coma. It reaches a few tens of pixels."""
    along, across = turned_offsets(optics, effect["angle_deg"])
    r = np.hypot(along, across)
    isotropic = (optics.law.b_px + r) ** -optics.law.c
    lean = along / np.maximum(r, 0.5 / FINE) * np.exp(-r / effect["reach_px"])
    return _rescaled(optics, isotropic * (1 + effect.strength * lean), isotropic)


def _rescaled(optics: FineOptics, falloff: Plane, before: Plane) -> FineOptics:
    """The telescope with another falloff of the scatter; the total of the scatter stays the same. before: the old falloff."""
    amplitude = optics.law.a / FINE**2 * float(before.sum() / falloff.sum())
    return dataclasses.replace(optics, scatter=scaled_scatter(falloff, optics.law, amplitude))


def _wide_halo(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """A fraction of the light is in a halo, exponential or Moffat, that is tens to hundreds of pixels wide."""
    scale_px = effect["scale_px"]
    x, y = optics.offsets_px
    r = np.hypot(x, y)
    if effect["moffat"]:  # half of the light is within 0.88 scale_px
        halo = (1 + (r / scale_px) ** 2) ** -2.2 * 1.2 / (np.pi * scale_px**2)
    else:
        halo = np.exp(-r / scale_px) / (2 * np.pi * scale_px**2)
    scatter = (1 - effect.strength) * optics.scatter + effect.strength * halo / FINE**2
    return dataclasses.replace(optics, scatter=scatter)


def _draw_wide_halo(plan: Plan, rng: np.random.Generator) -> dict[str, Any]:
    return {"scale_px": float(rng.uniform(0.15, 0.5) * plan.size_px), "moffat": bool(rng.random() < 0.5)}


def _core_blur(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """A wider core. A Moffat profile blurs it (defocus, figure errors), or it is spread along a straight line (jitter)."""
    width = effect.strength
    return _blurred(optics, _line(width, effect["angle_deg"]) if effect["jitter"] else _moffat(width))


def _focus_drift(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """Blur by a uniform disc. Its diameter grows from 0 at the first image to the strength at the last."""
    diameter = effect.strength * moment.elapsed
    return optics if diameter == 0 else _blurred(optics, _pillbox(diameter))


def _blurred(optics: FineOptics, blur: Plane) -> FineOptics:
    n = optics.diffraction.shape[0]
    return dataclasses.replace(optics, diffraction=linear_convolve(optics.diffraction, blur, (n, n)))


def _square(reach_px: float, finer: int) -> tuple[Plane, Plane]:
    """Coordinates of samples up to reach_px, in detector px: x (1, n) and y (n, 1). A fine pixel has `finer` samples per axis."""
    half = int(np.ceil(reach_px * FINE)) + 1
    at = (np.arange((2 * half + 1) * finer) + 0.5) / finer - half - 0.5
    return at[None, :] / FINE, at[:, None] / FINE


def _collected(samples: Plane, finer: int) -> Plane:
    n = samples.shape[0] // finer
    return _normalised(samples.reshape(n, finer, n, finer).sum(axis=(1, 3)))


def _moffat(width_px: float) -> Plane:
    """A Moffat profile of exponent 3 with a full width at half maximum of width_px."""
    x, y = _square(8 * width_px + 1, 5)
    core = width_px / (2 * np.sqrt(2 ** (1 / 3) - 1))
    return _collected((1 + (x**2 + y**2) / core**2) ** -3.0, 5)


def _pillbox(diameter_px: float) -> Plane:
    """A kernel that is a uniform disc."""
    x, y = _square(diameter_px / 2 + 0.5, 9)
    inside = np.clip((diameter_px / 2 - np.hypot(x, y)) * 9 * FINE + 0.5, 0.0, 1.0)
    return _collected(inside if inside.sum() > 0 else np.exp(-((x**2 + y**2) * 400.0)), 9)


def _line(length_px: float, angle_deg: float) -> Plane:
    """A kernel that spreads light evenly along a straight line."""
    half = int(np.ceil(length_px / 2 * FINE)) + 2
    plane = np.zeros((2 * half + 1, 2 * half + 1))
    for s in (np.arange(200) + 0.5) / 200 - 0.5:
        x = half + s * length_px * FINE * np.cos(np.deg2rad(angle_deg))
        y = half + s * length_px * FINE * np.sin(np.deg2rad(angle_deg))
        row, column = int(y), int(x)
        for dy, wy in ((0, 1 - (y - row)), (1, y - row)):
            for dx, wx in ((0, 1 - (x - column)), (1, x - column)):
                plane[row + dy, column + dx] += wy * wx
    return _normalised(plane)


def _normalised(weights: Plane) -> Plane:
    """A kernel [y, x] with the sum 1."""
    return np.asarray(weights / weights.sum())


def _mesh_pitch(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """The distances of the mesh orders are larger, or smaller, than assumed."""
    kernel = optics.glass.fine(pitch_factor=1 + effect["sign"] * effect.strength)
    return dataclasses.replace(optics, diffraction=kernel)


def _mesh_rotation(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """The mesh is rotated with respect to its assumed angle."""
    kernel = optics.glass.fine(turn_deg=effect["sign"] * effect.strength)
    return dataclasses.replace(optics, diffraction=kernel)


def _field_dependent_scatter(
    effect: Effect, seen: Plane, lit: Plane, optics: FineOptics, moment: Moment
) -> Plane:
    """The total scatter depends on the position of the source in the field.

    The relative change of the total scatter is the sum of a linear and a quadratic term. The linear term is the strength
    at the edge of the field.
    """
    u, v = unit_coordinates(lit.shape)
    cos, sin = direction(effect["angle_deg"])
    more = effect.strength * (2 * (u * cos + v * sin) + effect["bowl"] * (4 * (u**2 + v**2) - 2 / 3))
    return np.asarray(seen + optics.more_scatter.apply(more * lit))


def _ghost(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """A faint copy of the image that is displaced, out of focus, slightly rotated and slightly magnified."""
    n, magnification = seen.shape[0], effect["magnification"]
    cos, sin = direction(effect["turn_deg"])
    turn = np.array([[cos, -sin], [sin, cos]]) / magnification
    middle = np.array([(n - 1) / 2, (n - 1) / 2])
    shift = n * np.array([effect["shift_y"], effect["shift_x"]])
    soft = gaussian_filter(seen, effect["blur_px"] * FINE, mode="constant")
    copy = affine_transform(soft, turn, middle - turn @ (middle + shift), order=1)
    return np.asarray(seen + effect.strength / magnification**2 * copy)


def _draw_ghost(plan: Plan, rng: np.random.Generator) -> dict[str, Any]:
    way, towards = float(rng.uniform(0.08, 0.3)), float(rng.uniform(0, 2 * np.pi))
    return {
        "shift_x": way * float(np.cos(towards)),
        "shift_y": way * float(np.sin(towards)),
        "turn_deg": float(rng.uniform(-3, 3)),
        "magnification": float(rng.uniform(0.96, 1.04)),
        "blur_px": float(rng.uniform(2, 10)),
    }


OPTICS_EFFECTS = (
    Kind(
        "ghost",
        "optics",
        "share of light",
        "light is reflected between the filter and the detector",
        nominal=0.01,
        largest=0.1,
        draw=_draw_ghost,
        light=_ghost,
    ),
    Kind(
        "anisotropic_scatter",
        "optics",
        "stretch",
        "the mirrors were polished along one direction",
        nominal=0.1,
        largest=0.6,
        draw=lambda plan, rng: {"angle_deg": angle(rng) % 180},
        optics=_anisotropic_scatter,
    ),
    Kind(
        "field_dependent_scatter",
        "optics",
        "share of the scatter",
        "light from another field angle meets a rougher part of the mirrors",
        nominal=0.2,
        largest=0.8,
        draw=lambda plan, rng: {"angle_deg": angle(rng), "bowl": float(rng.uniform(-0.6, 0.6))},
        spread=_field_dependent_scatter,
    ),
    Kind(
        "wide_halo",
        "optics",
        "share of light",
        "particles or a second surface scatter to large distances, besides the roughness of the mirrors",
        nominal=0.02,
        largest=0.3,
        draw=_draw_wide_halo,
        optics=_wide_halo,
    ),
    Kind(
        "core_blur",
        "optics",
        "px",
        "the telescope is out of focus, or moves during the exposure",
        nominal=1.0,
        largest=3.0,
        power=1.5,
        draw=lambda plan, rng: {"angle_deg": angle(rng) % 180, "jitter": bool(rng.random() < 0.5)},
        optics=_core_blur,
    ),
    Kind(
        "mesh_rotation",
        "optics",
        "degrees",
        "the filter was mounted at another angle",
        nominal=3.0,
        largest=20.0,
        draw=lambda plan, rng: {"sign": sign(rng)},
        optics=_mesh_rotation,
    ),
    Kind(
        "mesh_pitch",
        "optics",
        "share of the spacing",
        "the pitch of the mesh, or the wavelength, differs from the assumed one",
        nominal=0.05,
        largest=0.3,
        draw=lambda plan, rng: {"sign": sign(rng)},
        optics=_mesh_pitch,
    ),
    Kind(
        "one_sided_scatter",
        "optics",
        "share",
        "a mirror is tilted or contaminated on one side",
        nominal=0.2,
        largest=0.95,
        draw=lambda plan, rng: {"angle_deg": angle(rng), "reach_px": float(rng.uniform(15, 80))},
        optics=_one_sided_scatter,
    ),
    Kind(
        "focus_drift",
        "optics",
        "px at the end",
        "the telescope's structure warms during the transit",
        nominal=2.0,
        largest=8.0,
        power=1.5,
        varies=True,
        optics=_focus_drift,
    ),
)
