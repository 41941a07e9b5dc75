"""Measure the noise of the images, to check the noise that the transit states.

Two consecutive images of one pointing show the same scene. Let d be the difference of these images, and d_00 to d_11
its values in a square of 2 x 2 px. The mixed second difference

    h = (d_00 - d_01 - d_10 + d_11) / 2          Eq. (1)

removes everything smooth. If the noise of the pixels is independent, h has the same variance as d. Blocks of h give the
variance as a function of the level D (DN). The line g D + r^2 is fitted to them, with the photon gain g and the read
noise r (`psfcore.noise`, Eq. (1)).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from psfcore.arrays import Vector, squares
from psfcore.noise import Noise
from psfcore.transit.transit import Frame, Transit

BLOCK = 16  # edge of a block of h, in values of h: there is one value for 2 x 2 px of the image
FREE_OF_DISC_PX = 20.0
NORMAL_MAD = 1.4826
LEAST_BLOCKS = 20
ROUNDS = 5
TRUSTED = 0.15  # the stated noise is used if the ratio of variances differs from 1 by at most this amount


@dataclass(frozen=True)
class MeasuredNoise:
    """The noise that the images show.

    Attributes
    ----------
    noise
        Photon gain and read noise from the fitted line.
    ratio
        Measured variance divided by stated variance, the median over all blocks.
    """

    noise: Noise
    ratio: float

    @property
    def agrees(self) -> bool:
        """Whether the measurement confirms the stated noise."""
        return abs(self.ratio - 1) <= TRUSTED


def measured_noise(transit: Transit) -> MeasuredNoise | None:
    """Measure the noise of a transit. None if too few consecutive images show the same scene, or if no line can be
    fitted.
    """
    seen = [
        np.array(_blocks(one, other))
        for one, other in itertools.pairwise(transit.frames)
        if (one.pointing, one.gain_mode, one.exposure_s)
        == (other.pointing, other.gain_mode, other.exposure_s)
    ]
    level, variance = np.concatenate([np.zeros((2, 0)), *seen], axis=1)
    if level.size < LEAST_BLOCKS:
        return None
    stated = transit.noise.photon_gain_dn * np.maximum(level, 0) + transit.noise.read_noise_dn**2
    ratio = float(np.median(variance / stated))
    gain, read_variance = _line(level, variance)
    if gain <= 0 and read_variance <= 0:
        return None
    return MeasuredNoise(Noise(max(gain, 0.0), math.sqrt(max(read_variance, 0.0))), ratio)


def _blocks(one: Frame, other: Frame) -> tuple[Vector, Vector]:
    """Level (DN) and variance (DN^2) of one exposure, for each block away from both discs: two arrays (blocks,)."""
    a, b = (frame.pixels.astype(np.float64) * frame.exposure_s for frame in (one, other))
    difference = a - b * (a.mean() / b.mean())
    quads = squares(difference, 2)
    h = (quads[:, 0, :, 0] - quads[:, 0, :, 1] - quads[:, 1, :, 0] + quads[:, 1, :, 1]) / 2  # Eq. (1)
    rows, columns = (n // BLOCK for n in h.shape)
    h, level = (squares(p, BLOCK) for p in (h, squares((a + b) / 2, 2).mean(axis=(1, 3))))
    spread = NORMAL_MAD * np.median(np.abs(h), axis=(1, 3))
    y, x = ((np.arange(n) * 2 + 1) * BLOCK for n in (rows, columns))
    away = np.ones((rows, columns), dtype=bool)
    for frame in (one, other):
        reach = frame.place.radius_px + FREE_OF_DISC_PX
        away &= np.maximum(np.abs(y[:, None] - frame.place.y_px), np.abs(x - frame.place.x_px)) > reach
        if frame.filled is not None:
            away &= ~squares(frame.filled, 2 * BLOCK).any(axis=(1, 3))
    return level.mean(axis=(1, 3))[away], (spread**2 / 2)[away]


def _line(level: Vector, variance: Vector) -> tuple[float, float]:
    """Fit a straight line to the variance as a function of the level; return its slope and intercept. The weight of a
    block is 1 / (expected variance)^2.
    """
    expected = np.full(level.shape, float(np.median(variance)))
    slope = intercept = 0.0
    for _ in range(ROUNDS):
        weight = 1 / np.maximum(expected, 1e-12) ** 2
        mean_x, mean_y = (float((weight * v).sum() / weight.sum()) for v in (level, variance))
        spread = float((weight * (level - mean_x) ** 2).sum())
        slope = max(float((weight * (level - mean_x) * variance).sum()) / spread if spread > 0 else 0.0, 0.0)
        intercept = max(mean_y - slope * mean_x, 0.0)
        expected = np.maximum(slope * level + intercept, 0.1 * float(np.median(variance)))
    return slope, intercept
