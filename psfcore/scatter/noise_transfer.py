"""Propagate the noise of all pixels of a frame into the residuals of its dark pixels.

A frame y = H x + n has fully dark pixels D. G is the inverse of H. The scene is estimated as G y, and its fully dark
pixels are set to 0. The residual in the disc is then r = D [y - H (1 - D) G y]. The sum of the residual weighted by a
template t is

    t . r = b . n + (t . r without noise),   b = t - G^T (1 - D) H^T t                Eq. (1)
    cov(t_1 . r, t_2 . r) = sum over all pixels of b_1 b_2 var(n)                     Eq. (2)

The first term of b describes the noise of the disc's pixels. The second term describes the noise of the estimated scene,
which the model scatters into the disc.

| symbol | name | unit |
|---|---|---|
| t | template: a weight for each dark pixel | - |
| n | photon and read noise | DN/s |
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from psfcore.noise import Noise
from psfcore.scatter.optics import Optics, Pixels, put
from psfcore.transit.transit import Frame

Vector = NDArray[np.float64]


def noise_covariance(
    optics: Optics, frame: Frame, dark: Pixels, templates: Sequence[Vector], noise: Noise
) -> NDArray[np.float64]:
    """Eq. (2): covariance (templates, templates) of the weighted sums over the dark pixels, in (DN/s)^2."""
    spread = []
    for template in templates:
        here = np.zeros(optics.engine.lanes_shape, np.float32)
        put(here, dark, template)
        scattered = optics.correlate(here)
        put(scattered, dark, 0.0)
        here -= optics.invert_once(scattered, adjoint=True)  # Eq. (1)
        spread.append(optics.field(here).ravel())
    b = np.array(spread, dtype=np.float32)
    # The variance is a linear function of the expected pixel value. The observed value can replace the expected value
    # here, because the noise of the observed values averages out in the sum over the pixels.
    variance = noise.variance(frame.pixels.astype(np.float64), frame.exposure_s).ravel()
    return np.asarray((b * variance.astype(np.float32)) @ b.T, dtype=np.float64)  # Eq. (2)
