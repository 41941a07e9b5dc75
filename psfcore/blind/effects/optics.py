"""Effects of the optics: changes of the true PSF that the fitted PSF does not contain, and ghosts."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter

from psfcore.blind.effects.effect import Effect, Moment, angle, unit_coordinates
from psfcore.blind.effects.fine_optics import FINE, FineOptics, scaled_scatter, small_kernel, turned_offsets
from psfcore.convolution.convolver import linear_convolve
from psfcore.simulate.plan import Plan

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class AnisotropicScatter(Effect):
    """Scatter that is stretched along a direction. The stretch grows with the distance r as r / (r + b)."""

    angle_deg: float = 0.0

    name: ClassVar[str] = "anisotropic_scatter"
    stage: ClassVar[str] = "optics"
    unit: ClassVar[str] = "stretch"
    cause: ClassVar[str] = "the mirrors were polished along one direction"
    nominal: ClassVar[float] = 0.1
    largest: ClassVar[float] = 0.6

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, angle(rng) % 180)

    def optics(self, optics: FineOptics, moment: Moment) -> FineOptics:
        if self.strength == 0:
            return optics
        law = optics.law
        along, across = turned_offsets(optics, self.angle_deg)
        r = np.hypot(along, across)
        factor = 1 + self.strength * r / (r + law.b_px)
        falloff = (law.b_px + np.hypot(along / factor, across * factor)) ** -law.c
        isotropic = (law.b_px + r) ** -law.c
        return _rescaled(optics, falloff, isotropic)


@dataclass(frozen=True)
class OneSidedScatter(Effect):
    """Scatter that is stronger towards one side, similar to coma. It reaches a few tens of pixels. Not in the
    library."""

    angle_deg: float = 0.0
    reach_px: float = 40.0

    name: ClassVar[str] = "one_sided_scatter"
    stage: ClassVar[str] = "optics"
    unit: ClassVar[str] = "share"
    cause: ClassVar[str] = "a mirror is tilted or contaminated on one side"
    nominal: ClassVar[float] = 0.2
    largest: ClassVar[float] = 0.95

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, angle(rng), float(rng.uniform(15, 80)))

    def optics(self, optics: FineOptics, moment: Moment) -> FineOptics:
        if self.strength == 0:
            return optics
        law = optics.law
        along, across = turned_offsets(optics, self.angle_deg)
        r = np.hypot(along, across)
        isotropic = (law.b_px + r) ** -law.c
        lean = along / np.maximum(r, 0.5 / FINE) * np.exp(-r / self.reach_px)
        return _rescaled(optics, isotropic * (1 + self.strength * lean), isotropic)


def _rescaled(optics: FineOptics, falloff: Plane, before: Plane) -> FineOptics:
    """The telescope with another falloff of the scatter; the total of the scatter stays the same. before: the old falloff."""
    amplitude = optics.law.a / FINE**2 * float(before.sum() / falloff.sum())
    return dataclasses.replace(optics, scatter=scaled_scatter(falloff, optics.law, amplitude))


@dataclass(frozen=True)
class WideHalo(Effect):
    """A fraction of the light is in a halo, exponential or Moffat, that is tens to hundreds of pixels wide."""

    scale_px: float = 100.0
    moffat: bool = False

    name: ClassVar[str] = "wide_halo"
    stage: ClassVar[str] = "optics"
    unit: ClassVar[str] = "share of light"
    cause: ClassVar[str] = (
        "particles or a second surface scatter to large distances, besides the roughness of the mirrors"
    )
    nominal: ClassVar[float] = 0.02
    largest: ClassVar[float] = 0.3

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, float(rng.uniform(0.15, 0.5) * plan.size_px), bool(rng.random() < 0.5))

    def optics(self, optics: FineOptics, moment: Moment) -> FineOptics:
        if self.strength == 0:
            return optics
        x, y = optics.offsets_px
        r = np.hypot(x, y)
        if self.moffat:  # half of the light is within 0.88 scale_px
            halo = (1 + (r / self.scale_px) ** 2) ** -2.2 * 1.2 / (np.pi * self.scale_px**2)
        else:
            halo = np.exp(-r / self.scale_px) / (2 * np.pi * self.scale_px**2)
        scatter = (1 - self.strength) * optics.scatter + self.strength * halo / FINE**2
        return dataclasses.replace(optics, scatter=scatter)


@dataclass(frozen=True)
class CoreBlur(Effect):
    """A wider core. A Moffat profile blurs it (defocus, figure errors), or it is spread along a straight line (jitter)."""

    angle_deg: float = 0.0
    jitter: bool = False

    name: ClassVar[str] = "core_blur"
    stage: ClassVar[str] = "optics"
    unit: ClassVar[str] = "px"
    cause: ClassVar[str] = "the telescope is out of focus, or moves during the exposure"
    nominal: ClassVar[float] = 1.0
    largest: ClassVar[float] = 3.0
    power: ClassVar[float] = 1.5

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, angle(rng) % 180, bool(rng.random() < 0.5))

    def optics(self, optics: FineOptics, moment: Moment) -> FineOptics:
        if self.strength == 0:
            return optics
        blur = _line(self.strength, self.angle_deg) if self.jitter else _moffat(self.strength)
        return _blurred(optics, blur)


@dataclass(frozen=True)
class FocusDrift(Effect):
    """Blur by a uniform disc. Its diameter grows from 0 at the first image to `strength` at the last. Not in the library."""

    name: ClassVar[str] = "focus_drift"
    stage: ClassVar[str] = "optics"
    unit: ClassVar[str] = "px at the end"
    cause: ClassVar[str] = "the telescope's structure warms during the transit"
    nominal: ClassVar[float] = 2.0
    largest: ClassVar[float] = 8.0
    power: ClassVar[float] = 1.5
    varies: ClassVar[bool] = True

    def optics(self, optics: FineOptics, moment: Moment) -> FineOptics:
        diameter = self.strength * moment.elapsed
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
    return small_kernel(samples.reshape(n, finer, n, finer).sum(axis=(1, 3)))


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
    return small_kernel(plane)


@dataclass(frozen=True)
class MeshRotation(Effect):
    """The mesh is rotated with respect to its assumed angle."""

    sign: int = 1

    name: ClassVar[str] = "mesh_rotation"
    stage: ClassVar[str] = "optics"
    unit: ClassVar[str] = "degrees"
    cause: ClassVar[str] = "the filter was mounted at another angle"
    nominal: ClassVar[float] = 3.0
    largest: ClassVar[float] = 20.0

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, int(rng.choice([-1, 1])))

    def optics(self, optics: FineOptics, moment: Moment) -> FineOptics:
        if self.strength == 0:
            return optics
        return dataclasses.replace(optics, diffraction=optics.glass.fine(turn_deg=self.sign * self.strength))


@dataclass(frozen=True)
class MeshPitch(Effect):
    """The distances of the mesh orders are larger, or smaller, than assumed."""

    sign: int = 1

    name: ClassVar[str] = "mesh_pitch"
    stage: ClassVar[str] = "optics"
    unit: ClassVar[str] = "share of the spacing"
    cause: ClassVar[str] = "the pitch of the mesh, or the wavelength, differs from the assumed one"
    nominal: ClassVar[float] = 0.05
    largest: ClassVar[float] = 0.3

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, int(rng.choice([-1, 1])))

    def optics(self, optics: FineOptics, moment: Moment) -> FineOptics:
        if self.strength == 0:
            return optics
        kernel = optics.glass.fine(pitch_factor=1 + self.sign * self.strength)
        return dataclasses.replace(optics, diffraction=kernel)


@dataclass(frozen=True)
class FieldDependentScatter(Effect):
    """The total scatter depends on the position of the source in the field.

    The relative change of the total scatter is the sum of a linear and a quadratic term. The linear term is `strength`
    at the edge of the field.
    """

    angle_deg: float = 0.0
    bowl: float = 0.5

    name: ClassVar[str] = "field_dependent_scatter"
    stage: ClassVar[str] = "optics"
    unit: ClassVar[str] = "share of the scatter"
    cause: ClassVar[str] = "light from another field angle meets a rougher part of the mirrors"
    nominal: ClassVar[float] = 0.2
    largest: ClassVar[float] = 0.8

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, angle(rng), float(rng.uniform(-0.6, 0.6)))

    def spread(self, seen: Plane, lit: Plane, optics: FineOptics, moment: Moment) -> Plane:
        if self.strength == 0:
            return seen
        u, v = unit_coordinates((lit.shape[0], lit.shape[1]))
        tilt = 2 * (u * np.cos(np.deg2rad(self.angle_deg)) + v * np.sin(np.deg2rad(self.angle_deg)))
        more = self.strength * (tilt + self.bowl * (4 * (u**2 + v**2) - 2 / 3))
        return np.asarray(seen + optics.more_scatter.apply(more * lit))


@dataclass(frozen=True)
class Ghost(Effect):
    """A faint copy of the image that is displaced, out of focus, slightly rotated and slightly magnified."""

    shift_x: float = 0.1
    shift_y: float = 0.0
    turn_deg: float = 0.0
    magnification: float = 1.0
    blur_px: float = 4.0

    name: ClassVar[str] = "ghost"
    stage: ClassVar[str] = "optics"
    unit: ClassVar[str] = "share of light"
    cause: ClassVar[str] = "light is reflected between the filter and the detector"
    nominal: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.1

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        way, towards = float(rng.uniform(0.08, 0.3)), float(rng.uniform(0, 2 * np.pi))
        return cls(
            strength,
            way * float(np.cos(towards)),
            way * float(np.sin(towards)),
            float(rng.uniform(-3, 3)),
            float(rng.uniform(0.96, 1.04)),
            float(rng.uniform(2, 10)),
        )

    def light(self, seen: Plane, moment: Moment) -> Plane:
        if self.strength == 0:
            return seen
        n = seen.shape[0]
        cos, sin = np.cos(np.deg2rad(self.turn_deg)), np.sin(np.deg2rad(self.turn_deg))
        turn = np.array([[cos, -sin], [sin, cos]]) / self.magnification
        middle = np.array([(n - 1) / 2, (n - 1) / 2])
        shift = n * np.array([self.shift_y, self.shift_x])
        copy = affine_transform(
            gaussian_filter(seen, self.blur_px * FINE, mode="constant"),
            turn,
            middle - turn @ (middle + shift),
            order=1,
        )
        return np.asarray(seen + self.strength / self.magnification**2 * copy)


OPTICS_EFFECTS: tuple[type[Effect], ...] = (
    Ghost,
    AnisotropicScatter,
    FieldDependentScatter,
    WideHalo,
    CoreBlur,
    MeshRotation,
    MeshPitch,
    OneSidedScatter,
    FocusDrift,
)
