"""Compare other shapes of scatter with the fitted one, on held-out images.

Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness". Every shape contains the
softened power law and one or two additional parameters, which are zero for the power law itself. Near the solution all
shapes are linear in their parameters. One pass over the frames therefore gives the normal equations of all shapes, and
the fit of a fold and its gain on held-out images are sums of matrices:

    q_f = q + A_f^-1 v_f,   A_f, v_f summed over the fitted frames of fold f             Eq. (1)
    gain = sum over f of 2 d . v_h - d . A_h d,   d = q_f - q, summed over held-out frames   Eq. (2)

The reported gain is the difference from the softened power law, refitted in the same folds. It can be negative: a
parameter that fits noise makes the prediction of held-out images worse.

| symbol | name |
|---|---|
| A_f, v_f | normal, score: sums over the fitted frames |
| A_h, v_h | normal, score: sums over the held-out frames |
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
    """Improvement of one shape over the softened power law, to first order.

    added: value and standard error of each additional parameter. gain: decrease of chi2 on all frames. held_out_gain:
    decrease on held-out frames; None if there are too few frames for folds.
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
    """Derivative of the total PSF by one parameter of a shape, at the solution of the power law."""
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
        """Step and covariance from all frames."""
        covariance = np.linalg.inv(self._normal.sum(axis=0))
        return covariance @ self._score.sum(axis=0), covariance

    def gain(self, fitted: list[int], held: list[int]) -> float:
        """Eq. (1) and (2) for one fold: the gain on the held-out frames."""
        step = np.linalg.solve(self._normal[fitted].sum(axis=0), self._score[fitted].sum(axis=0))
        return float(2 * step @ self._score[held].sum(axis=0) - step @ self._normal[held].sum(axis=0) @ step)
