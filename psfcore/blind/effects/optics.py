"""Effects of the optics: changes of the true PSF that the fitted PSF does not contain, and ghosts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.ndimage import affine_transform, gaussian_filter

from psfcore.blind.effects.effect import (
    ANGLE,
    CALIBRATION,
    KNOWN,
    VARIES,
    Effect,
    Moment,
    Plane,
    coin,
    declare,
    direction,
    sign,
    unit_coordinates,
)
from psfcore.blind.effects.fine_optics import FINE, FineOptics, scaled_scatter, turned_offsets
from psfcore.convolution.convolver import linear_convolve

_HALF_TURN = (0.0, 180.0)
_FINER = 9  # number of samples in a fine pixel along each axis


@declare(KNOWN, "optics", ("psf",), "stretch", 0.1, 0.6, angle_deg=_HALF_TURN)
def anisotropic_scatter(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """The mirrors were polished along one direction: scatter is stretched. The stretch grows with the distance r as r
    / (r + b).
    """
    law = optics.law
    along, across = turned_offsets(optics, effect["angle_deg"])
    r = np.hypot(along, across)
    factor = 1 + effect.strength * r / (r + law.b_px)
    falloff = (law.b_px + np.hypot(along / factor, across * factor)) ** -law.c
    return rescaled(optics, falloff, (law.b_px + r) ** -law.c)


@declare(CALIBRATION, "optics", ("psf",), "share", 0.2, 0.95, angle_deg=ANGLE, reach_px=(15.0, 80.0))
def one_sided_scatter(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """A mirror is tilted or contaminated on one side: scatter is stronger there, similar to coma, up to a few tens of
    pixels.
    """
    along, across = turned_offsets(optics, effect["angle_deg"])
    r = np.hypot(along, across)
    isotropic = (optics.law.b_px + r) ** -optics.law.c
    lean = along / np.maximum(r, 0.5 / FINE) * np.exp(-r / effect["reach_px"])
    return rescaled(optics, isotropic * (1 + effect.strength * lean), isotropic)


def rescaled(optics: FineOptics, falloff: Plane, before: Plane) -> FineOptics:
    """The telescope with another falloff of the scatter; the total of the scatter stays the same.

    Parameters
    ----------
    before
        The old falloff, which `falloff` replaces.
    """
    amplitude = optics.law.a / FINE**2 * float(before.sum() / falloff.sum())
    return dataclasses.replace(optics, scatter=scaled_scatter(falloff, optics.law, amplitude))


@declare(KNOWN, "optics", ("psf",), "share of light", 0.02, 0.3, scale=(0.15, 0.5), moffat=coin)
def wide_halo(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """Particles or a second surface scatter a fraction of the light into an exponential or Moffat halo.

    The parameter `scale` is the scale of the halo, in widths of the field.
    """
    x, y = optics.offsets_px
    r, scale_px = np.hypot(x, y), effect["scale"] * moment.plan.size_px
    if effect["moffat"]:  # half of the light is within 0.88 scale_px
        halo = (1 + (r / scale_px) ** 2) ** -2.2 * 1.2 / (np.pi * scale_px**2)
    else:
        halo = np.exp(-r / scale_px) / (2 * np.pi * scale_px**2)
    scatter = (1 - effect.strength) * optics.scatter + effect.strength * halo / FINE**2
    return dataclasses.replace(optics, scatter=scatter)


@declare(KNOWN, "optics", ("core",), "px", 1.0, 3.0, {"power": 1.5}, angle_deg=_HALF_TURN, jitter=coin)
def core_blur(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """A Moffat profile blurs the core (defocus, figure errors), or a motion spreads it along a straight line
    (jitter).
    """
    width = effect.strength
    return _blurred(optics, _line(width, effect["angle_deg"]) if effect["jitter"] else _moffat(width))


@declare(CALIBRATION, "optics", ("psf_time", "core"), "px at the end", 2.0, 8.0, VARIES | {"power": 1.5})
def focus_drift(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """The telescope's structure warms: blur by a uniform disc, whose diameter grows from 0 to the strength at the
    last image.
    """
    diameter = effect.strength * moment.elapsed
    return optics if diameter == 0 else _blurred(optics, _pillbox(diameter))


def _blurred(optics: FineOptics, blur: Plane) -> FineOptics:
    n = optics.diffraction.shape[0]
    return dataclasses.replace(optics, diffraction=linear_convolve(optics.diffraction, blur, (n, n)))


def _sampled(reach_px: float, profile: Callable[[Plane, Plane], Plane]) -> Plane:
    """A kernel [y, x] on fine pixels with the sum 1.

    Parameters
    ----------
    profile
        Function of x and y, detector px, that gives the value of the kernel, up to reach_px.
    """
    half = int(np.ceil(reach_px * FINE)) + 1
    n = 2 * half + 1
    at = ((np.arange(n * _FINER) + 0.5) / _FINER - half - 0.5) / FINE
    kernel = profile(at[None, :], at[:, None]).reshape(n, _FINER, n, _FINER).sum(axis=(1, 3))
    return np.asarray(kernel / kernel.sum())


def _moffat(width_px: float) -> Plane:
    """A Moffat profile of exponent 3 with a full width at half maximum of width_px."""
    core = width_px / (2 * np.sqrt(2 ** (1 / 3) - 1))
    return _sampled(8 * width_px + 1, lambda x, y: (1 + (x**2 + y**2) / core**2) ** -3.0)


def _pillbox(diameter_px: float) -> Plane:
    """A kernel that is a uniform disc; its edge is half a sample wide."""
    radius_px, slope = diameter_px / 2, _FINER * FINE
    return _sampled(
        radius_px + 0.5, lambda x, y: np.clip((radius_px - np.hypot(x, y)) * slope + 0.5, 0.0, 1.0)
    )


def _line(length_px: float, angle_deg: float) -> Plane:
    """A kernel that spreads light evenly along a straight line, with the width of a fine pixel."""
    cos, sin = direction(angle_deg)

    def near(x: Plane, y: Plane) -> Plane:
        beyond = np.maximum(np.abs(x * cos + y * sin) - length_px / 2, 0.0)
        return np.asarray(np.maximum(1 - FINE * np.hypot(beyond, y * cos - x * sin), 0.0))

    return _sampled(length_px / 2 + 1, near)


@declare(KNOWN, "optics", ("psf",), "share of the spacing", 0.05, 0.3, sign=sign)
def mesh_pitch(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """The pitch of the mesh, or the wavelength, differs: the distances of the mesh orders are larger, or smaller,
    than assumed.
    """
    kernel = optics.glass.fine(pitch_factor=1 + effect["sign"] * effect.strength)
    return dataclasses.replace(optics, diffraction=kernel)


@declare(KNOWN, "optics", ("psf",), "degrees", 3.0, 20.0, sign=sign)
def mesh_rotation(effect: Effect, optics: FineOptics, moment: Moment) -> FineOptics:
    """The filter was mounted at another angle, so the mesh is rotated."""
    kernel = optics.glass.fine(turn_deg=effect["sign"] * effect.strength)
    return dataclasses.replace(optics, diffraction=kernel)


@declare(KNOWN, "spread", ("psf_place",), "share of the scatter", 0.2, 0.8, angle_deg=ANGLE, bowl=(-0.6, 0.6))
def field_dependent_scatter(
    effect: Effect, seen: Plane, lit: Plane, optics: FineOptics, moment: Moment
) -> Plane:
    """Light from another field angle meets a rougher part of the mirrors.

    The relative change of the total scatter is the sum of a linear and a quadratic term. The linear term is the
    strength at the edge of the field.
    """
    along, across = unit_coordinates(lit.shape, effect["angle_deg"])
    more = effect.strength * (2 * along + effect["bowl"] * (4 * (along**2 + across**2) - 2 / 3))
    return np.asarray(seen + optics.more_scatter.apply(more * lit))


@declare(
    KNOWN,
    "light",
    ("ghost",),
    "share of light",
    0.01,
    0.1,
    shift=(0.08, 0.3),
    angle_deg=ANGLE,
    turn_deg=(-3.0, 3.0),
    magnification=(0.96, 1.04),
    blur_px=(2.0, 10.0),
)
def ghost(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """Light is reflected between the filter and the detector.

    The ghost is a faint copy of the image that is displaced, out of focus, slightly rotated and slightly magnified. The
    parameter `shift` is the distance of the copy, in widths of the field.
    """
    n, magnification = seen.shape[0], effect["magnification"]
    cos, sin = direction(effect["turn_deg"])
    turn = np.array([[cos, -sin], [sin, cos]]) / magnification
    middle = np.array([(n - 1) / 2, (n - 1) / 2])
    shift = n * effect["shift"] * np.array(direction(effect["angle_deg"])[::-1])
    soft = gaussian_filter(seen, effect["blur_px"] * FINE, mode="constant")
    copy = affine_transform(soft, turn, middle - turn @ (middle + shift), order=1)
    return np.asarray(seen + effect.strength / magnification**2 * copy)
