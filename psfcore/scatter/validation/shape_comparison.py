"""Compare other shapes of scatter with the fitted shape, on held-out images.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness". Every shape is the
softened power law with one or two additional parameters. If these are zero, the shape equals the power law. Near the
solution, the model is nearly linear in the parameters. One pass over the images therefore gives the normal equations of
all shapes. The fit of a fold, and its gain on held-out images, follow from sums of these equations. The gain is the
decrease of chi2 (to first order):

    q_f = q + A_f^-1 v_f,   A_f, v_f summed over the fitted frames of fold f             Eq. (1)
    gain = sum over folds f of (2 d . v_h - d . A_h d),   d = q_f - q                        Eq. (2)

The reported gain is the gain of the shape minus the gain of the softened power law, which is refitted in the same folds.
The reported gain can be negative: a parameter that fits noise makes the prediction of held-out images worse.

| symbol | name |
|---|---|
| A_f, v_f | matrix (normal) and right-hand side (score) of the normal equations, summed over the fitted images |
| A_h, v_h | the same matrix and right-hand side, summed over the held-out images |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.scatter.optics import Blur
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW, Shape
from psfcore.scatter.total_psf import TotalPsf
from psfcore.transit.transit import folds

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]
BASE = len(SOFTENED_POWER_LAW.parameters)


@dataclass(frozen=True)
class ComparedShape:
    """The improvement of the fit by one shape, compared with the softened power law, to first order.

    added: value and standard error of each additional parameter. gain: decrease of chi2 for all images. held_out_gain:
    decrease of chi2 for held-out images; None if there are too few images for folds.
    """

    name: str
    added: dict[str, tuple[float, float]]
    gain: float
    held_out_gain: float | None


def compare_shapes(
    solution: Solution, *, progress: Progress = lambda stage, step, steps: None
) -> tuple[ComparedShape, ...]:
    """Compare all other shapes with the softened power law.

    Raises DataError "unknown-shape" if `solution` is not a fit of the softened power law.
    """
    base = solution.inversion.shape
    if base.name != SOFTENED_POWER_LAW.name:
        raise DataError("unknown-shape", f"expected a fit of {SOFTENED_POWER_LAW.name}; got {base.name}")
    shapes = [shape for shape in SHAPES.values() if shape.name != base.name]
    at, field_shape, threads = solution.inversion, solution.transit.shape, solution.threads
    names: list[str] = []
    blurs = [Blur(slope, field_shape, threads=threads) for slope in solution.total.slopes(at.coordinates)]
    for shape in shapes:  # derivatives of the total PSF, at the solution of the power law
        total = TotalPsf(solution.transit.diffraction, shape, field_shape, threads=threads)
        for k, parameter in enumerate(shape.parameters[BASE:], start=BASE):
            if parameter.name not in names:
                names.append(parameter.name)
                slope = total.slope(shape.coordinates(at.values), k)
                blurs.append(Blur(slope, field_shape, threads=threads))
    normals, scores = [], []
    for step, n in enumerate(solution.part):
        progress("comparing shapes", step, len(solution.part))
        residual, expected = solution.residual(n)
        jacobian = np.array([solution.jacobian(n, blur) for blur in blurs])
        weighted = jacobian * solution.weight(n, expected)
        normals.append(weighted @ jacobian.T)
        scores.append(weighted @ residual)
    normal, score = np.array(normals), np.array(scores)
    added = [[BASE + names.index(name) for name in shape.names[BASE:]] for shape in shapes]
    return tuple(_compared(shape, of, normal, score) for shape, of in zip(shapes, added, strict=True))


def _compared(shape: Shape, extra: list[int], normal: Matrix, score: Matrix) -> ComparedShape:
    whole, alone = [*range(BASE), *extra], list(range(BASE))

    def gain(fitted: list[int], held: list[int]) -> float:
        """The gain of the shape minus that of the power law, on held-out images."""
        return _gain(normal, score, whole, fitted, held) - _gain(normal, score, alone, fitted, held)

    everything = list(range(len(normal)))
    covariance = np.linalg.inv(normal[:, whole][:, :, whole].sum(axis=0))
    step, sigma = covariance @ score[:, whole].sum(axis=0), np.sqrt(np.diag(covariance))
    gains = [gain(list(fold.fitted), list(fold.held_out)) for fold in folds(len(normal))]
    return ComparedShape(
        name=shape.name,
        added={
            name: (float(step[k]), float(sigma[k])) for k, name in enumerate(shape.names[BASE:], start=BASE)
        },
        gain=gain(everything, everything),
        held_out_gain=float(np.sum(gains)) if gains else None,
    )


def _gain(normal: Matrix, score: Matrix, columns: list[int], fitted: list[int], held: list[int]) -> float:
    """The gain of some parameters (columns) on held-out images, from Eq. (1) and (2)."""
    normal, score = normal[:, columns][:, :, columns], score[:, columns]
    step = np.linalg.solve(normal[fitted].sum(axis=0), score[fitted].sum(axis=0))
    return float(2 * step @ score[held].sum(axis=0) - step @ normal[held].sum(axis=0) @ step)
