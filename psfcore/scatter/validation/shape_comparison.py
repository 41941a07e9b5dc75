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
from psfcore.scatter.inversion import Progress, Solution
from psfcore.scatter.optics import Blur
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW, Shape
from psfcore.scatter.total_psf import TotalPsf
from psfcore.transit.blocks import folds

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

    @property
    def significance(self) -> float:
        """Gain divided by the number of additional parameters."""
        return self.gain / len(self.added)


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
    columns: dict[str, list[int]] = {}
    names: list[str] = []
    blurs = []
    for shape in shapes:
        columns[shape.name] = []
        for k, parameter in enumerate(shape.parameters[BASE:], start=BASE):
            if parameter.name not in names:
                names.append(parameter.name)
                blurs.append(_slope(solution, shape, k))
            columns[shape.name].append(BASE + names.index(parameter.name))
    base_slopes = solution.total.slopes(solution.inversion.coordinates)
    blurs = [*(Blur(s, solution.transit.shape, threads=solution.threads) for s in base_slopes), *blurs]
    normals, scores = [], []
    for step, n in enumerate(solution.part):
        progress("comparing shapes", step, len(solution.part))
        residual, expected = solution.residual(n)
        jacobian = np.array([solution.jacobian(n, blur) for blur in blurs])
        weighted = jacobian * solution.weight(n, expected)
        normals.append(weighted @ jacobian.T)
        scores.append(weighted @ residual)
    normal, score = np.array(normals), np.array(scores)
    return tuple(_compared(shape, columns[shape.name], normal, score) for shape in shapes)


def _slope(solution: Solution, shape: Shape, parameter: int) -> Blur:
    """The derivative of the total PSF with respect to one parameter of a shape, at the solution of the power law."""
    total = TotalPsf(solution.transit.diffraction, shape, solution.transit.shape, threads=solution.threads)
    at = shape.coordinates(solution.inversion.values)
    return Blur(total.slope(at, parameter), solution.transit.shape, threads=solution.threads)


def _compared(shape: Shape, extra: list[int], normal: Matrix, score: Matrix) -> ComparedShape:
    every = [*range(BASE), *extra]
    whole, alone = _ParameterSubset(normal, score, every), _ParameterSubset(normal, score, list(range(BASE)))
    step, covariance = whole.solved()
    sigma = np.sqrt(np.diag(covariance))
    gains = []
    for fold in folds(len(normal)):
        fitted, held = list(fold.fitted), list(fold.held_out)
        gains.append(whole.gain(fitted, held) - alone.gain(fitted, held))
    everything = list(range(len(normal)))
    return ComparedShape(
        name=shape.name,
        added={
            p.name: (float(step[BASE + k]), float(sigma[BASE + k]))
            for k, p in enumerate(shape.parameters[BASE:])
        },
        gain=whole.gain(everything, everything) - alone.gain(everything, everything),
        held_out_gain=float(np.sum(gains)) if gains else None,
    )


class _ParameterSubset:
    """The normal equations of a subset of the parameters."""

    def __init__(self, normal: Matrix, score: Matrix, columns: list[int]) -> None:
        self._normal = normal[:, columns][:, :, columns]
        self._score = score[:, columns]

    def solved(self) -> tuple[Vector, Matrix]:
        """Gauss-Newton step and covariance of the parameters, from all images."""
        covariance = np.linalg.inv(self._normal.sum(axis=0))
        return covariance @ self._score.sum(axis=0), covariance

    def gain(self, fitted: list[int], held: list[int]) -> float:
        """The gain of one fold on its held-out images, from Eq. (1) and (2)."""
        step = np.linalg.solve(self._normal[fitted].sum(axis=0), self._score[fitted].sum(axis=0))
        return float(2 * step @ self._score[held].sum(axis=0) - step @ self._normal[held].sum(axis=0) @ step)
