"""The residual that an effect leaves in the discs of noise-free images, before and after the PSF is refitted.

    e_i = -100 mean(D [y_i - H (1 - D) x_i]) / mean(D y_i)                                               Eq. (1)
    left = rms over images of (e_i with the effect - e_i without the effect)                             Eq. (2)
    residual after a refit, to first order:  r - A (A^T W A)^-1 A^T W r                                  Eq. (3)

y_i is image i, x_i is its deconvolved scene, and D is the mask of the fully dark pixels. Both means in Eq. (1) are over
these pixels. H is the convolution with the true PSF on detector pixels. r are the residuals of the dark pixels, W their
weights, and A their Jacobian with respect to the three parameters of the scatter. Eq. (3) is fast and serves to set the
strength of an effect. The residuals in the truth of a case come from a full inversion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.noise import Noise
from psfcore.scatter.inversion import invert
from psfcore.scatter.optics import Blur, Lanes, Optics, Pixels, pick, put
from psfcore.scatter.reconstruction import DARK_MARGIN_PX
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import TotalPsf
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.transit.occulter import fully_dark
from psfcore.transit.transit import Frame, Transit

Plane = NDArray[np.floating]
Kernel = NDArray[np.float64]
Vector = NDArray[np.float64]
_WARM_STEPS = 3
_LEAST_LEVEL = 0.2


@dataclass(frozen=True)
class _Discs:
    """One image without the effect: its dark pixels, its scene, and the residual, Jacobian and weight of the dark pixels.

    residual, weight: (pixels,). jacobian: (parameters, pixels). observed: the mean of the dark pixels, DN/s.
    """

    dark: Pixels
    scene: Lanes
    residual: Vector
    jacobian: NDArray[np.float64]
    weight: Vector
    observed: float


@dataclass(frozen=True)
class Left:
    """The residual that an effect leaves in the discs, percent, rms over images.

    by_image_pct: for each image, the residual after the refit, with its sign.
    """

    before_refit_pct: float
    after_refit_pct: float
    by_image_pct: list[float]


class LinearEstimator:
    """Compute Eq. (1) to (3), linearised at images without effects.

    frames: the nearly noise-free images without effects, with the exact positions of the occulter.
    """

    def __init__(self, frames: Sequence[Frame], diffraction: Kernel, law: ScatterTruth, noise: Noise) -> None:
        shape = (frames[0].pixels.shape[0], frames[0].pixels.shape[1])
        total = TotalPsf(diffraction, SOFTENED_POWER_LAW, shape)
        at = true_coordinates(law)
        self._optics = Optics(total.kernel(at), shape)
        self._slopes = [Blur(slope, shape) for slope in total.slopes(at)]
        self._noise = noise
        self._discs = [self._look(frame) for frame in frames]

    def left(self, images: Sequence[Plane]) -> Left:
        """The residual that an effect leaves. images: all images with the effect [y, x], DN/s."""
        changes = [
            self._residual(disc, pixels) - disc.residual
            for disc, pixels in zip(self._discs, images, strict=True)
        ]
        before, after = self._percent(changes), self._percent(self._refitted(changes))
        return Left(rms(before), rms(after), after)

    def clean_left_pct(self) -> list[float]:
        """e_i of Eq. (1) for every image without effects, after the refit, percent. The sampling on pixels causes it."""
        return self._percent(self._refitted([disc.residual for disc in self._discs]))

    def _look(self, frame: Frame) -> _Discs:
        shape = (frame.pixels.shape[0], frame.pixels.shape[1])
        rows, columns = np.nonzero(fully_dark(shape, frame.place, DARK_MARGIN_PX))
        dark = (rows, columns)
        observed = self._optics.lanes(frame.pixels)
        scene = self._optics.invert(observed)
        lit = _blanked(scene, dark)
        expected = pick(self._optics.convolve(lit), dark)
        level = np.maximum(expected, _LEAST_LEVEL * expected.mean())
        return _Discs(
            dark=dark,
            scene=scene,
            residual=pick(observed, dark) - expected,
            jacobian=np.array([self._column(blur, lit, dark) for blur in self._slopes]),
            weight=1 / self._noise.variance(level, frame.exposure_s),
            observed=float(pick(observed, dark).mean()),
        )

    def _column(self, slope: Blur, lit: Lanes, dark: Pixels) -> Vector:
        """One column of A: the direct change of the dark pixels, minus the change that the deconvolved scene causes in
        them."""
        changed = slope.convolve(lit)
        scene = _blanked(self._optics.invert_once(changed), dark)
        return pick(changed, dark) - pick(self._optics.convolve(scene), dark)

    def _residual(self, disc: _Discs, pixels: Plane) -> Vector:
        observed = self._optics.lanes(pixels)
        scene = self._optics.invert(observed, disc.scene, steps=_WARM_STEPS)
        return pick(observed, disc.dark) - pick(self._optics.convolve(_blanked(scene, disc.dark)), disc.dark)

    def _refitted(self, residuals: Sequence[Vector]) -> list[Vector]:
        """Eq. (3)."""
        normal, score = np.zeros((3, 3)), np.zeros(3)
        for disc, residual in zip(self._discs, residuals, strict=True):
            weighted = disc.jacobian * disc.weight
            normal += weighted @ disc.jacobian.T
            score += weighted @ residual
        step = np.linalg.lstsq(normal, score, rcond=1e-12)[0]
        return [
            residual - disc.jacobian.T @ step for disc, residual in zip(self._discs, residuals, strict=True)
        ]

    def _percent(self, residuals: Sequence[Vector]) -> list[float]:
        """Eq. (1): simulated minus observed, for each image."""
        return [
            -100 * float(residual.mean()) / disc.observed
            for disc, residual in zip(self._discs, residuals, strict=True)
        ]


def refitted(frames: Sequence[Frame], diffraction: Kernel, law: ScatterTruth, noise: Noise) -> dict[str, Any]:
    """Refit the PSF to nearly noise-free images. The fit starts at the true parameters.

    The result is JSON: residual_pct, the residual e_i of Eq. (1), and noise_pct, its noise, both by the number of the
    image as text; values, the fitted parameters of the scatter. Raises the errors of psfcore.scatter.inversion.invert.
    """
    transit = Transit(frames=tuple(frames), diffraction=diffraction, noise=noise)
    inversion = invert(transit, start=true_coordinates(law)).inversion
    number = {frame.file: str(n) for n, frame in enumerate(frames)}
    return {
        "residual_pct": {number[fit.file]: fit.residual_pct for fit in inversion.frames},
        "noise_pct": {number[fit.file]: 100 * fit.noise / fit.observed for fit in inversion.frames},
        "values": inversion.values,
    }


def rms(values: Sequence[float]) -> float:
    """The root of the mean square; 0 if there are no values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


def true_coordinates(law: ScatterTruth) -> Vector:
    """The parameters of the true power law, as coordinates of the fit."""
    return SOFTENED_POWER_LAW.coordinates({"b_px": law.b_px, "c": law.c, "total": law.total})


def _blanked(scene: Lanes, dark: Pixels) -> Lanes:
    lit = scene.copy()
    put(lit, dark, 0.0)
    return lit
