"""The likelihood of a hypothesis: how probable the data are if some effects act, whatever their strengths.

    y = J theta + delta * change + noise                                                Eq. (1)

y are the residuals in the cells of the discs and the levels of the unocculted blocks. theta are the coordinates of the PSF
and the parameters of the effects. change is the change by an effect; in the discs, only the part that a change of the PSF
cannot absorb. No template is exact: delta is its relative error, a Gaussian.
One delta is common to all cells of a disc (or all blocks of an image) and one belongs to each cell (or block); their
variance is added to the variance of the noise. Some templates are nearly exact, and others are not. The width of the Gaussian is
therefore unknown: the evidence is the mean over the widths TEMPLATE_ERRORS. A field (`evidence.fields`) is
random and has no template, so it has no template error. The scene and the brightness of each image are parameters of the
unocculted blocks, as in `unocculted_blocks`.

ln det of the covariance, which the template error raises, counts as a part of chi2.

The noise itself is known only to the relative error scale_error of one simulation, and no hypothesis describes a
changing Sun completely. Let chi2 be the chi2 of the n numbers of the discs, or of the n numbers of the blocks. With
nu = 2 / scale_error^2,

    s = (nu + chi2) / (nu + n),    ln L = (nu + n) (s^-k - 1) / (2 k),  k = CORRELATED    Eq. (2)

For s near 1 this is -chi2 / 2 plus a constant. Residuals far above the noise are correlated between blocks.
Eq. (2) therefore gives them less weight, so that a misfit of all hypotheses does not decide between the hypotheses.

The strengths are integrated out. Near the best fit ln L is a quadratic form with the normal matrix N, and a parameter has a
Gaussian prior of width w, its likely size times one of SCALES with equal probability. The coefficients of a random field
have the same factor, because the field can be stronger than is likely:

    ln E = ln L + ln det(1 + w N w)^-1/2 + terms of the prior                             Eq. (3)

N is the normal matrix of the strengths with the PSF free (its Schur complement). The integral is computed in the
Laplace approximation. Parameters that cannot be negative follow `evidence.one_sided`. If a template was chosen among many,
the logarithm of the number that the data distinguish (`search.distinguished`) is subtracted from ln E. For each number that was
measured in the blocks to build a template, MEASURED is added to the chi2 of the blocks: noise alone lowers this chi2 by 1 for
each number, and the likely size of the number is unknown.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp

from psfcore.arrays import scaled_inverse
from psfcore.gap.evidence.evidence import Prior
from psfcore.gap.evidence.linear_model import WEAKEST, LinearModel
from psfcore.gap.evidence.one_sided import log_odds_above_zero, log_odds_at_zero, log_of_any_number
from psfcore.gap.evidence.unocculted_blocks import LEAST_IMAGES

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Planes = NDArray[np.float64]

TEMPLATE_ERRORS = (0.0, 0.03)
USUAL_ERROR = TEMPLATE_ERRORS[1]
# What remains of the change by the PSF after a step of one `largest_step` of a coordinate, relative to its first order, if the PSF is
# fitted again: 0.004 to 0.014 for three power laws, in proportion to the step, but at most 0.04 after four such steps.
CURVATURE, MOST_CURVATURE = 0.012, 0.05
UNSEEN = 0.5  # if the largest template error adds less than this to chi2, its width does not matter
CORRELATED = 0.5
MEASURED = 2.0
# An effect of a tenth of its likely size often changes nothing that the data show. It is then as probable as "no effect", whatever the
# data: with a further scale of 0.1, answer sets of the same coverage have 2.8 members instead of 2.4 (144 simulated cases).
SCALES = (1.0, 10.0)
ROUNDS = 3  # the template error depends on the fitted strengths
SETTLED = 0.01
SMALLEST_SCALE = 0.2


@dataclass(frozen=True, eq=False)
class Directions:
    """Further columns: changes of the data that no effect of the library makes.

    discs: (discs, cells, columns), DN/s, with the cells of `LinearModel.evidence`, padded with zeros. unocculted: (columns,
    images, blocks), DN/s. width: the width of the prior of each column.
    """

    discs: Planes
    unocculted: Planes
    width: float


@dataclass(frozen=True, eq=False)
class Weighed:
    """A hypothesis after its fit.

    log_evidence: ln E of Eq. (3), up to a constant that all hypotheses of one model share; minus infinity if one of several
    effects has no parameter with a best value above 0. columns: the columns of the parameters that act, without the coordinates
    of the PSF. values: their best values.
    visible_error: the chi2 that a relative error USUAL_ERROR of the template would add in all data, and the curvature of the
    PSF in the discs (CURVATURE). Only the part of the template that was not subtracted counts, and only the remaining step of the
    PSF. If it is above `refits.VISIBLE`, the first order is not accurate enough.
    """

    log_evidence: float
    columns: tuple[int, ...]
    values: Vector
    visible_error: float


@dataclass(frozen=True, eq=False)
class _Part:
    """Normal equations of the discs or of the blocks.

    bordered: [[N, score], [score^T, y^T C^-1 y]]. count: n of Eq. (2). more: an addition to chi2: ln det C, which the
    template error raises, and the cost of measured numbers.
    """

    bordered: Matrix
    count: int
    more: float

    def chi2(self, theta: Vector) -> float:
        """chi2 for the parameters `theta`."""
        long = np.append(-theta, 1.0)
        return max(float(long @ self.bordered @ long), 0.0) + self.more


class Likelihood:
    """The likelihood of hypotheses about the data of a linear model."""

    def __init__(self, model: LinearModel) -> None:
        evidence = model.evidence
        self._model, self._evidence = model, evidence
        self._base = list(evidence.base)
        cells = max(disc.residual.size for disc in evidence.discs)
        count = len(evidence.discs)
        self._cells = sum(disc.residual.size for disc in evidence.discs)
        self._residual = np.zeros((count, cells, 1))
        self._covariance = np.tile(np.eye(cells), (count, 1, 1))  # unit noise for cells that a disc lacks
        self._jacobian = np.zeros((count, cells, evidence.size))
        for k, disc in enumerate(evidence.discs):
            n = disc.residual.size
            level = disc.expected
            self._residual[k, :n, 0] = disc.residual
            self._jacobian[k, :n] = disc.jacobian.T
            self._covariance[k, :n, :n] = disc.covariance * model.disc_scale + model.floor**2 * np.outer(
                level, level
            )
        self._of_columns = evidence.prior
        self._white = np.linalg.inv(np.linalg.cholesky(self._covariance))
        base = (self._white @ self._jacobian[:, :, self._base]).reshape(-1, len(self._base))
        self._to_base = np.linalg.pinv(base)
        self._normal_of_base = base.T @ base
        self._blocks = list(_pointings(model))
        self._log_det = (0.0, 0.0)  # of discs and blocks without any effect
        self._parts((), np.zeros(len(self._base)), np.zeros(0), 0.0)
        self._stiffness = 2 / max(model.scale_error, 1e-3) ** 2

    def with_further(self, further: Directions) -> Likelihood:
        """The same likelihood with further columns, which follow the columns of the evidence. They have no template error."""
        found = copy.copy(self)
        size, count = self._evidence.size, further.discs.shape[2]
        found._jacobian = np.concatenate([self._jacobian[..., :size], further.discs], axis=2)
        own = self._evidence.prior
        found._of_columns = Prior(
            np.append(own.likely, np.full(count, further.width)),
            np.append(own.positive, np.zeros(count, np.bool_)),
            np.append(own.field, np.ones(count, np.bool_)),
            np.append(own.exact, np.ones(count, np.bool_)),
        )
        found._blocks = [pointing.with_further(further.unocculted, size) for pointing in self._blocks]
        return found

    @property
    def further_columns(self) -> range:
        """The columns of `with_further`."""
        return range(self._evidence.size, self._jacobian.shape[2])

    def weigh(
        self,
        effects: Sequence[Sequence[int]],
        *,
        templates: float = 1.0,
        subtracted: Sequence[float] = (),
    ) -> Weighed:
        """Weigh the hypothesis that some effects act. effects: the columns of each effect.

        templates: the number of templates among which those of the effects were chosen (`search.distinguished`).
        subtracted: the amounts that a full refit subtracted from the images, by column; the fitted values are then the remaining amounts.
        """
        out = dict(zip((c for g in effects for c in g), subtracted, strict=True)) if len(subtracted) else {}
        found = [self._weigh(effects, templates, out, 0.0)]
        first, _ = found[0]
        whole = first.values + np.array([out.get(c, 0.0) for c in first.columns])
        if self._visible_error(first.columns, whole, TEMPLATE_ERRORS[-1]) > UNSEEN:
            found += [self._weigh(effects, templates, out, error) for error in TEMPLATE_ERRORS[1:]]
        evidence = float(logsumexp([one.log_evidence for one, _ in found])) - math.log(len(found))
        best, of_psf = max(found, key=lambda one: one[0].log_evidence)
        visible = self._visible_error(best.columns, best.values, USUAL_ERROR) + self._visible_curvature(
            of_psf
        )
        return replace(best, log_evidence=evidence, visible_error=visible)

    def _weigh(
        self, effects: Sequence[Sequence[int]], templates: float, out: Mapping[int, float], error: float
    ) -> tuple[Weighed, Vector]:
        """As `weigh`, for one width of the template error, and the step of the PSF. The result has no visible_error.

        out: the subtracted amounts, by column.
        """
        groups = [list(group) for group in effects]
        theta = np.zeros(len(self._base) + sum(len(group) for group in groups))
        parts: tuple[_Part, _Part] | None = None
        at_zero: list[int] = []
        for _ in range(ROUNDS + sum(len(group) for group in groups)):
            columns = [c for group in groups for c in group]
            taken = np.array([out.get(c, 0.0) for c in columns])
            parts = self._parts(groups, theta, taken, error)
            after, scales = self._fit(parts, columns, taken)
            acting = after[len(self._base) :] + taken
            below = [
                (value, c)
                for value, c in zip(acting, columns, strict=True)
                if value <= 0 and self._of_columns.positive[c]
            ]
            if below:
                gone = min(below)[1]
                at_zero.append(gone)
                theta = np.delete(after, len(self._base) + columns.index(gone))
                groups = [[c for c in group if c != gone] for group in groups]
                if not all(groups) and len(groups) > 1:  # the other effects alone are another hypothesis
                    return Weighed(-math.inf, (), np.zeros(0), 0.0), np.zeros(len(self._base))
                continue
            settled = np.allclose(after, theta, rtol=SETTLED)
            theta = after
            if settled:
                break
        assert parts is not None
        if at_zero:
            parts = self._parts(groups, theta, taken, error, at_zero)
        amounts = np.array([out.get(c, 0.0) for c in at_zero])
        weighed = self._weighed(parts, theta, scales, columns, taken, at_zero, amounts, effects)
        weighed = replace(weighed, log_evidence=weighed.log_evidence - math.log(templates))
        return weighed, theta[: len(self._base)]

    def normal(self, columns: Sequence[int]) -> Matrix:
        """The normal matrix of some columns if the only error is noise: without template error and without prior.

        PSF, scenes and brightness are free parameters.
        """
        first = len(self._base)
        nothing = np.zeros(len(columns))
        parts = self._parts([list(columns)], np.zeros(first + len(columns)), nothing, 0.0)
        whole = _together(parts, (1.0, 1.0))[0]
        across = whole[:first, first:]
        return np.asarray(
            whole[first:, first:] - across.T @ scaled_inverse(whole[:first, :first], weakest=WEAKEST) @ across
        )

    def gained(self, decrease: Vector) -> Vector:
        """The increase of ln L, Eq. (2), if chi2 of the discs falls from n + `decrease` to n.

        n is the number of cells, which is the chi2 that noise alone gives.
        """
        whole = self._stiffness + self._cells
        return np.asarray(whole * (1 - (1 + decrease / whole) ** -CORRELATED) / (2 * CORRELATED))

    def fitted(
        self, effects: Sequence[Sequence[int]], values: Sequence[float] | Vector
    ) -> tuple[Vector, Matrix]:
        """Two results of a fit of the columns of some effects: their values (of any sign), and the covariance.

        values: approximately the values that the fit finds; they set the template error, whose width is USUAL_ERROR.
        """
        first = len(self._base)
        columns = [column for effect in effects for column in effect]
        theta = np.concatenate([np.zeros(first), np.asarray(values, dtype=np.float64)])
        nothing = np.zeros(len(columns))
        parts = self._parts(effects, theta, nothing, USUAL_ERROR)
        found, scales = self._fit(parts, columns, nothing)
        prior = np.diag(self._prior(columns, SCALES[-1]))
        covariance = scaled_inverse(_together(parts, scales)[0] + prior, weakest=WEAKEST)
        return found[first:], np.asarray(covariance[first:, first:])

    def _prior(self, columns: Sequence[int], scale: float) -> Vector:
        """1 / variance of the prior, for the coordinates of the PSF and then for these columns. 0: no prior, as for
        the PSF."""
        return np.append(np.zeros(len(self._base)), self._of_columns.precision(columns, scale))

    def _fit(
        self, parts: tuple[_Part, _Part], columns: Sequence[int], taken: Vector
    ) -> tuple[Vector, tuple[float, float]]:
        """The best parameters, and s of Eq. (2) for discs and blocks."""
        prior = self._prior(columns, SCALES[-1])
        pull = prior * np.append(np.zeros(len(self._base)), taken)
        scales = (1.0, 1.0)
        for _ in range(6):
            normal, score = _together(parts, scales)
            theta = scaled_inverse(normal + np.diag(prior), weakest=WEAKEST) @ (score - pull)
            after = self._scale(parts[0], theta), self._scale(parts[1], theta)
            done = max(abs(a / b - 1) for a, b in zip(after, scales, strict=True)) < SETTLED
            scales = after
            if done:
                break
        return theta, scales

    def _scale(self, part: _Part, theta: Vector) -> float:
        found = (self._stiffness + part.chi2(theta)) / (self._stiffness + part.count)
        return max(found, SMALLEST_SCALE)

    def _weighed(
        self,
        parts: tuple[_Part, _Part],
        theta: Vector,
        scales: tuple[float, float],
        columns: list[int],
        taken: Vector,
        at_zero: list[int],
        taken_at_zero: Vector,
        effects: Sequence[Sequence[int]],
    ) -> Weighed:
        base, free = len(self._base), theta.size
        every, score = _together(parts, scales)
        normal, across = every[:free, :free], every[free:, :free]
        slope, score = score[free:] - across @ theta, score[:free]
        gradient = score - normal @ theta
        best = sum(
            (self._stiffness + part.count) * (s**-CORRELATED - 1) / (2 * CORRELATED)
            for part, s in zip(parts, scales, strict=True)
        )
        whole = theta + np.append(np.zeros(base), taken)
        positive = self._of_columns.positive[columns]
        one_sided = [c for c in columns if self._of_columns.positive[c]]
        measured = np.array([self._evidence.numbers_of([c]) for c in one_sided], dtype=np.float64)
        cost_of_measured = MEASURED * measured / (2 * scales[1] ** (1 + CORRELATED))
        found = []
        for scale in SCALES if columns or at_zero else (1.0,):
            # Around theta, ln L is quadratic with the matrix N; with this prior its maximum is a step away.
            prior = self._prior(columns, scale)
            inverse = scaled_inverse(normal + np.diag(prior), weakest=WEAKEST)
            step = inverse @ (gradient - prior * whole)
            size, log_det = np.sqrt(np.diag(normal) + prior), 0.0
            log_det = float(np.linalg.slogdet((normal + np.diag(prior)) / np.outer(size, size))[1])
            log_det += 2 * float(np.log(size).sum())
            # The PSF has no prior. The volume of its coordinates must not count, because it differs between refits.
            log_det -= float(np.linalg.slogdet(normal[:base, :base])[1])
            quadratic = float(step @ normal @ step - 2 * gradient @ step + prior @ (whole + step) ** 2)
            values, errors = (whole + step)[base:], np.sqrt(np.diag(inverse)[base:])
            half = float(np.sum(math.log(2) + log_ndtr((values / errors)[positive])))
            # What was subtracted is put back: then these parameters are 0, and their slope and ln L are others.
            left = slope - across @ step
            curvature = np.diag(every)[free:] - np.einsum("ij,jk,ik->i", across, inverse, across)
            put_back = -float(np.sum(left * taken_at_zero + curvature * taken_at_zero**2 / 2))
            at_zero_odds = log_odds_at_zero(
                left + curvature * taken_at_zero, curvature, self._of_columns.likely[at_zero] * scale
            )
            above_zero_odds = log_odds_above_zero(
                values[positive], errors[positive], self._of_columns.likely[one_sided] * scale
            )
            # The evidence contains the cost of their measured numbers.
            above_zero_odds = above_zero_odds - cost_of_measured
            some_at_zero = self._any_number(
                dict(zip(at_zero, at_zero_odds, strict=True)),
                dict(zip(one_sided, above_zero_odds, strict=True)),
                effects,
            )
            found.append(
                best - (quadratic + log_det - np.log(prior[base:]).sum()) / 2 + half + put_back + some_at_zero
            )
        return Weighed(
            float(logsumexp(found)) - math.log(len(found)),
            tuple(columns),
            theta[base:],
            0.0,
        )

    def _any_number(
        self, at_zero: Mapping[int, float], above: Mapping[int, float], effects: Sequence[Sequence[int]]
    ) -> float:
        """ln of the factor of the evidence for the one-sided parameters at 0, and for the number that act.

        at_zero, above: the logarithm of the odds of each one-sided parameter at 0, or above 0, by column. The evidence
        already contains the odds of the parameters above 0.
        """
        total = 0.0
        odds = {**at_zero, **above}
        for effect in effects:
            own = [odds[c] for c in effect if c in odds]
            if own:
                number = log_of_any_number(np.array(own), least=1 if len(own) == len(effect) else 0)
                total += number - sum(above[c] for c in effect if c in above)
        return total

    def _visible_error(self, columns: Sequence[int], values: Vector, error: float) -> float:
        """The chi2 that a relative error of the change by these columns would add. Exact columns have no such error."""
        inexact = ~self._of_columns.exact[list(columns)]
        here, values = np.asarray(columns, dtype=int)[inexact].tolist(), values[inexact]
        if not here:
            return 0.0
        seen = float(np.sum((self._white @ self._net(self._jacobian[:, :, here] @ values)[..., None]) ** 2))
        for pointing in self._blocks:
            change = pointing.errors[..., here] @ values
            seen += float(np.sum(pointing.free * change**2 / pointing.variance))
        return error**2 * seen

    def _visible_curvature(self, step: Vector) -> float:
        """The chi2 of the discs that a step of the coordinates of the PSF adds, because they change the discs not only linearly."""
        too_long = float((np.abs(step) / self._evidence.longest_step).max())
        return min(CURVATURE * too_long, MOST_CURVATURE) ** 2 * float(step @ self._normal_of_base @ step)

    def _net(self, change: Matrix) -> Matrix:
        """The part of a change of the discs (discs, cells) that a change of the PSF cannot absorb."""
        absorbed = self._to_base @ (self._white @ change[..., None]).ravel()
        return np.asarray(change - self._jacobian[:, :, self._base] @ absorbed)

    def _parts(
        self,
        groups: Sequence[Sequence[int]],
        theta: Vector,
        taken: Vector,
        error: float,
        at_zero: Sequence[int] = (),
    ) -> tuple[_Part, _Part]:
        """The normal equations of the PSF, the columns of `groups`, and the columns `at_zero`, in this order."""
        acting = [*self._base, *(c for group in groups for c in group)]
        columns = [*acting, *at_zero]
        whole = theta + np.append(np.zeros(len(self._base)), taken)
        spans, first = [], len(self._base)
        for group in groups:
            if not group or not self._of_columns.exact[group[0]]:
                spans.append((list(group), whole[first : first + len(group)]))
            first += len(group)
        covariance = self._covariance
        if error > 0 and any(values.any() for _, values in spans):
            covariance = covariance.copy()
            diagonal = np.arange(covariance.shape[1])
            for group, values in spans:
                change = error * self._net(self._jacobian[:, :, group] @ values)
                covariance += change[:, :, None] * change[:, None, :]
                covariance[:, diagonal, diagonal] += change**2
        lower = np.linalg.cholesky(covariance)
        design = np.concatenate([self._jacobian[:, :, columns], self._residual], axis=2)
        white = np.linalg.solve(lower, design).reshape(-1, design.shape[2])
        log_det = 2 * float(np.log(np.einsum("dcc->dc", lower)).sum())
        blocks = [pointing.part(columns, spans, error) for pointing in self._blocks]
        size = len(columns) + 1
        measured = self._evidence.numbers_of(acting)
        in_blocks = sum(part.more for part in blocks)
        if not groups:
            self._log_det = log_det, in_blocks
        return _Part(white.T @ white, self._cells, log_det - self._log_det[0]), _Part(
            sum((part.bordered for part in blocks), np.zeros((size, size))),
            sum(part.count for part in blocks),
            in_blocks - self._log_det[1] + MEASURED * measured,
        )


def _together(parts: tuple[_Part, _Part], scales: tuple[float, float]) -> tuple[Matrix, Vector]:
    """Normal matrix and score of Eq. (2) near the best fit."""
    both = sum(
        (part.bordered / s ** (1 + CORRELATED) for part, s in zip(parts, scales, strict=True)),
        np.zeros_like(parts[0].bordered),
    )
    return both[:-1, :-1], both[:-1, -1]


@dataclass(frozen=True, eq=False)
class _Pointing:
    """The unocculted blocks of one pointing: arrays (images, blocks), and `errors` (images, blocks, columns).

    brightness: the change by one standard deviation of the brightness of an image, DN/s. at: the indices of the images and
    blocks among all.
    """

    level: Matrix
    variance: Matrix
    free: NDArray[np.bool_]
    brightness: Matrix
    errors: Planes
    at: tuple[NDArray[np.intp], NDArray[np.intp]]

    def with_further(self, further: Planes, size: int) -> _Pointing:
        """The same blocks, with further columns (columns, all images, all blocks) after the first `size` columns."""
        images, blocks = self.at
        here = np.moveaxis(further[:, images, blocks], 0, -1)
        return replace(self, errors=np.concatenate([self.errors[..., :size], here], axis=2))

    def part(
        self, columns: Sequence[int], effects: Sequence[tuple[list[int], Vector]], error: float
    ) -> _Part:
        """The normal equations of these columns.

        effects: for each effect, its columns and the values of its parameters. The template error is proportional to
        these values. error: the width of the template error.
        """
        images, blocks = self.level.shape
        changes = [error * (self.errors[..., group] @ values) for group, values in effects]
        changes = [change for change in changes if change.any()]
        variance = self.variance + sum((change**2 for change in changes), np.zeros_like(self.variance))
        weight = np.where(self.free, 1 / variance, 0.0)
        total = weight.sum(axis=0)
        nuisances = [self.brightness, *changes]
        kept, own = len(columns), images * len(nuisances)
        design = np.zeros((images, blocks, kept + 1 + own))
        design[..., :kept] = self.errors[..., columns]
        design[..., kept] = self.level
        each = np.arange(images)
        for k, change in enumerate(nuisances):
            design[each, :, kept + 1 + k * images + each] = change
        design -= np.einsum("nb,nbc->bc", weight, design) / total[:, None]  # the scene is free
        flat = (design * np.sqrt(weight)[..., None]).reshape(images * blocks, -1)
        normal = flat.T @ flat
        lower = np.linalg.cholesky(normal[kept + 1 :, kept + 1 :] + np.eye(own))
        across = np.linalg.solve(lower, normal[kept + 1 :, : kept + 1])
        log_det = 2 * np.log(np.diag(lower)).sum() - np.log(weight[self.free]).sum() + np.log(total).sum()
        return _Part(
            normal[: kept + 1, : kept + 1] - across.T @ across,
            int(self.free.sum()) - blocks,
            float(log_det),
        )


def _pointings(model: LinearModel) -> list[_Pointing]:
    """For every pointing: the blocks that at least LEAST_IMAGES images show; pointings without such blocks are left
    out."""
    blocks = model.evidence.unocculted
    found = []
    for pointing in np.unique(blocks.pointing):
        here = np.flatnonzero((blocks.pointing == pointing) & blocks.part)
        shown = blocks.free[here].sum(axis=0) >= LEAST_IMAGES
        if here.size < LEAST_IMAGES or not shown.any():
            continue
        at = here[:, None], np.flatnonzero(shown)[None, :]
        found.append(
            _Pointing(
                level=blocks.levels[at],
                variance=blocks.variance[at] * model.unocculted_scale,
                free=blocks.free[at],
                brightness=blocks.means[at] * blocks.gain_width,
                errors=np.moveaxis(blocks.errors[:, here][:, :, shown], 0, -1),
                at=at,
            )
        )
    return found
