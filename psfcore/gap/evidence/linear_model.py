"""The model near its solution: linear in the PSF's coordinates and in the parameters of every effect.

    chi2(theta) = sum over discs of (r - J theta)^T C^-1 (r - J theta) + chi2 of the unocculted blocks  Eq. (1)
    C = noise of the cells + f^2 m m^T                                                                  Eq. (2)

m is the expected light in a disc's cells. The floor f is a relative error common to all cells of a disc; it stands for
errors that nobody has thought of. An effect is tested together with the PSF's coordinates, which are refitted; what they
absorb is not credited to the effect. Its parameters have a Gaussian prior of width UNLIKELY times their likely size, so
that an offset of 200 DN explains nothing. The gain of an effect is the decrease of chi2, prior included.

The many parameters of a random field have a prior of width S, their likely size. Let N be the normal matrix of these
parameters with all others refitted, and l the eigenvalues of S N S. The cost of what was learned about them, and what
they gain from noise alone, are

    cost = sum of ln(1 + l)                     gain = sum of l / (1 + l) chi2_1                     Eq. (3)

so that gain minus cost is twice the log of the likelihood ratio of the data with and without the field.

| symbol | name | unit |
|---|---|---|
| r, J, C | residual, jacobian, covariance of `cells.DiscCells` | DN/s |
| f | floor | - |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.evidence.cells import DiscCells, whitening
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.patterns import means, patterns
from psfcore.least_squares import scaled_inverse

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

FLOOR = 0.003  # f of Eq. (2), the value that the verdict is first made with
UNLIKELY = 10.0
WEAKEST = 1e-9  # smallest eigenvalue of a normal matrix scaled to a unit diagonal


@dataclass(frozen=True, eq=False)
class Whitened:
    """One disc scaled to unit noise: residual (cells,), jacobian (columns, cells), and the whitening matrix."""

    index: int
    residual: Vector
    jacobian: Matrix
    white: Matrix


@dataclass(frozen=True, eq=False)
class Step:
    """A fit of some columns: values, covariance, and the decrease of chi2 by all of them together."""

    columns: tuple[int, ...]
    values: Vector
    covariance: Matrix
    fall: float


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Eq. (1) for some evidence.

    floor: f of Eq. (2). disc_scale, unocculted_scale: chi2 per degree of freedom of the discs and of the blocks if there is
    no gap. scale_error: relative error of disc_scale.
    """

    evidence: Evidence
    floor: float
    disc_scale: float = 1.0
    unocculted_scale: float = 1.0
    scale_error: float = 0.0

    @cached_property
    def discs(self) -> tuple[Whitened, ...]:
        """Every disc scaled to unit noise."""
        return tuple(self._whitened(disc) for disc in self.evidence.discs)

    def _whitened(self, disc: DiscCells) -> Whitened:
        covariance = disc.covariance * self.disc_scale + self.floor**2 * np.outer(
            disc.expected, disc.expected
        )
        white = whitening(covariance)
        return Whitened(disc.index, white @ disc.residual, disc.jacobian @ white, white)

    def equations(self, images: Sequence[int] | None = None) -> tuple[Matrix, Vector]:
        """Normal matrix and score of all columns from some images (None: all images); computed once."""
        key = None if images is None else tuple(images)
        if key not in self._equations:
            self._equations[key] = self._equations_of(images)
        return self._equations[key]

    @cached_property
    def _equations(self) -> dict[tuple[int, ...] | None, tuple[Matrix, Vector]]:
        return {}

    def _equations_of(self, images: Sequence[int] | None) -> tuple[Matrix, Vector]:
        size = self.evidence.size
        normal, score = np.zeros((size, size)), np.zeros(size)
        for disc in self.discs:
            if images is None or disc.index in images:
                normal += disc.jacobian @ disc.jacobian.T
                score += disc.jacobian @ disc.residual
        unocculted = self.evidence.unocculted_equations(images)
        return (
            normal + unocculted.normal / self.unocculted_scale,
            score + unocculted.score / self.unocculted_scale,
        )

    @cached_property
    def patterns(self) -> tuple[Matrix, ...]:
        """`patterns.patterns` of the evidence."""
        return patterns(self.evidence)

    @cached_property
    def means(self) -> tuple[Matrix, ...]:
        """`patterns.means` of the evidence."""
        return means(self.evidence)

    def fit(self, columns: Sequence[int], equations: tuple[Matrix, Vector] | None = None) -> Step:
        """Fit the PSF's coordinates and these columns, with some equations (None: those of all images)."""
        here = [*self.evidence.base, *columns]
        normal, score = self.equations() if equations is None else equations
        normal, score = normal[np.ix_(here, here)] + np.diag(self._prior[here]), score[here]
        covariance = scaled_inverse(normal, weakest=WEAKEST)
        values = covariance @ score
        return Step(tuple(here), values, covariance, float(score @ values))

    @cached_property
    def _prior(self) -> Vector:
        """1 / variance of the prior of each column; 0 for the PSF's coordinates."""
        out = np.zeros(self.evidence.size)
        for effect in self.evidence.effects:
            wide = 1.0 if effect.field else UNLIKELY
            for column, parameter in zip(self.evidence.columns[effect.name], effect.parameters, strict=False):
                out[column] = (wide * parameter.likely) ** -2
        return out

    @cached_property
    def of_fields(self) -> frozenset[int]:
        """The columns of all random fields."""
        fields = (effect.name for effect in self.evidence.effects if effect.field)
        return frozenset(column for name in fields for column in self.evidence.columns[name])

    def pull_of_prior(self, step: Step, taken_out: Vector) -> Vector:
        """By how much the prior would reduce a step's columns if it included the amounts that were subtracted beforehand."""
        return np.asarray(step.covariance @ (self._prior[list(step.columns)] * taken_out))

    def learned(self, columns: Sequence[int]) -> Vector:
        """l of Eq. (3) for those columns that belong to a random field, with the others and the PSF's coordinates refitted."""
        field = [column for column in columns if column in self.of_fields]
        if not field:
            return np.zeros(0)
        others = [*self.evidence.base, *(column for column in columns if column not in self.of_fields)]
        here, first = [*others, *field], len(others)
        normal = self.equations()[0][np.ix_(here, here)]
        cross = normal[:first, first:]
        known = scaled_inverse(normal[:first, :first] + np.diag(self._prior[others]), weakest=WEAKEST)
        width = self._prior[field] ** -0.5
        left = (normal[first:, first:] - cross.T @ known @ cross) * np.outer(width, width)
        return np.maximum(np.linalg.eigvalsh(left), 0.0)

    @cached_property
    def base(self) -> Step:
        """The fit of the PSF's coordinates alone."""
        return self.fit(())

    def gain(self, step: Step) -> float:
        """The decrease of chi2 by a step's columns, compared with the PSF's coordinates alone."""
        return max(step.fall - self.base.fall, 0.0)

    def left(self, step: Step) -> tuple[Vector, ...]:
        """The whitened residuals of every disc after a step."""
        return tuple(d.residual - d.jacobian[list(step.columns)].T @ step.values for d in self.discs)

    def left_unocculted(self, step: Step) -> float:
        """chi2 of the unocculted blocks after a step, over unocculted_scale, with flickering blocks down-weighted."""
        here, unocculted = list(step.columns), self.evidence.steady_unocculted
        theta = step.values
        fall = 2 * theta @ unocculted.score[here] - theta @ unocculted.normal[np.ix_(here, here)] @ theta
        return float(unocculted.chi2 - fall) / self.unocculted_scale

    def gain_of_patterns(
        self, step: Step, patterns: Sequence[Matrix], left: Sequence[Vector]
    ) -> tuple[float, int]:
        """The further decrease of the discs' chi2 by patterns of the cells, and the number of independent patterns.

        patterns: (patterns, cells) in DN/s for each disc. left: whitened residuals after the step; the step's own columns are
        refitted together with the patterns.
        """
        here = list(step.columns)
        design = np.concatenate(
            [
                np.vstack([disc.jacobian[here], pattern @ disc.white])
                for disc, pattern in zip(self.discs, patterns, strict=True)
            ],
            axis=1,
        )
        residual = np.concatenate(left)
        first = len(here)
        basis = _orthonormal(design[:first])
        rest = design[first:] - (design[first:] @ basis.T) @ basis
        size = np.linalg.norm(design[first:], axis=1)
        rest = _orthonormal(rest / np.maximum(size, 1e-300)[:, None], 1e-4)
        return float(np.sum((rest @ residual) ** 2)), rest.shape[0]


def _orthonormal(rows: Matrix, least: float = 1e-7) -> Matrix:
    """An orthonormal basis of the row space."""
    if rows.shape[0] == 0:
        return rows
    _, sizes, basis = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(basis[sizes > least * max(float(sizes[0]), 1e-300)])
