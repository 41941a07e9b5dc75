"""The linear model: chi2 near the fit, as a function of the coordinates of the PSF and the parameters of every effect.

    chi2(theta) = sum over discs of (r - J theta)^T C^-1 (r - J theta) + chi2 of the unocculted blocks  Eq. (1)
    C = noise of the cells + f^2 m m^T                                                                  Eq. (2)

r are the residuals in the cells of a disc, J is their Jacobian, theta are the parameters, and m is the expected light
in the cells. The floor f is a relative error common to all cells of a disc. It allows for causes that are in no model.
While an effect is tested, the coordinates of the PSF are refitted. The effect therefore gets no credit for residuals
that a change of the PSF can absorb. The parameters of an effect have a Gaussian prior. Its width is UNLIKELY times
their likely size; an implausible offset of 200 DN can then explain nothing. The gain of an effect is the decrease of
chi2, including the term of the prior.

A random field has many parameters, for example the cosines of a flat-field error. Their prior has the width S, their
likely size. Let N be the normal matrix of these parameters with all other parameters refitted, and l the eigenvalues of
S N S. The cost of the information gained about the parameters, and the gain from noise alone, are

    cost = sum of ln(1 + l)                     gain = sum of l / (1 + l) chi2_1                     Eq. (3)

where chi2_1 is a random variable with one degree of freedom. Gain minus cost is then twice the logarithm of the
likelihood ratio of the data with and without the random field.

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

from psfcore.arrays import Matrix, Vector, scaled_inverse
from psfcore.gap.evidence.cells import whitening
from psfcore.gap.evidence.responses import Evidence

FLOOR = 0.003  # f of Eq. (2)
UNLIKELY = 10.0  # width of the prior of a parameter, in units of its likely size
WEAKEST = 1e-9  # eigenvalues of a scaled normal matrix below this fraction of the largest one count as zero


@dataclass(frozen=True, eq=False)
class Whitened:
    """One disc, scaled to unit noise.

    Attributes
    ----------
    residual
        The residual of each cell (cells,).
    jacobian
        The change of the cells by one unit of each column (columns, cells).
    white
        The whitening matrix.
    """

    index: int
    residual: Vector
    jacobian: Matrix
    white: Matrix


@dataclass(frozen=True, eq=False)
class Step:
    """A linear fit of some columns (parameters).

    Attributes
    ----------
    values
        The fitted parameters.
    covariance
        The covariance of these parameters.
    fall
        The decrease of chi2 by all columns together.
    """

    columns: tuple[int, ...]
    values: Vector
    covariance: Matrix
    fall: float


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Eq. (1) for the evidence of a transit.

    Attributes
    ----------
    floor
        The fraction f of Eq. (2).
    disc_scale, unocculted_scale
        Chi2 per degree of freedom that the discs and the unocculted blocks have without a gap.
    scale_error
        Relative error of disc_scale.
    """

    evidence: Evidence
    floor: float
    disc_scale: float = 1.0
    unocculted_scale: float = 1.0
    scale_error: float = 0.0

    @cached_property
    def discs(self) -> tuple[Whitened, ...]:
        """Every disc scaled to unit noise."""
        out = []
        for disc in self.evidence.discs:
            floor = self.floor**2 * np.outer(disc.expected, disc.expected)
            white = whitening(disc.covariance * self.disc_scale + floor)
            out.append(Whitened(disc.index, white @ disc.residual, disc.jacobian @ white, white))
        return tuple(out)

    def equations(self, images: Sequence[int] | None = None) -> tuple[Matrix, Vector]:
        """The normal matrix and the right-hand side (`score`) of all columns.

        Each result is computed once and kept.

        Parameters
        ----------
        images
            The images to use; None: all.
        """
        key = None if images is None else tuple(images)
        if key not in self._equations:
            evidence, size = self.evidence, self.evidence.size
            of_blocks = evidence.all_unocculted
            if images is not None:
                of_blocks = evidence.unocculted.equations(range(size), images)
            normal, score = np.zeros((size, size)), np.zeros(size)
            for disc in self.discs:
                if images is None or disc.index in images:
                    normal += disc.jacobian @ disc.jacobian.T
                    score += disc.jacobian @ disc.residual
            scale = self.unocculted_scale
            self._equations[key] = normal + of_blocks.normal / scale, score + of_blocks.score / scale
        return self._equations[key]

    @cached_property
    def _equations(self) -> dict[tuple[int, ...] | None, tuple[Matrix, Vector]]:
        return {}

    def fit(self, columns: Sequence[int], equations: tuple[Matrix, Vector] | None = None) -> Step:
        """Fit the coordinates of the PSF and these columns.

        Parameters
        ----------
        equations
            A result of `equations` (None: for all images).
        """
        here = [*self.evidence.base, *columns]
        normal, score = self.equations() if equations is None else equations
        normal, score = normal[np.ix_(here, here)] + np.diag(self._prior[here]), score[here]
        covariance = scaled_inverse(normal, weakest=WEAKEST)
        values = covariance @ score
        return Step(tuple(here), values, covariance, float(score @ values))

    @cached_property
    def _prior(self) -> Vector:
        """1 / variance of the prior of each column; 0 for the coordinates of the PSF."""
        prior = self.evidence.prior
        return np.asarray((prior.likely * np.where(prior.field, 1.0, UNLIKELY)) ** -2.0)

    def pull_of_prior(self, step: Step, taken_out: Vector) -> Vector:
        """How much smaller the fitted values become if the prior also applies to the amounts that were subtracted
        before the fit.

        Parameters
        ----------
        taken_out
            The subtracted amounts, for each column of the fit.
        """
        return np.asarray(step.covariance @ (self._prior[list(step.columns)] * taken_out))

    def learned(self, columns: Sequence[int]) -> Vector:
        """How much the data say about the random fields in `columns`, compared with the prior: l of Eq. (3).

        The other columns of `columns` and the PSF are refitted.
        """
        prior = self.evidence.prior
        field = [column for column in columns if prior.field[column]]
        if not field:
            return np.zeros(0)
        others = [*self.evidence.base, *(column for column in columns if not prior.field[column])]
        here, first = [*others, *field], len(others)
        normal = self.equations()[0][np.ix_(here, here)]
        cross = normal[:first, first:]
        known = scaled_inverse(normal[:first, :first] + np.diag(self._prior[others]), weakest=WEAKEST)
        width = self._prior[field] ** -0.5
        left = (normal[first:, first:] - cross.T @ known @ cross) * np.outer(width, width)
        return np.asarray(np.maximum(np.linalg.eigvalsh(left), 0.0))

    @cached_property
    def base(self) -> Step:
        """The fit of the coordinates of the PSF alone, without any effect."""
        return self.fit(())

    def gain(self, step: Step) -> float:
        """The decrease of chi2 by a fit, compared with the fit of the PSF alone."""
        return max(step.fall - self.base.fall, 0.0)

    def left(self, step: Step) -> tuple[Vector, ...]:
        """The whitened residuals of every disc after a fit."""
        return tuple(d.residual - d.jacobian[list(step.columns)].T @ step.values for d in self.discs)

    def left_unocculted(self, step: Step) -> float:
        """The chi2 of the unocculted blocks after a fit, divided by unocculted_scale."""
        here, theta, unocculted = list(step.columns), step.values, self.evidence.all_unocculted
        fall = 2 * theta @ unocculted.score[here] - theta @ unocculted.normal[np.ix_(here, here)] @ theta
        return float(unocculted.chi2 - fall) / self.unocculted_scale
