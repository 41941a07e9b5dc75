"""Effects of the detector and its electronics: changes of the image by detection and readout."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from scipy.ndimage import distance_transform_edt

from psfcore.gap.effect import Change, Effect, EffectParameter
from psfcore.gap.evidence.unocculted_blocks import spread_blocks, unocculted_blocks
from psfcore.gap.view import Field, View

# The loss of the detector is a smooth function of the counts: a sum of bumps at these counts, Gaussian in the logarithm.
COUNTS_DN = (8, 25, 80, 250, 800, 2500)
COUNTS_WIDTH = math.log(COUNTS_DN[-1] / COUNTS_DN[0]) / (len(COUNTS_DN) - 1) / 1.2
# Decay times, in units of the mean interval between images. Sums of these decays and of a fraction of the previous image
# approximate charge traps.
FADES_IN = {"one_wait": 1, "three_waits": 3}
LEAST_LEFT = 0.01  # a smaller remaining fraction of an earlier image is neglected
DEEP_PX = 9.0  # depth inside a filled area at which the relative error equals the parameter
FINEST = 5  # number of half waves across the field for the finest cosines


def flat(view: View) -> Field:
    """A field of ones."""
    return np.ones(view.solution.transit.shape, np.float32)


def fixed(plane: Field) -> Change:
    """A change that adds the same plane [y, x], DN/s, to every image."""
    return Change(lambda n, images: plane, unocculted=False)


def times_image(pattern: Field) -> Change:
    """A change that adds to every image the image times a pattern [y, x]."""
    return Change(lambda n, images: np.asarray(images[n] * pattern), unocculted=False)


def _dark_offset(view: View) -> Sequence[Change]:
    one = flat(view)
    return [Change(lambda n, images: one / np.float32(view.exposure_s(n)))]


def _gradient(view: View) -> Sequence[Change]:
    x, y = view.places
    return [fixed(plane) for plane in (flat(view), x, y)]


def _gain_mismatch(view: View) -> Sequence[Change]:
    def change(n: int, images: Sequence[Field]) -> Field:
        combined = (view.solution.transit.frames[n].gain_mode or "").lower() == "combined"
        return np.asarray(images[n] * np.float32(combined))

    return [Change(change)]


def _one_gain_mode(view: View) -> str | None:
    modes = sorted({frame.gain_mode or "unknown" for frame in view.solution.transit.frames})
    return None if len(modes) > 1 else f"all images have the same gain mode ({modes[0]})"


def _nonlinearity(view: View) -> Sequence[Change]:
    def change(n: int, images: Sequence[Field], at_dn: float) -> Field:
        counts = np.maximum(images[n] * np.float32(view.exposure_s(n)), np.float32(1.0))
        away = np.log(counts / np.float32(at_dn)) / np.float32(COUNTS_WIDTH)
        return np.asarray(-images[n] * np.exp(-0.5 * away**2))

    return [Change(lambda n, images, at=at: change(n, images, at)) for at in COUNTS_DN]  # type: ignore[misc]


def half_waves() -> list[tuple[int, int]]:
    """The numbers of half waves along x and y, for each cosine of a smooth field. The constant is not included."""
    every = range(FINEST + 1)
    return [(kx, ky) for ky in every for kx in every if 0 < kx * kx + ky * ky <= FINEST * FINEST]


def cosines(view: View) -> list[Field]:
    """The cosines of `half_waves` [y, x], each with rms 1. They are a basis of smooth fields without a slope at the edges."""
    x, y = (np.pi * (place + 0.5) for place in view.places)

    def along(waves: int, at: Field) -> Field:
        return np.asarray(math.sqrt(2.0) * np.cos(waves * at) if waves else np.ones_like(at))

    return [np.asarray(along(kx, x) * along(ky, y), np.float32) for kx, ky in half_waves()]


def cosine_parameters(unit: str, likely: float) -> tuple[EffectParameter, ...]:
    """One parameter for each cosine of `cosines`."""
    return tuple(EffectParameter(f"cos_{kx}x_{ky}y", unit, likely) for kx, ky in half_waves())


def _flat_field(view: View) -> Sequence[Change]:
    return [times_image(cosine) for cosine in cosines(view)]


def _column_smear(view: View) -> Sequence[Change]:
    """Every pixel receives a fraction of the light of the pixels below it, and a fraction of that of the pixels above it.

    The charge of a pixel passes the pixels on one side during the readout, and the pixels on the other side before the
    exposure. If both fractions are equal, the pixel receives a fraction of the mean of its column.
    """

    def passed(n: int, images: Sequence[Field], way: int) -> Field:
        image = images[n][::way]
        summed = np.cumsum(image, axis=0, dtype=np.float32) - image / 2
        return np.asarray(summed[::way] / np.float32(image.shape[0]))

    return [Change(lambda n, images, way=way: passed(n, images, way), unocculted=False) for way in (1, -1)]  # type: ignore[misc]


def _persistence(view: View) -> Sequence[Change]:
    """A fraction of the previous image, and fractions of all earlier images that decay with time, as charge traps empty slowly."""
    frames = view.solution.transit.frames
    waits = [later.time_s - earlier.time_s for earlier, later in pairwise(frames)]
    mean_s = max(float(np.mean(waits)), 1e-9) if waits else 1.0

    def left(n: int, images: Sequence[Field], share: Callable[[int], float]) -> Field:
        out = np.zeros(view.solution.transit.shape, np.float32)
        for k in range(n):
            if (part := share(k)) >= LEAST_LEFT:
                out += images[k] * np.float32(part * view.exposure_s(k) / view.exposure_s(n))
        return out

    def fading(times: int) -> Change:
        def share(n: int, k: int) -> float:
            return math.exp((frames[k].time_s - frames[n].time_s) / (times * mean_s))

        return Change(lambda n, images: left(n, images, lambda k: share(n, k)))

    before = Change(lambda n, images: left(n, images, lambda k: float(k == n - 1)))
    return [before, *(fading(times) for times in FADES_IN.values())]


def _filled(view: View) -> Sequence[Change]:
    """Errors of filled or clipped pixels. Three changes: a constant relative error, a relative error that grows
    inwards, and `_flicker`.

    The second error is zero at the rim of a filled area and grows towards its middle, as for a clipped brightening.
    """
    frames = view.solution.transit.frames
    nothing = np.zeros(view.solution.transit.shape, np.float32)

    def change(n: int, images: Sequence[Field], inside: bool) -> Field:
        filled = frames[n].filled
        if filled is None or not filled.any():
            return nothing
        if not inside:
            return np.asarray(images[n] * filled)
        # The pixels at the rim have a distance of 1 px, and a depth of 0.
        depth = (np.sqrt(distance_transform_edt(filled)) - 1) / (math.sqrt(DEEP_PX) - 1)
        return np.asarray(images[n] * np.maximum(depth, 0.0), dtype=np.float32)

    # In the unocculted field, blocks with a filled pixel are not compared.
    errors = [Change(lambda n, images, k=k: change(n, images, k), unocculted=False) for k in (False, True)]  # type: ignore[misc]
    return [*errors, _flicker(view)]


def _flicker(view: View) -> Change:
    """The change of the Sun in the flickering blocks of the unocculted field. Pixels that are filled are bright, and bright pixels
    often flicker, also those that are not filled.

    The change is measured in the images: the difference from the mean of the pointing.
    """
    compared = unocculted_blocks(view, 0, lambda stage, step, steps: None)
    flickers = (compared.flicker > 1) & compared.free
    shape = view.solution.transit.shape
    nothing = np.zeros(shape, np.float32)
    scale, mean, numbers = np.ones(len(flickers)), np.zeros_like(compared.levels), 0
    for pointing in np.unique(compared.pointing):
        here = compared.pointing == pointing
        usual = np.where(compared.free[here], compared.means[here], 0.0).sum(axis=1)
        scale[here] = np.where(compared.free[here], compared.levels[here], 0.0).sum(axis=1) / np.maximum(
            usual, 1e-9
        )
        images = flickers[here].sum(axis=0)
        steady = np.where(flickers[here], compared.levels[here] / scale[here][:, None], 0.0)
        mean[here] = steady.sum(axis=0) / np.maximum(images, 1)
        numbers += int(np.maximum(images - 1, 0).sum())  # the mean over the images is a part of the scene

    def change(n: int) -> Field:
        differing = np.where(flickers[n], compared.levels[n] / scale[n] - mean[n], 0.0)
        return spread_blocks(differing, shape) if differing.any() else nothing

    return Change(lambda n, images: change(n), disc=False, numbers=numbers)


def _nothing_filled(view: View) -> str | None:
    filled = any(f.filled is not None and f.filled.any() for f in view.solution.transit.frames)
    return None if filled else "no pixel was filled in"


def _p(name: str, unit: str, likely: float, positive: bool = False) -> EffectParameter:
    return EffectParameter(name, unit, likely, positive)


EFFECTS: tuple[Effect, ...] = (
    Effect("dark_offset", "detector", (_p("offset", "DN", 2.0),),
           "The dark level subtracted from every readout is wrong.",
           "a dark exposure, or a series of exposure times at one pointing", ("exposure", "intensity"), _dark_offset),
    Effect("intensity_gradient", "detector",
           (_p("level", "DN/s", 2.0), _p("slope_x", "DN/s/field", 2.0), _p("slope_y", "DN/s/field", 2.0)),
           "A light leak adds a faint plane to every image.", "an exposure with the door closed",
           ("detector_x", "detector_y"), _gradient),
    Effect("gain_mismatch", "detector", (_p("excess", "", 0.05),), "Combined-gain and high-gain images differ in their calibrated gain.",
           "images of the same scene in both gain modes", ("gain_mode", "exposure"), _gain_mismatch, _one_gain_mode),
    Effect("nonlinearity", "detector", tuple(_p(f"loss_at_{dn}_dn", "", 0.05) for dn in COUNTS_DN),
           "The signal of the detector is not proportional to the light: it loses a share that depends on the counts.",
           "a series of exposure times at one pointing", ("intensity",), _nonlinearity),
    Effect("flat_field_residual", "detector", cosine_parameters("", 0.02),
           "The flat field leaves a smooth error of the detector's sensitivity.", "images of the same scene at several positions on the detector",
           ("detector_x", "detector_y"), _flat_field, field=True),
    Effect("column_smear", "detector", (_p("share_below", "", 0.01, True), _p("share_above", "", 0.01, True)),
           "The readout smears charge along the columns.",
           "an exposure with half of the field dark", ("detector_x", "detector_y", "intensity"), _column_smear),
    Effect("persistence", "detector", (_p("share", "", 0.01, True), *(_p(f"share_fading_in_{waits}", "", 0.01, True) for waits in FADES_IN)),
           "A share of each image remains in the following images and decays.",
           "a dark exposure after a bright one", ("time", "pointing"), _persistence),
    Effect("saturation_fill", "detector", (_p("excess", "", 0.1), _p("excess_inside", "", 0.1), _p("flicker", "", 1.0, True)), "The values filled in for saturated pixels are wrong.",
           "a shorter exposure at the same time", ("pointing", "intensity"), _filled, _nothing_filled),
)  # fmt: skip
