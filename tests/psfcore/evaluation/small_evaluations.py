"""Evaluations of small transits, shared by many tests."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, gmres

from psfcore.convolution.convolver import Convolver
from psfcore.evaluation.evaluation import Evaluation, FrameEvaluation, evaluate
from psfcore.scatter.validation.robustness import DarkOffsetStudy, dark_offset_study
from psfcore.simulate.scatter_truth import total_kernel
from psfcore.transit.transit import Kernel
from tests.psfcore.small_transits import DIFFRACTION, SCATTER, SIZE_PX, noise_free, observed, sky, solved

SEEDS = range(11, 20)


@cache
def kernel_with(total: float = SCATTER.total) -> Kernel:
    """The true PSF, or a PSF with another total of scatter."""
    return total_kernel(dataclasses.replace(SCATTER, total=total), DIFFRACTION, 2 * SIZE_PX)


@cache
def judged(total: float = SCATTER.total) -> Evaluation:
    """The evaluation of a transit without noise, for a PSF with this total of scatter."""
    return evaluate(noise_free(sky()), lambda _: kernel_with(total))


@cache
def noisy(seed: int) -> Evaluation:
    """The evaluation of a transit with noise, for the true PSF."""
    return evaluate(observed(sky(), seed).transit, lambda _: kernel_with())


@cache
def offsets() -> DarkOffsetStudy:
    return dark_offset_study(observed(sky()).transit, (-5.0, 5.0), nominal=solved().inversion)


def exact_scene(through: Convolver, image: NDArray[np.float64]) -> NDArray[np.float64]:
    """The scene of an image by GMRES in double precision."""
    operator = LinearOperator(
        (image.size, image.size),
        lambda x: np.asarray(through.apply(x.reshape(image.shape))).ravel(),
        dtype=np.float64,
    )
    scene, failed = gmres(operator, image.ravel(), rtol=1e-7)
    assert failed == 0
    return np.asarray(scene).reshape(image.shape)


def residual_against_pct(frame: FrameEvaluation, plane: NDArray[np.floating]) -> float:
    """The residual in percent against a noise-free image [y, x] instead of the observation."""
    mean = float(np.mean(plane[frame.dark], dtype=np.float64))
    return 100 * (frame.simulated_dn_s - mean) / mean


def rms(values: object) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
