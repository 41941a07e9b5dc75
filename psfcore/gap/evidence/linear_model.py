"""The model about its solution: linear in the PSF's coordinates and in every effect's parameters.

    chi2(theta) = sum over discs of (r - J theta)^T C^-1 (r - J theta) + chi2 of the lit blocks        Eq. (1)
    C = noise of the cells + f^2 m m^T                                                                  Eq. (2)

m being what is expected in a disc's cells: a floor, the share f, common to a disc, for what nobody has thought of. An
effect is tried beside the PSF's own coordinates, which are refitted with it: what they absorb is not its. Its parameters have a
prior of UNLIKELY times what is likely: an offset of 200 DN explains nothing. Its gain is what chi2 and prior fall by.

A field's many parameters have the prior itself, of width S. With N the normal matrix of them, all else refitted, and l
the eigenvalues of S N S, what was learned of them costs, and noise alone gains by them,

    cost = sum of ln(1 + l)                     gain = sum of l / (1 + l) chi2_1                     Eq. (3)

so that gain less cost is twice the logarithm of how much likelier the field makes the data.

| symbol | name | unit |
|---|---|---|
| r, J, C | residual, answers, covariance of `cells.DiscCells` | DN/s |
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

FLOOR = 0.003  # f of Eq. (2) that verdicts start from
UNLIKELY = 10.0
WEAKEST = 1e-9  # of a normal matrix scaled to a unit diagonal


@dataclass(frozen=True, eq=False)
class Whitened:
    """One disc with unit noise: residual (cells,), answers (columns, cells); and the whitening itself."""

    index: int
    residual: Vector
    jacobian: Matrix
    white: Matrix


@dataclass(frozen=True, eq=False)
class Step:
    """A fit of some columns: values, covariance, and how far chi2 fell by all of them together."""

    columns: tuple[int, ...]
    values: Vector
    covariance: Matrix
    fall: float


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Eq. (1) on some evidence. floor: f of Eq. (2). disc_scale, lit_scale: by what factor chi2 of discs and of lit
    blocks exceeds its degrees of freedom where there is no gap; scale_error: how well the discs' is known, a share."""

    evidence: Evidence
    floor: float
    disc_scale: float = 1.0
    unocculted_scale: float = 1.0
    scale_error: float = 0.0

    @cached_property
    def discs(self) -> tuple[Whitened, ...]:
        """Every disc with unit noise."""
        return tuple(self._whitened(disc) for disc in self.evidence.discs)

    def _whitened(self, disc: DiscCells) -> Whitened:
        covariance = disc.covariance * self.disc_scale + self.floor**2 * np.outer(
            disc.expected, disc.expected
        )
        white = whitening(covariance)
        return Whitened(disc.index, white @ disc.residual, disc.jacobian @ white, white)

    def equations(self, images: Sequence[int] | None = None) -> tuple[Matrix, Vector]:
        """Normal matrix and score of all columns from some images (none: all); worked out once."""
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
        """The PSF's coordinates and these columns, from some equations (none: of all images)."""
        here = [*self.evidence.base, *columns]
        normal, score = self.equations() if equations is None else equations
        normal, score = normal[np.ix_(here, here)] + np.diag(self._prior[here]), score[here]
        covariance = scaled_inverse(normal, weakest=WEAKEST)
        values = covariance @ score
        return Step(tuple(here), values, covariance, float(score @ values))

    @cached_property
    def _prior(self) -> Vector:
        """Of each column, over its variance: 0 of the PSF's coordinates."""
        out = np.zeros(self.evidence.size)
        for effect in self.evidence.effects:
            wide = 1.0 if effect.field else UNLIKELY
            for column, parameter in zip(self.evidence.columns[effect.name], effect.parameters, strict=False):
                out[column] = (wide * parameter.likely) ** -2
        return out

    @cached_property
    def of_fields(self) -> frozenset[int]:
        """The columns of all fields."""
        fields = (effect.name for effect in self.evidence.effects if effect.field)
        return frozenset(column for name in fields for column in self.evidence.columns[name])

    def pull_of_prior(self, step: Step, taken_out: Vector) -> Vector:
        """By how much less a step's columns would be found, had their prior known of what was taken out beforehand."""
        return np.asarray(step.covariance @ (self._prior[list(step.columns)] * taken_out))

    def learned(self, columns: Sequence[int]) -> Vector:
        """l of Eq. (3) of those of some columns that are a field's, the others and the PSF's coordinates refitted."""
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
        """The PSF's coordinates alone."""
        return self.fit(())

    def gain(self, step: Step) -> float:
        """What chi2 falls by with a step's columns, beyond the PSF's coordinates."""
        return max(step.fall - self.base.fall, 0.0)

    def left(self, step: Step) -> tuple[Vector, ...]:
        """The whitened residuals of every disc after a step."""
        return tuple(d.residual - d.jacobian[list(step.columns)].T @ step.values for d in self.discs)

    def left_unocculted(self, step: Step) -> float:
        """chi2 of the lit blocks after a step, over lit_scale, restless blocks weighed by what they show."""
        here, unocculted = list(step.columns), self.evidence.steady_unocculted
        theta = step.values
        fall = 2 * theta @ unocculted.score[here] - theta @ unocculted.normal[np.ix_(here, here)] @ theta
        return float(unocculted.chi2 - fall) / self.unocculted_scale

    def gain_of_patterns(
        self, step: Step, patterns: Sequence[Matrix], left: Sequence[Vector]
    ) -> tuple[float, int]:
        """How far chi2 of the discs falls further by patterns of the cells, and how many of them count.

        patterns: for each disc (patterns, cells) in DN/s. left: whitened residuals after the step, whose own columns
        are refitted with the patterns.
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
    """An orthonormal basis of the span of some rows."""
    if rows.shape[0] == 0:
        return rows
    _, sizes, basis = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(basis[sizes > least * max(float(sizes[0]), 1e-300)])
