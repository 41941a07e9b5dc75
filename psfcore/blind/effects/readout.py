"""Effects of the readout: changes of an exposure after its photons were detected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from psfcore.blind.effects.effect import Earlier, Effect, Moment, angle
from psfcore.simulate.plan import COMBINED, Plan

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class DarkOffset(Effect):
    """A constant that remains in every image. It is positive or negative, and varies by 5 % from image to image."""

    sign: int = 1
    seed: int = 0

    name: ClassVar[str] = "dark_offset"
    unit: ClassVar[str] = "DN"
    cause: ClassVar[str] = "the subtracted bias was measured on another day"
    nominal: ClassVar[float] = 1.0
    largest: ClassVar[float] = 12.0

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, int(rng.choice([-1, 1])), int(rng.integers(2**31)))

    def read_out(self, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
        own = np.random.default_rng([self.seed, moment.index]).normal(1.0, 0.05)
        return dn + self.sign * self.strength * own


@dataclass(frozen=True)
class GainMismatch(Effect):
    """Combined images are too bright or too faint compared with the high-only images."""

    sign: int = 1

    name: ClassVar[str] = "gain_mismatch"
    unit: ClassVar[str] = "share"
    cause: ClassVar[str] = "the ratio of the two gains differs from the assumed ratio"
    nominal: ClassVar[float] = 0.1
    largest: ClassVar[float] = 0.25

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, int(rng.choice([-1, 1])))

    def read_out(self, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
        if moment.shot.gain_mode != COMBINED:
            return dn
        # As in the library, this also changes faint pixels, although a combined image takes them from the high-gain image.
        return dn * (1 + self.sign * self.strength)


@dataclass(frozen=True)
class Nonlinearity(Effect):
    """Faint signals are read too low: by a power law below a knee, or because a trap keeps charge."""

    knee_dn: float = 60.0
    trap: bool = False

    name: ClassVar[str] = "nonlinearity"
    unit: ClassVar[str] = "share lost at the faint end"
    cause: ClassVar[str] = "traps keep the first charges, or the amplifier is nonlinear near zero"
    nominal: ClassVar[float] = 0.1
    largest: ClassVar[float] = 0.6
    noise_realisations: ClassVar[int] = 12

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, float(rng.uniform(30, 150)), bool(rng.random() < 0.5))

    def read_out(self, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
        if self.strength == 0:
            return dn
        size = np.abs(dn)
        if self.trap:
            kept = self.strength * self.knee_dn * (1 - np.exp(-size / self.knee_dn))
            return np.asarray(np.sign(dn) * (size - kept))
        # Below the knee the signal is raised to the power 1 + p. The strength is the fraction lost at 1/20 of the knee.
        power = -np.log1p(-self.strength) / np.log(20)
        return np.asarray(dn * np.minimum(np.maximum(size, 1e-3) / self.knee_dn, 1.0) ** power)


@dataclass(frozen=True)
class ColumnSmear(Effect):
    """Every pixel gets a fraction of the mean of its column, and of the pixels that its charge passes during the
    readout."""

    passed: float = 0.5

    name: ClassVar[str] = "column_smear"
    unit: ClassVar[str] = "share of the column's mean"
    cause: ClassVar[str] = "columns are exposed while they are read out"
    nominal: ClassVar[float] = 0.005
    largest: ClassVar[float] = 0.1

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, float(rng.uniform(0, 0.5)))

    def read_out(self, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
        passed = 2 * np.cumsum(dn, axis=0) / dn.shape[0]
        smear = (1 - self.passed) * dn.mean(axis=0)[None, :] + self.passed * passed
        return np.asarray(dn + self.strength * smear)


@dataclass(frozen=True)
class Persistence(Effect):
    """An image contains a fraction of the four preceding images, of any pointing. The fraction decays with time."""

    decay_s: float = 300.0

    name: ClassVar[str] = "persistence"
    unit: ClassVar[str] = "share at time 0"
    cause: ClassVar[str] = "traps release charge of earlier exposures"
    nominal: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.3

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        cadence = (plan.shots[-1].time_s - plan.shots[0].time_s) / max(len(plan.shots) - 1, 1)
        return cls(strength, float(cadence * rng.uniform(0.5, 2.0)))

    def read_out(self, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
        left = np.zeros_like(dn)
        for image in earlier[-4:]:
            left += np.exp(-(moment.shot.time_s - image.time_s) / self.decay_s) * image.dn
        return dn + self.strength * left


@dataclass(frozen=True)
class RowCrosstalk(Effect):
    """Bright pixels cause an echo in their row, at a fixed distance and a few pixels wide. Not in the library."""

    lag: float = 0.2
    above: float = 0.5

    name: ClassVar[str] = "row_crosstalk"
    unit: ClassVar[str] = "share"
    cause: ClassVar[str] = "electrical crosstalk between the channels of the readout"
    nominal: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.3

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, float(rng.uniform(-0.35, 0.35)), float(rng.uniform(0.2, 1.0)))

    def read_out(self, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
        bright = np.maximum(dn - self.above * max(float(dn.mean()), 0.0), 0.0)
        late = uniform_filter1d(bright, 5, axis=1, mode="constant")
        shift = round(self.lag * dn.shape[1])
        echo = np.zeros_like(dn)
        if shift >= 0:
            echo[:, shift:] = late[:, : dn.shape[1] - shift]
        else:
            echo[:, :shift] = late[:, -shift:]
        return dn + self.strength * echo


@dataclass(frozen=True)
class Stripes(Effect):
    """A periodic pattern that is the same in all images. Its period is longer than the disc. Not in the library."""

    period_px: float = 60.0
    angle_deg: float = 0.0
    phase_deg: float = 0.0

    name: ClassVar[str] = "stripes"
    unit: ClassVar[str] = "DN"
    cause: ClassVar[str] = "a ripple of the power supply, in phase with the readout"
    nominal: ClassVar[float] = 2.0
    largest: ClassVar[float] = 40.0

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        across = float(rng.choice([0.0, 90.0])) + float(rng.normal(0, 5))
        return cls(strength, float(rng.uniform(25, 90)), across, angle(rng))

    def read_out(self, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
        y, x = np.mgrid[: dn.shape[0], : dn.shape[1]]
        along = x * np.cos(np.deg2rad(self.angle_deg)) + y * np.sin(np.deg2rad(self.angle_deg))
        wave = np.sin(2 * np.pi * along / self.period_px + np.deg2rad(self.phase_deg))
        return np.asarray(dn + self.strength * (wave + 0.3 * wave**3))


@dataclass(frozen=True)
class FaintRounding(Effect):
    """Values are truncated towards zero, to steps that grow as the square root of the signal. Not in the library.

    strength: the step divided by sqrt(6 signal), which is the photon noise for a gain of 6 DN.
    """

    name: ClassVar[str] = "faint_rounding"
    unit: ClassVar[str] = "share of the noise"
    cause: ClassVar[str] = "the compression on board truncates values instead of rounding them"
    nominal: ClassVar[float] = 0.3
    largest: ClassVar[float] = 3.0
    noise_realisations: ClassVar[int] = 12

    def read_out(self, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
        if self.strength == 0:
            return dn
        # Steps of q in sqrt(|D|) are steps of 2 q sqrt(|D|) in D.
        q = self.strength * np.sqrt(6.0) / 2
        return np.asarray(np.sign(dn) * (q * np.floor(np.sqrt(np.abs(dn)) / q)) ** 2)


READOUT_EFFECTS: tuple[type[Effect], ...] = (
    DarkOffset,
    GainMismatch,
    Nonlinearity,
    ColumnSmear,
    Persistence,
    RowCrosstalk,
    Stripes,
    FaintRounding,
)
