"""The residual that an effect leaves in the discs of noise-free images after the PSF is refitted.

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
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Kernel, Vector
from psfcore.noise import Noise
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import DARK_MARGIN_PX, Reconstruction, TransitScenes
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from psfcore.scatter.total_psf import Blur, Optics, TotalPsf
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.transit.occulter import fully_dark
from psfcore.transit.transit import Frame, Transit

Plane = NDArray[np.floating]
_WARM_STEPS = 3


class LinearEstimator:
    """Compute Eq. (1) to (3), linearised at images without effects.

    Parameters
    ----------
    frames
        The nearly noise-free images without effects, with the exact positions of the occulter.
    """

    def __init__(self, frames: Sequence[Frame], diffraction: Kernel, law: ScatterTruth, noise: Noise) -> None:
        shape = (frames[0].pixels.shape[0], frames[0].pixels.shape[1])
        transit = Transit(frames=tuple(frames), diffraction=diffraction, noise=noise)
        total, at = TotalPsf(diffraction, SOFTENED_POWER_LAW, shape), true_coordinates(law)
        optics = Optics(total.kernel(at), shape)
        sky = TransitScenes.reconstructed(transit, optics, lambda stage, step, steps: None)
        masks = (fully_dark(shape, frame.place, DARK_MARGIN_PX) for frame in frames)
        sky.dark = [(rows, columns) for rows, columns in map(np.nonzero, masks)]
        images = range(len(frames))
        clean = Reconstruction(transit, total, optics, sky, tuple(images), threads=1)
        slopes = [Blur(slope, shape) for slope in total.slopes(at)]
        self._clean = clean
        self._residuals, expected, self._jacobians = zip(
            *(clean.residual_with_jacobian(n, slopes) for n in images), strict=True
        )
        self._weights = [clean.weight(n, expected[n]) for n in images]
        self._observed = [float(clean.observed(n).mean()) for n in images]

    def left_pct(self, images: Sequence[Plane]) -> float:
        """Eq. (2) after the refit, percent.

        Parameters
        ----------
        images
            All images with the effect [y, x], DN/s.
        """
        clean = self._clean
        frames = (
            replace(frame, pixels=pixels) for frame, pixels in zip(clean.transit.frames, images, strict=True)
        )
        transit = replace(clean.transit, frames=tuple(frames))
        sky = replace(clean.sky.copy(), transit=transit)
        for n in range(len(images)):
            sky.improve(n, clean.optics, _WARM_STEPS)
        changed = replace(clean, transit=transit, sky=sky)
        changes = [changed.residual(n)[0] - before for n, before in enumerate(self._residuals)]
        return rms(self._left_by_image(changes))

    def clean_left_pct(self) -> list[float]:
        """The residual of every image without effects after the refit, e_i of Eq. (1), percent: what sampling on
        pixels leaves.
        """
        return self._left_by_image(self._residuals)

    def _left_by_image(self, residuals: Sequence[Vector]) -> list[float]:
        """Eq. (1) for each image: simulated minus observed, after the refit of Eq. (3)."""
        jacobian = np.concatenate(self._jacobians, axis=1)
        weighted = jacobian * np.concatenate(self._weights)
        step = np.linalg.lstsq(weighted @ jacobian.T, weighted @ np.concatenate(residuals), rcond=1e-12)[0]
        every = zip(residuals, self._jacobians, self._observed, strict=True)
        return [-100 * float((r - own.T @ step).mean()) / observed for r, own, observed in every]


def refitted(
    frames: Sequence[Frame], diffraction: Kernel, law: ScatterTruth, noise: Noise
) -> dict[str, tuple[float, float]]:
    """The residual e_i of Eq. (1) and its noise, percent, by file, after the PSF is refitted to nearly noise-free
    images.

    The fit starts at the true parameters. Raises the errors of psfcore.scatter.inversion.invert.
    """
    transit = Transit(frames=tuple(frames), diffraction=diffraction, noise=noise)
    fits = invert(transit, start=true_coordinates(law)).inversion.frames
    return {fit.file: (fit.residual_pct, 100 * fit.noise / fit.observed) for fit in fits}


def rms(values: Sequence[float]) -> float:
    """The root of the mean square; 0 if there are no values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


def true_coordinates(law: ScatterTruth) -> Vector:
    """The parameters of the true power law, as coordinates of the fit."""
    return SOFTENED_POWER_LAW.coordinates({"b_px": law.b_px, "c": law.c, "total": law.total})
