"""Effects of the detector and its electronics: changes of the image by detection and readout."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy.ndimage import distance_transform_edt

from psfcore.gap.effect import Change, Effect
from psfcore.gap.effect import EffectParameter as Parameter
from psfcore.gap.view import Field, View

# Decay levels of losses, DN. Their sum approximates any loss that falls off smoothly with the counts, also that of charge traps.
FAINT_DN = (10.0, 40.0, 160.0, 640.0, 2560.0)
# Decay times, in units of the mean interval between images. Sums of these decays and of a fraction of the previous image
# approximate charge traps.
FADES_IN = {"one_wait": 1, "three_waits": 3}
LEAST_LEFT = 0.01  # a smaller remaining fraction of an earlier image is neglected
DEEP_PX = 9.0  # depth inside a filled area at which the relative error equals the parameter
FINEST = 5  # number of half waves across the field for the finest cosines


def _dark_offset(view: View) -> Sequence[Change]:
    one = np.ones(view.solution.transit.shape, np.float32)
    return [Change(lambda n, images: one / np.float32(view.exposure_s(n)))]


def _gradient(view: View) -> Sequence[Change]:
    x, y = view.places
    planes = (np.ones_like(x), x, y)
    return [Change(lambda n, images, plane=plane: plane, unocculted=False) for plane in planes]  # type: ignore[misc]


def _gain_mismatch(view: View) -> Sequence[Change]:
    modes = [(frame.gain_mode or "").lower() for frame in view.solution.transit.frames]
    return [Change(lambda n, images: np.asarray(images[n] * np.float32(modes[n] == "combined")))]


def _one_gain_mode(view: View) -> str | None:
    modes = sorted({frame.gain_mode or "unknown" for frame in view.solution.transit.frames})
    return None if len(modes) > 1 else f"all images have the same gain mode ({modes[0]})"


def _nonlinearity(view: View) -> Sequence[Change]:
    def loss(n: int, images: Sequence[Field], faint_dn: float) -> Field:
        counts = np.maximum(images[n] * np.float32(view.exposure_s(n)), 0)
        return np.asarray(-images[n] * np.exp(-counts / np.float32(faint_dn)))

    return [Change(partial(loss, faint_dn=faint_dn)) for faint_dn in FAINT_DN]


def _half_waves() -> list[tuple[int, int]]:
    """The numbers of half waves along x and y, for each cosine of a smooth field. The constant is not included."""
    every = range(FINEST + 1)
    return [(kx, ky) for ky in every for kx in every if 0 < kx * kx + ky * ky <= FINEST * FINEST]


def _flat_field(view: View) -> Sequence[Change]:
    """Each image times each cosine of `_half_waves`. They are a basis of smooth fields without a slope at the edges; rms 1."""
    x, y = (np.pi * (place + 0.5) for place in view.places)

    def along(waves: int, at: Field) -> Field:
        return np.asarray(math.sqrt(2.0) * np.cos(waves * at) if waves else np.ones_like(at))

    def error(n: int, images: Sequence[Field], cosine: Field) -> Field:
        return np.asarray(images[n] * cosine)

    cosines = (np.asarray(along(kx, x) * along(ky, y), np.float32) for kx, ky in _half_waves())
    return [Change(partial(error, cosine=cosine), unocculted=False) for cosine in cosines]


def _column_smear(view: View) -> Sequence[Change]:
    """Every pixel receives a fraction of the light of the pixels below it, and a fraction of that of the pixels above it.

    The charge of a pixel passes the pixels on one side during the readout, and the pixels on the other side before the
    exposure. If both fractions are equal, the pixel receives a fraction of the mean of its column.
    """

    def light(n: int, images: Sequence[Field], way: int) -> Field:
        image = images[n][::way]
        summed = np.cumsum(image, axis=0, dtype=np.float32) - image / 2
        return np.asarray(summed[::way] / np.float32(image.shape[0]))

    return [Change(partial(light, way=way), unocculted=False) for way in (1, -1)]


def _persistence(view: View) -> Sequence[Change]:
    """A fraction of the previous image, and fractions of all earlier images that decay with time, as charge traps empty slowly."""
    frames = view.solution.transit.frames
    mean_s = max((frames[-1].time_s - frames[0].time_s) / max(len(frames) - 1, 1), 1e-9)

    def light(n: int, images: Sequence[Field], waits: int | None) -> Field:
        out = np.zeros(view.solution.transit.shape, np.float32)
        for k in range(n):
            share = float(k == n - 1)
            if waits is not None:
                share = math.exp((frames[k].time_s - frames[n].time_s) / (waits * mean_s))
            if share >= LEAST_LEFT:
                out += images[k] * np.float32(share * view.exposure_s(k) / view.exposure_s(n))
        return out

    return [Change(partial(light, waits=waits)) for waits in (None, *FADES_IN.values())]


def _filled(view: View) -> Sequence[Change]:
    """Errors of filled or clipped pixels. Two changes: a constant relative error, and a relative error that grows inwards.

    The second error is zero at the rim of a filled area and grows towards its middle, as for a clipped brightening.
    """
    frames = view.solution.transit.frames
    nothing = np.zeros(view.solution.transit.shape, np.float32)

    def error(n: int, images: Sequence[Field], inside: bool) -> Field:
        filled = frames[n].filled
        if filled is None or not filled.any():
            return nothing
        if not inside:
            return np.asarray(images[n] * filled)
        # The pixels at the rim have a distance of 1 px, and a depth of 0.
        depth = (np.sqrt(distance_transform_edt(filled)) - 1) / (math.sqrt(DEEP_PX) - 1)
        return np.asarray(images[n] * np.maximum(depth, 0.0), dtype=np.float32)

    # In the unocculted field, blocks with a filled pixel are not compared.
    return [Change(partial(error, inside=inside), unocculted=False) for inside in (False, True)]


def _nothing_filled(view: View) -> str | None:
    filled = any(f.filled is not None and f.filled.any() for f in view.solution.transit.frames)
    return None if filled else "no pixel was filled in"


EFFECTS: tuple[Effect, ...] = (
    Effect("dark_offset", "detector", (Parameter("offset", "DN", 2.0),),
           "The dark level subtracted from every readout is wrong.",
           "a dark exposure, or a series of exposure times at one pointing", ("exposure", "intensity"), _dark_offset, family="offset_place"),
    Effect("intensity_gradient", "detector",
           (Parameter("level", "DN/s", 2.0), Parameter("slope_x", "DN/s/field", 2.0), Parameter("slope_y", "DN/s/field", 2.0)),
           "A light leak adds a faint plane to every image.", "an exposure with the door closed",
           ("detector_x", "detector_y"), _gradient, family="light_place"),
    Effect("gain_mismatch", "detector", (Parameter("excess", "", 0.05),), "Combined-gain and high-gain images differ in their calibrated gain.",
           "images of the same scene in both gain modes", ("gain_mode", "exposure"), _gain_mismatch, _one_gain_mode, family="gain_kind"),
    Effect("nonlinearity", "detector", tuple(Parameter(f"loss_{level:g}_dn", "", 0.05) for level in FAINT_DN), "The detector reads faint signals too low.",
           "a series of exposure times at one pointing", ("intensity",), _nonlinearity, family="response"),
    Effect("flat_field_residual", "detector", tuple(Parameter(f"cos_{kx}x_{ky}y", "", 0.02) for kx, ky in _half_waves()),
           "The flat field leaves a smooth error of the detector's sensitivity.", "images of the same scene at several positions on the detector",
           ("detector_x", "detector_y"), _flat_field, field=True, family="gain_place"),
    Effect("column_smear", "detector", (Parameter("share_below", "", 0.01, True), Parameter("share_above", "", 0.01, True)),
           "The readout smears charge along the columns.",
           "an exposure with half of the field dark", ("detector_x", "detector_y", "intensity"), _column_smear, family="memory"),
    Effect("persistence", "detector", (Parameter("share", "", 0.01, True), *(Parameter(f"share_fading_in_{waits}", "", 0.01, True) for waits in FADES_IN)),
           "A share of each image remains in the following images and decays.",
           "a dark exposure after a bright one", ("time", "pointing"), _persistence, family="memory"),
    Effect("saturation_fill", "detector", (Parameter("excess", "", 0.1), Parameter("excess_inside", "", 0.1)), "The values filled in for saturated pixels are wrong.",
           "a shorter exposure at the same time", ("pointing", "intensity"), _filled, _nothing_filled, family="response"),
)  # fmt: skip
