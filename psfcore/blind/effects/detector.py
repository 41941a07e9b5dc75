"""Effects of the detector and of its readout: changes of the light that reaches it, of the charge that its pixels collect, and
of the exposure after its photons were detected."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from psfcore.blind.effects.effect import (
    Earlier,
    Effect,
    Kind,
    Moment,
    angle,
    direction,
    seed,
    sign,
    unit_coordinates,
)
from psfcore.blind.effects.fine_optics import FINE
from psfcore.blind.effects.scene import patches
from psfcore.simulate.plan import COMBINED, Plan

Plane = NDArray[np.float64]


def _intensity_gradient(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """Stray light that increases towards one side: a plane with a small curvature. It is 0 in its darkest corner."""
    u, v = unit_coordinates(seen.shape)
    cos, sin = direction(effect["angle_deg"])
    along, across = u * cos + v * sin, v * cos - u * sin
    plane = along + effect["curvature"] * (along**2 - across**2)
    plane = plane - plane.min()
    return seen + effect.strength * plane / plane.mean()


def _glow(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """A glow at a fixed position on the detector."""
    u, v = unit_coordinates(seen.shape)
    r = np.hypot(u + 0.5 - effect["x"], v + 0.5 - effect["y"])
    return seen + effect.strength / (1 + (r / effect["scale"]) ** 2) ** 2


def _draw_glow(plan: Plan, rng: np.random.Generator) -> dict[str, Any]:
    shot = plan.shots[int(rng.integers(len(plan.shots)))]
    x, y = shot.x_px / plan.size_px, shot.y_px / plan.size_px
    dx, dy = rng.normal(0, 0.12, 2)
    return {"x": float(x + dx), "y": float(y + dy), "scale": float(rng.uniform(0.06, 0.15))}


def _dust_shadow(effect: Effect, seen: Plane, moment: Moment) -> Plane:
    """Dust specks with soft edges, near positions of the occulter, block light. specks: x, y (fractions of the field), radius, px."""
    u, v = unit_coordinates(seen.shape)
    passed = np.ones_like(seen)
    for x, y, radius_px in effect["specks"]:
        r_px = np.hypot(u + 0.5 - x, v + 0.5 - y) * seen.shape[0] / FINE
        passed *= 1 - effect.strength / (1 + np.exp(np.minimum((r_px - radius_px) / 0.7, 500.0)))
    return seen * passed


def _draw_dust_shadow(plan: Plan, rng: np.random.Generator) -> dict[str, Any]:
    specks = []
    for index in sorted(rng.choice(len(plan.shots), size=max(1, len(plan.shots) // 5), replace=False)):
        shot = plan.shots[int(index)]
        dx, dy = rng.normal(0, 3.0, 2)
        x, y = float((shot.x_px + dx) / plan.size_px), float((shot.y_px + dy) / plan.size_px)
        specks.append((x, y, float(rng.uniform(4, 9))))
    return {"specks": tuple(specks)}


def _flat_field_residual(effect: Effect, rate: Plane, moment: Moment) -> Plane:
    """Uneven sensitivity: broad patches, whose rms is the strength, and a pixel-to-pixel variation with half this rms."""
    pattern = patches(rate.shape[0], effect["seed"], effect["patch"]) + 0.5 * _grain(
        rate.shape[0], effect["seed"]
    )
    return rate * np.maximum(1 + effect.strength * pattern, 0.0)


@cache
def _grain(size: int, seed: int) -> Plane:
    return np.random.default_rng([seed, 1]).standard_normal((size, size))


def _shutter_gradient(effect: Effect, rate: Plane, moment: Moment) -> Plane:
    """One side of the field is exposed longer than the other. The strength is the difference at the two edges, s."""
    u, v = unit_coordinates(rate.shape)
    cos, sin = direction(effect["angle_deg"])
    return rate * np.maximum(1 + effect.strength * (u * cos + v * sin) / moment.shot.exposure_s, 0.0)


def _dark_current_drift(effect: Effect, rate: Plane, moment: Moment) -> Plane:
    """A dark current that grows during the transit and reaches the strength at its end."""
    return rate + effect.strength * np.expm1(effect["steepness"] * moment.elapsed) / np.expm1(
        effect["steepness"]
    )


def _brighter_fatter(effect: Effect, rate: Plane, moment: Moment) -> Plane:
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


def _dark_offset(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """A constant that remains in every image. It is positive or negative, and varies by 5 % from image to image."""
    own = np.random.default_rng([effect["seed"], moment.index]).normal(1.0, 0.05)
    return dn + effect["sign"] * effect.strength * own


def _gain_mismatch(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """Combined images are too bright or too faint compared with the high-only images."""
    if moment.shot.gain_mode != COMBINED:
        return dn
    # As in the library, this also changes faint pixels, although a combined image takes them from the high-gain image.
    return dn * (1 + effect["sign"] * effect.strength)


def _nonlinearity(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """Faint signals are read too low: by a power law below a knee, or because a trap keeps charge."""
    size, knee_dn = np.abs(dn), effect["knee_dn"]
    if effect["trap"]:
        kept = effect.strength * knee_dn * (1 - np.exp(-size / knee_dn))
        return np.asarray(np.sign(dn) * (size - kept))
    # Below the knee the signal is raised to the power 1 + p. The strength is the fraction lost at 1/20 of the knee.
    power = -np.log1p(-effect.strength) / np.log(20)
    return np.asarray(dn * np.minimum(np.maximum(size, 1e-3) / knee_dn, 1.0) ** power)


def _column_smear(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """Every pixel gets a fraction of the mean of its column, and of the pixels that its charge passes during the readout."""
    passed = 2 * np.cumsum(dn, axis=0) / dn.shape[0]
    smear = (1 - effect["passed"]) * dn.mean(axis=0)[None, :] + effect["passed"] * passed
    return np.asarray(dn + effect.strength * smear)


def _persistence(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """An image contains a fraction of the four preceding images, of any pointing. The fraction decays with time."""
    left = np.zeros_like(dn)
    for image in earlier[-4:]:
        left += np.exp(-(moment.shot.time_s - image.time_s) / effect["decay_s"]) * image.dn
    return dn + effect.strength * left


def _draw_persistence(plan: Plan, rng: np.random.Generator) -> dict[str, Any]:
    cadence = (plan.shots[-1].time_s - plan.shots[0].time_s) / max(len(plan.shots) - 1, 1)
    return {"decay_s": float(cadence * rng.uniform(0.5, 2.0))}


def _row_crosstalk(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """Bright pixels cause an echo in their row, at a fixed distance and a few pixels wide."""
    bright = np.maximum(dn - effect["above"] * max(float(dn.mean()), 0.0), 0.0)
    late = uniform_filter1d(bright, 5, axis=1, mode="constant")
    shift = round(effect["lag"] * dn.shape[1])
    echo = np.zeros_like(dn)
    if shift >= 0:
        echo[:, shift:] = late[:, : dn.shape[1] - shift]
    else:
        echo[:, :shift] = late[:, -shift:]
    return dn + effect.strength * echo


def _stripes(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """A periodic pattern that is the same in all images. Its period is longer than the disc."""
    y, x = np.mgrid[: dn.shape[0], : dn.shape[1]]
    cos, sin = direction(effect["angle_deg"])
    wave = np.sin(2 * np.pi * (x * cos + y * sin) / effect["period_px"] + np.deg2rad(effect["phase_deg"]))
    return np.asarray(dn + effect.strength * (wave + 0.3 * wave**3))


def _draw_stripes(plan: Plan, rng: np.random.Generator) -> dict[str, Any]:
    across = float(rng.choice([0.0, 90.0])) + float(rng.normal(0, 5))
    return {"period_px": float(rng.uniform(25, 90)), "angle_deg": across, "phase_deg": angle(rng)}


def _faint_rounding(effect: Effect, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
    """Values are truncated towards zero, to steps that grow as the square root of the signal.

    The strength is the step divided by sqrt(6 signal), which is the photon noise for a gain of 6 DN.
    """
    # Steps of q in sqrt(|D|) are steps of 2 q sqrt(|D|) in D.
    q = effect.strength * np.sqrt(6.0) / 2
    return np.asarray(np.sign(dn) * (q * np.floor(np.sqrt(np.abs(dn)) / q)) ** 2)


DETECTOR_EFFECTS = (
    Kind(
        "intensity_gradient",
        "detector",
        "DN/s at its mean",
        "sunlight passes the baffles",
        nominal=0.5,
        largest=20.0,
        draw=lambda plan, rng: {"angle_deg": angle(rng), "curvature": float(rng.uniform(-0.4, 0.4))},
        light=_intensity_gradient,
    ),
    Kind(
        "glow",
        "detector",
        "DN/s at its brightest",
        "an amplifier beside the pixels emits light",
        nominal=5.0,
        largest=400.0,
        draw=_draw_glow,
        light=_glow,
    ),
    Kind(
        "dust_shadow",
        "detector",
        "share of light blocked",
        "dust settled on the detector after the flat field was taken",
        nominal=0.1,
        largest=0.9,
        draw=_draw_dust_shadow,
        light=_dust_shadow,
    ),
    Kind(
        "flat_field_residual",
        "detector",
        "share, rms",
        "the flat field was taken long ago",
        nominal=0.03,
        largest=0.3,
        draw=lambda plan, rng: {"seed": seed(rng), "patch": float(rng.uniform(0.05, 0.25))},
        expected=_flat_field_residual,
    ),
    Kind(
        "shutter_gradient",
        "detector",
        "s",
        "the shutter moves unevenly",
        nominal=0.05,
        largest=0.6,
        draw=lambda plan, rng: {"angle_deg": angle(rng)},
        expected=_shutter_gradient,
    ),
    Kind(
        "dark_current_drift",
        "detector",
        "DN/s at the end",
        "the detector warms",
        nominal=1.0,
        largest=30.0,
        draw=lambda plan, rng: {"steepness": float(rng.uniform(0.5, 3))},
        expected=_dark_current_drift,
    ),
    Kind(
        "brighter_fatter",
        "detector",
        "per 1000 DN",
        "the electric field of the collected charge repels new charge",
        nominal=0.02,
        largest=0.15,
        expected=_brighter_fatter,
    ),
    Kind(
        "dark_offset",
        "detector",
        "DN",
        "the subtracted bias was measured on another day",
        nominal=1.0,
        largest=12.0,
        draw=lambda plan, rng: {"sign": sign(rng), "seed": seed(rng)},
        read_out=_dark_offset,
    ),
    Kind(
        "gain_mismatch",
        "detector",
        "share",
        "the ratio of the two gains differs from the assumed ratio",
        nominal=0.1,
        largest=0.25,
        draw=lambda plan, rng: {"sign": sign(rng)},
        read_out=_gain_mismatch,
    ),
    Kind(
        "nonlinearity",
        "detector",
        "share lost at the faint end",
        "traps keep the first charges, or the amplifier is nonlinear near zero",
        nominal=0.1,
        largest=0.6,
        noise_realisations=12,
        draw=lambda plan, rng: {"knee_dn": float(rng.uniform(30, 150)), "trap": bool(rng.random() < 0.5)},
        read_out=_nonlinearity,
    ),
    Kind(
        "column_smear",
        "detector",
        "share of the column's mean",
        "columns are exposed while they are read out",
        nominal=0.005,
        largest=0.1,
        draw=lambda plan, rng: {"passed": float(rng.uniform(0, 0.5))},
        read_out=_column_smear,
    ),
    Kind(
        "persistence",
        "detector",
        "share at time 0",
        "traps release charge of earlier exposures",
        nominal=0.01,
        largest=0.3,
        draw=_draw_persistence,
        read_out=_persistence,
    ),
    Kind(
        "row_crosstalk",
        "detector",
        "share",
        "electrical crosstalk between the channels of the readout",
        nominal=0.01,
        largest=0.3,
        draw=lambda plan, rng: {
            "lag": float(rng.uniform(-0.35, 0.35)),
            "above": float(rng.uniform(0.2, 1.0)),
        },
        read_out=_row_crosstalk,
    ),
    Kind(
        "stripes",
        "detector",
        "DN",
        "a ripple of the power supply, in phase with the readout",
        nominal=2.0,
        largest=40.0,
        draw=_draw_stripes,
        read_out=_stripes,
    ),
    Kind(
        "faint_rounding",
        "detector",
        "share of the noise",
        "the compression on board truncates values instead of rounding them",
        nominal=0.3,
        largest=3.0,
        noise_realisations=12,
        read_out=_faint_rounding,
    ),
)
