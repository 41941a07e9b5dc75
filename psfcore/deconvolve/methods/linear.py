"""Linear deconvolution by an approximate inverse of the PSF.

    x <- x + G w (y - H x),   x_0 = y,   G = T* / max(abs(T)^2, t^2)      Eq. (1)

H is the convolution with the PSF, cut to the field. T is the PSF's Fourier transform on the padded, periodic plane.
Where abs(T) is at least t (LEAST_TRANSFER), G = 1 / T, which inverts H except for light that crosses the edge of the
field; a few steps correct for this light. Where abs(T) is below t, Eq. (1) is a Landweber step: frequencies at which
the PSF has little power are restored slowly, and the noise at these frequencies is amplified slowly.

The method does not force the scene to be positive, so faint pixels have no bias. For one PSF, the method amplifies the
noise of every image by the same factor, `noise_amplification` (2 to 2.4 for HRI_EUV). Negative pixels are used
unchanged, and the result may be negative. A masked pixel (w = 0) does not influence the fit; its estimate follows from
its neighbours.

| symbol | name | unit |
|---|---|---|
| y | observed | image unit |
| x | estimate | image unit |
| w | trusted, 1 or 0 | - |
| G | inverse | - |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.engine import Engine
from psfcore.deconvolve.additive import Additive, noise_amplification, transfer_sample
from psfcore.deconvolve.conditions import Conditions, Deconvolved
from psfcore.deconvolve.edges import Edges
from psfcore.deconvolve.problem import pose
from psfcore.deconvolve.stopping import Stop
from psfcore.image import Image
from psfcore.psf import Psf

METHOD = "linear"
EDGES: Edges = "symmetric"
MAY_BE_NEGATIVE = True
MARGIN_SHARE = 0.015
LEAST_TRANSFER = 0.1


def deconvolve(
    image: Image, psf: Psf, conditions: Conditions, *, steps: int = 5, stop: Stop = "fixed"
) -> Deconvolved:
    """Estimate the scene from `image` [y, x], which was observed with `psf`. The first estimate is the observation.

    The result may be negative. It is NaN where the image is not finite. Raises the same errors as `problem.pose`.
    """
    problem = pose(image, psf, conditions, edges=EDGES, margin_share=MARGIN_SHARE, steps=steps, stop=stop)
    result = problem.solve(
        Additive(problem, inverse_filter(problem.engine)), method=METHOD, steps=steps, stop=stop
    )
    sample = transfer_sample(problem.engine)
    g = np.conj(sample.values) / np.maximum(np.abs(sample.values) ** 2, LEAST_TRANSFER**2)
    return replace(result, noise_amplification=noise_amplification(sample, g, result.steps_done))


def inverse_filter(engine: Engine) -> NDArray[np.float32]:
    """Compute G of Eq. (1) in the layout of the engine's transfer function."""
    scale = np.float32(engine.transfer_scale)
    power = np.square(engine.transfer).sum(axis=2, keepdims=True) * scale**2
    g = engine.transfer / np.maximum(power, np.float32(LEAST_TRANSFER**2))
    if not engine.symmetric:
        g[:, :, 1] *= -1
    return g
