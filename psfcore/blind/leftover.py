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

from collections.abc import Mapping, Sequence
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

    residual, weight: (pixels,). jacobian: (parameters, pixels).
    """

    dark: Pixels
    scene: Lanes
    residual: Vector
    jacobian: NDArray[np.float64]
    weight: Vector


@dataclass(frozen=True)
class Left:
    """The residual that an effect leaves in the discs, percent, rms over images.

    The fields with "clean" in their names contain the residual of images without any effect. The sampling of these
    images on pixels causes this residual. by_image_pct: for each image number, the residual after the refit,
    with its sign.
    """

    before_refit_pct: float
    after_refit_pct: float
    by_image_pct: dict[int, float]
    clean_before_refit_pct: float
    clean_after_refit_pct: float


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
        self._noise, self._frames = noise, frames
        self._discs = [self._look(frame) for frame in frames]

    def left(self, images: Mapping[int, Plane]) -> Left:
        """The residual that an effect leaves.

        images: the images with the effect [y, x], DN/s, by number. The refit uses only these images.
        """
        residuals = {n: self._residual(n, pixels) for n, pixels in images.items()}
        changes = {n: residuals[n][0] - self._discs[n].residual for n in images}
        clean = {n: self._discs[n].residual for n in images}
        after_refit = self._refitted(changes)
        return Left(
            before_refit_pct=self._rms(changes),
            after_refit_pct=self._rms(after_refit),
            by_image_pct={n: self._percent(n, residual) for n, residual in after_refit.items()},
            clean_before_refit_pct=self._rms(clean),
            clean_after_refit_pct=self._rms(self._refitted(clean)),
        )

    def clean_left_pct(self) -> dict[int, float]:
        """e_i of Eq. (1) for every image without effects, after the refit: percent, by image number."""
        fitted = self._refitted({n: disc.residual for n, disc in enumerate(self._discs)})
        return {n: self._percent(n, residual) for n, residual in fitted.items()}

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
        )

    def _column(self, slope: Blur, lit: Lanes, dark: Pixels) -> Vector:
        """One column of A: the direct change of the dark pixels, minus the change that the deconvolved scene causes in
        them."""
        changed = slope.convolve(lit)
        scene = _blanked(self._optics.invert_once(changed), dark)
        return pick(changed, dark) - pick(self._optics.convolve(scene), dark)

    def _residual(self, n: int, pixels: Plane) -> tuple[Vector, Vector]:
        disc = self._discs[n]
        observed = self._optics.lanes(pixels)
        scene = self._optics.invert(observed, disc.scene, steps=_WARM_STEPS)
        expected = pick(self._optics.convolve(_blanked(scene, disc.dark)), disc.dark)
        return pick(observed, disc.dark) - expected, expected

    def _refitted(self, residuals: Mapping[int, Vector]) -> dict[int, Vector]:
        """Eq. (3)."""
        weighted = {n: self._discs[n].jacobian * self._discs[n].weight for n in residuals}
        normal = sum(weighted[n] @ self._discs[n].jacobian.T for n in residuals)
        score = sum(weighted[n] @ residuals[n] for n in residuals)
        step = np.linalg.lstsq(np.asarray(normal), np.asarray(score), rcond=1e-12)[0]
        return {n: residual - self._discs[n].jacobian.T @ step for n, residual in residuals.items()}

    def _percent(self, n: int, residual: Vector) -> float:
        disc = self._discs[n]
        observed = float(pick(self._optics.lanes(self._frames[n].pixels), disc.dark).mean())
        return -100 * float(residual.mean()) / observed  # simulated minus observed

    def _rms(self, residuals: Mapping[int, Vector]) -> float:
        return float(np.sqrt(np.mean([self._percent(n, r) ** 2 for n, r in residuals.items()])))


@dataclass(frozen=True)
class Refitted:
    """The result of a full inversion of nearly noise-free images.

    residual_pct: e_i of Eq. (1), by image number. noise_pct: the noise of e_i. values: the fitted parameters of the scatter.
    """

    residual_pct: dict[int, float]
    noise_pct: dict[int, float]
    values: dict[str, float]

    def as_json(self) -> dict[str, Any]:
        """Values for JSON. The keys of images are their numbers, as text."""
        return {
            "residual_pct": {str(n): value for n, value in self.residual_pct.items()},
            "noise_pct": {str(n): value for n, value in self.noise_pct.items()},
            "values": self.values,
        }


def refitted(frames: Sequence[Frame], diffraction: Kernel, law: ScatterTruth, noise: Noise) -> Refitted:
    """Refit the PSF. The fit starts at the true parameters. Raises the errors of psfcore.scatter.inversion.invert."""
    transit = Transit(frames=tuple(frames), diffraction=diffraction, noise=noise)
    inversion = invert(transit, start=true_coordinates(law)).inversion
    number = {frame.file: n for n, frame in enumerate(frames)}
    return Refitted(
        residual_pct={number[fit.file]: fit.residual_pct for fit in inversion.frames},
        noise_pct={number[fit.file]: 100 * fit.noise / fit.observed for fit in inversion.frames},
        values=inversion.values,
    )


def rms_difference(with_effect: Mapping[int, float], without: Mapping[int, float]) -> float:
    """Eq. (2), percent, over the images that both arguments contain; 0 if there are none."""
    both = sorted(set(with_effect) & set(without))
    return float(np.sqrt(np.mean([(with_effect[n] - without[n]) ** 2 for n in both]))) if both else 0.0


def true_coordinates(law: ScatterTruth) -> Vector:
    """The parameters of the true power law, as coordinates of the fit."""
    return SOFTENED_POWER_LAW.coordinates({"b_px": law.b_px, "c": law.c, "total": law.total})


def _blanked(scene: Lanes, dark: Pixels) -> Lanes:
    lit = scene.copy()
    put(lit, dark, 0.0)
    return lit
