"""Noise amplification of a linear method, computed frequency by frequency.

Consider a method x <- x + G (y - H x) that starts from x_0 = y. T is the PSF's Fourier transform at one frequency.
After n steps, the method has multiplied the amplitude of the image at this frequency by

    A_n = A_(n-1) + G (1 - T A_(n-1)),   A_0 = 1        Eq. (1)

The method multiplies the rms of uncorrelated noise by the root of the mean of abs(A)^2 over all frequencies. This
factor holds away from edges and masked pixels. T varies smoothly from frequency to frequency. Therefore only every k-th
frequency along y is used; k is 2, 3, 4 or 8, depending on the length of the transform.

| symbol | name |
|---|---|
| T | transfer |
| G | step: 1, or an inverse of T |
| A | gain |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.engine import Engine
from psfcore.convolution.fft_kernels import LANES
from psfcore.errors import DataError

LARGEST_GROWTH = 10.0


@dataclass(frozen=True, eq=False)
class TransferSample:
    """Values of T at some frequencies (float64 or complex128) and the weights of these frequencies, which sum to 1."""

    values: NDArray[np.floating] | NDArray[np.complexfloating]
    weights: NDArray[np.float64]


def transfer_sample(engine: Engine) -> TransferSample:
    """A sample of an engine's transfer function: along y, every k-th frequency (k: first radix of its transform)."""
    rows = engine.column_plan.length // int(engine.column_plan.radices[0])
    lanes = engine.transfer[:, :rows].astype(np.float64) * engine.transfer_scale
    values = lanes[:, :, 0] if engine.symmetric else lanes[:, :, 0] + 1j * lanes[:, :, 1]
    # Frequencies along x run from 0 to L / 2. Except the first and last, each also represents its negative.
    k, half = np.arange(engine.column_blocks * LANES), engine.row_plan.length // 2
    times = np.where((k == 0) | (k == half), 1.0, np.where(k < half, 2.0, 0.0))
    weights = np.broadcast_to(times.reshape(-1, 1, LANES), values.shape)
    used = weights > 0
    return TransferSample(values[used], weights[used] / weights[used].sum())


def noise_amplification(
    sample: TransferSample, step: NDArray[np.floating] | NDArray[np.complexfloating], steps: int
) -> float:
    """Rms noise of the estimate after `steps` steps, divided by the rms noise of the image. step: G of Eq. (1)."""
    # The closed form A_n = (1 - (1 - G T)^n (1 - T)) / T fails for T near 0.
    gain = np.ones_like(sample.values)
    for _ in range(steps):
        gain = gain + step * (1 - sample.values * gain)  # Eq. (1)
    return float(np.sqrt(np.sum(sample.weights * np.abs(gain) ** 2)))


def check_converges(sample: TransferSample, steps: int) -> None:
    """Raise DataError "method-diverges" if `steps` steps with G = 1 can increase an error by more than
    LARGEST_GROWTH."""
    worst = float(np.abs(1 - sample.values).max())
    if worst > 1 and steps * np.log(worst) > np.log(LARGEST_GROWTH):
        advice = "use richardson-lucy or linear, or fewer steps"
        raise DataError(
            "method-diverges",
            "expected a PSF whose Fourier transform T has abs(1 - T) <= 1 at all frequencies; got up to "
            f"{worst:.3g}, and each of the {steps} steps multiplies an error by this number: {advice}",
        )
