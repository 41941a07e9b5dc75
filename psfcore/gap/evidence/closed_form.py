"""The evidence of any set of causes, in closed form.

    y = B beta + sum over causes of A_k c_k + noise,     c_k ~ Normal(0, W_k^2)                          Eq. (1)

y are the residuals in the cells of the discs and the levels of the unocculted blocks, in units of their noise. beta are
the coordinates of the PSF, without a prior; in the blocks, the scene of each pointing (no prior) and the brightness of
each image (the prior of `unocculted_blocks`) are free too. A_k are the columns of a cause: an effect of the library, or
a field (`columns`). With beta, scene and brightness eliminated, let N be the normal matrix and s the score. For the
columns of some causes

    ln E = s^T (N + W^-2)^-1 s / 2 - ln det(1 + W N W) / 2                                               Eq. (2)

relative to no cause (the Bayesian linear model; Rasmussen and Williams 2006, section 2.7). A prior has several
variants, and the evidence is their mean: the size of the coefficients is one of a few multiples of the likely size; a
field with bumps on the detector may act everywhere, or in one square of neighbouring bumps. A parameter that cannot be
negative has half a Gaussian as prior: if its best value is negative, it is left out; otherwise ln E gains ln 2
Phi(value / error). If the template of an effect was chosen among many, the logarithm of the number that the data
distinguish is subtracted.

**The Sun** changes each block by its own amount: relative to its light, by a random sum of polynomials in time. It is a
cause, with the sizes SUN_SIZES of this sum (in units of the scale of the noise) and the two courses SUN_COURSES. Its
coefficients are eliminated block by block, so N with the Sun in the model costs one product of matrices.

**Errors of form.** No linear column is exact. If the change by the most probable causes is so strong that a relative
error FORM_ERROR of it would be visible, this error joins the noise: common to the cells of a disc, or the blocks of an
image, and for each cell and block on its own. In the blocks, the square of a relative change joins it too. It is the
same for all hypotheses.

**Noise.** If the best causes leave more chi2 than noise does, the variance of the noise of the discs, and that of the
blocks, is raised to this ratio (Birge 1932, Phys. Rev. 40, 207).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.special import log_ndtr, logsumexp

from psfcore.arrays import Flags, Matrix, Vector, scaled_inverse
from psfcore.gap.evidence.columns import LIKELY, FieldColumns
from psfcore.gap.evidence.linear_model import WEAKEST, LinearModel
from psfcore.gap.evidence.tree import SUN, Field, family_of, fields_of
from psfcore.gap.evidence.unocculted_blocks import LEAST_IMAGES

Columns = NDArray[np.intp]
Sun = tuple[str, float]  # the course and the size of the Sun in the model

SCALES, FIELD_SCALES = (1.0, 10.0), (1.0, 10.0, 100.0)  # of the coefficients, in units of their likely size
SUN_SIZES = (0.02, 0.1, 0.5)
SUN_COURSES: dict[str, tuple[float, ...]] = {  # sizes of the polynomials of degree 1, 2, ...
    "smooth": (1.0, 0.5, 0.25, 0.125),
    "rough": (1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
}
SUNS: tuple[Sun, ...] = tuple((course, size) for course in SUN_COURSES for size in SUN_SIZES)
FORM_ERROR = 0.05
VISIBLE = 0.5  # errors of form count if they would add this much to chi2


@dataclass(frozen=True, eq=False)
class Form:
    """One form of a cause: an effect of the library, a field, or the Sun, which has no columns.

    Attributes
    ----------
    family
        The name of the family in `tree.FAMILIES`, or the family of an added effect.
    effect
        The name of the library for this form; None: the library has no name for it.
    columns
        The numbers of the columns of this form.
    likely
        The likely sizes of the coefficients of these columns.
    positive
        Whether these coefficients cannot be negative.
    squares
        Groups of coefficients that can act without the others.
    everywhere
        Whether all coefficients can act together.
    log_templates
        The ln of the number of templates that the data distinguish.
    """

    family: str
    effect: str | None
    field: Field | None
    columns: Columns
    likely: Vector
    positive: Flags
    scales: tuple[float, ...] = SCALES
    squares: tuple[Columns, ...] = ()
    everywhere: bool = True
    log_templates: float = 0.0

    @property
    def is_sun(self) -> bool:
        """Whether this is the changing Sun, whose coefficients are eliminated."""
        return self.effect == SUN

    @cached_property
    def variants(self) -> tuple[Variant, ...]:
        """The variants of the prior."""
        sorts = int(self.everywhere) + bool(self.squares)
        parts = [(np.arange(self.columns.size), math.log(sorts))] if self.everywhere else []
        parts += [(one, math.log(sorts * len(self.squares))) for one in self.squares]
        of_scale = math.log(len(self.scales)) + self.log_templates
        return tuple(
            Variant(self, part, scale, cost + of_scale) for part, cost in parts for scale in self.scales
        )


@dataclass(frozen=True, eq=False)
class Variant:
    """One prior of a form.

    Attributes
    ----------
    part
        The coefficients that may differ from 0.
    scale
        The size of these coefficients, in units of the likely size.
    cost
        -ln of the prior probability of the variant.
    """

    form: Form
    part: Columns
    scale: float
    cost: float

    @property
    def columns(self) -> Columns:
        """The numbers of its columns."""
        return self.form.columns[self.part]

    @property
    def width(self) -> Vector:
        """The width of the prior of each column."""
        return np.asarray(self.form.likely[self.part] * self.scale)


@dataclass(frozen=True, eq=False)
class Inexact:
    """The causes whose errors of form join the noise, and the values of their columns."""

    variants: tuple[Variant, ...]
    values: Vector

    def change(self, design: Matrix, numbers: Columns) -> Matrix:
        """The change by these causes.

        Parameters
        ----------
        design
            The columns of the linear model (..., columns).
        numbers
            The numbers of the columns of `design`; other columns are 0 there.
        """
        place = {number: k for k, number in enumerate(numbers.tolist())}
        columns = np.concatenate([one.columns for one in self.variants]).tolist()
        shown = [k for k, column in enumerate(columns) if column in place]
        return np.asarray(design[..., [place[columns[k]] for k in shown]] @ self.values[shown])


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums over the blocks.

    Attributes
    ----------
    normal
        The normal matrix (shown, shown).
    score
        The right-hand sides (shown, data).
    chi2
        The chi2 of each set of data (data,).
    log_det
        The ln det of the covariance that the Sun adds.
    """

    normal: Matrix
    score: Matrix
    chi2: Vector
    log_det: float


class ClosedForm:
    """The evidence of causes for the data of a linear model.

    Parameters
    ----------
    columns
        The columns of the fields of the model.
    inexact
        The causes whose errors of form join the noise.
    draws
        Further data (discs: (cells, draws), blocks: (images, blocks, draws), DN/s in blocks and units of the noise in
        cells) that take the place of the data of the model; every ln E is then an array (draws,).
    """

    def __init__(
        self,
        model: LinearModel,
        columns: FieldColumns | None = None,
        *,
        inexact: Inexact | None = None,
        draws: tuple[Matrix, Matrix] | None = None,
    ) -> None:
        self.model, self._inexact, self._draws = model, inexact, draws
        self.columns = columns or FieldColumns(model.evidence)
        infos, first = model.evidence.image_info, model.evidence.size
        exposures = len({info.exposure_s for info in infos}) > 1
        kinds = len({(info.exposure_s, info.gain_mode) for info in infos}) > 1
        self.spans: dict[Field, range] = {}
        for field in fields_of(sorted({info.pointing for info in infos}), exposures=exposures, kinds=kinds):
            self.spans[field] = range(first, first := first + self.columns.count(field))
        self._size = first
        self._discs, self._values = self._of_discs()
        self._blocks, self._block_count = self._of_blocks()
        self.misfit = (1.0, 1.0)

    @cached_property
    def forms(self) -> tuple[Form, ...]:
        """All forms: the effects of the library, the fields, and the Sun."""
        evidence, found = self.model.evidence, []
        for effect in evidence.effects:
            own = evidence.columns[effect.name][: len(effect.parameters)]
            numbers = np.array(own, dtype=np.intp)
            templates = math.log(max(evidence.templates.get(effect.name, 1.0), 1.0))
            prior = evidence.prior.likely[numbers], evidence.prior.positive[numbers]
            if own:
                found.append(
                    Form(family_of(effect), effect.name, None, numbers, *prior, log_templates=templates)
                )
        for field, span in self.spans.items():
            numbers = np.array(span, dtype=np.intp)
            prior = np.full(len(span), LIKELY), np.zeros(len(span), np.bool_)
            squares = tuple(self.columns.squares(field))
            found.append(
                Form(field.family, None, field, numbers, *prior, FIELD_SCALES, squares, field.everywhere)
            )
        if self._block_count and any(effect.name == SUN for effect in evidence.effects):
            nothing = np.zeros(0)
            found.append(Form("sun", SUN, None, nothing.astype(np.intp), nothing, nothing.astype(np.bool_)))
        return tuple(found)

    # --- sums ----------------------------------------------------------------------------------------------

    def _of_discs(self) -> tuple[Matrix, Matrix]:
        """The columns and the data of all cells, in units of the noise, without the part that a change of the PSF
        absorbs.
        """
        model, base = self.model, len(self.model.evidence.base)
        fields = np.concatenate([self.columns.discs(field) for field in self.spans], axis=2)
        discs = zip(model.discs, fields, strict=True)
        whole = np.concatenate(
            [np.hstack([disc.jacobian.T, disc.white @ own[: disc.residual.size]]) for disc, own in discs]
        )
        values = (
            np.concatenate([disc.residual for disc in model.discs])[:, None]
            if self._draws is None
            else self._draws[0]
        )
        if self._inexact is not None:
            change = self._inexact.change(whole, np.arange(self._size))
            change = change - whole[:, :base] @ np.linalg.lstsq(whole[:, :base], change, rcond=None)[0]
            change *= FORM_ERROR
            ends = np.cumsum([0, *(disc.residual.size for disc in model.discs)])
            for start, end in itertools.pairwise(ends):
                own = change[start:end]
                lower = np.linalg.cholesky(np.eye(own.size) + np.outer(own, own) + np.diag(own**2))
                whole[start:end] = solve_triangular(lower, whole[start:end], lower=True)
                values[start:end] = solve_triangular(lower, values[start:end], lower=True)
        basis = np.linalg.svd(whole[:, :base] / np.linalg.norm(whole[:, :base], axis=0), full_matrices=False)[
            0
        ]
        return whole - basis @ (basis.T @ whole), values - basis @ (basis.T @ values)

    def _of_blocks(self) -> tuple[dict[Sun | None, _Sums], int]:
        """The sums over the blocks without the Sun (None) and with each Sun; and the number of values minus that of
        scenes.
        """
        model, blocks = self.model, self.model.evidence.unocculted
        images, data = blocks.levels.shape[0], 1 if self._draws is None else self._draws[1].shape[-1]
        shown, size = self._shown, self._shown.size
        free = images if self._inexact is None else 2 * images  # brightness, and the errors of form
        bordered = {key: np.zeros((size + free + data,) * 2) for key in (None, *SUNS)}
        log_det, count = dict.fromkeys(SUNS, 0.0), 0
        for pointing in np.unique(blocks.pointing).tolist():
            here = np.flatnonzero((blocks.pointing == pointing) & blocks.part)
            if here.size < LEAST_IMAGES:
                continue
            own = [np.moveaxis(blocks.errors[:, here], 0, -1)]
            own += [self.columns.blocks(one, pointing, here.tolist()) for one in self.spans if one.in_blocks]
            columns = np.concatenate(own, axis=2)
            variance = blocks.variance[here] * model.unocculted_scale
            change = np.zeros(variance.shape)
            if self._inexact is not None:
                # The scene absorbs what all images share.
                change = self._inexact.change(columns, self._in_blocks)
                seen = np.where(blocks.free[here], 1 / variance, 0.0)
                change -= (seen * change).sum(axis=0) / np.maximum(seen.sum(axis=0), 1e-300)
                change *= np.hypot(FORM_ERROR, change / np.maximum(blocks.means[here], 1e-9))
            weight = np.where(blocks.free[here], 1 / (variance + change**2), 0.0)
            use = (weight > 0).sum(axis=0) >= LEAST_IMAGES
            if not use.any():
                continue
            weight, each = weight[:, use], np.arange(here.size)
            design = np.zeros((here.size, int(use.sum()), size + free + data))
            design[..., :size] = columns[:, use][..., np.isin(self._in_blocks, shown)]
            design[each, :, size + here] = blocks.means[here][:, use] * blocks.gain_width
            if self._inexact is not None:
                design[each, :, size + images + here] = change[:, use]
            levels = blocks.levels[..., None] if self._draws is None else self._draws[1]
            design[..., size + free :] = levels[here][:, use]
            flat = _centred(design, weight)
            rows = flat.reshape(-1, flat.shape[-1])
            normal = rows.T @ rows
            count += int((weight > 0).sum()) - int(use.sum())
            for key in bordered:
                bordered[key] += normal
            for course, sun in self._sun_of(here, blocks.means[here][:, use], weight).items():
                across = np.matmul(sun.transpose(1, 2, 0), flat.transpose(1, 0, 2))
                inner = np.einsum("nbk,nbl->bkl", sun, sun)
                for sun_size in SUN_SIZES:
                    lower = np.linalg.cholesky(np.eye(inner.shape[1]) + sun_size**2 * inner)
                    taken = np.linalg.solve(lower, sun_size * across).reshape(-1, across.shape[2])
                    bordered[course, sun_size] -= taken.T @ taken
                    log_det[course, sun_size] += 2 * float(np.log(np.einsum("bkk->bk", lower)).sum())
        out: dict[Sun | None, _Sums] = {}
        kept, nuisances = np.r_[0:size, size + free : size + free + data], slice(size, size + free)
        steady = 0.0
        for key in (None, *SUNS):
            whole = bordered.pop(key)
            lower = cholesky(whole[nuisances, nuisances] + np.eye(free), lower=True)
            across = solve_triangular(lower, whole[nuisances][:, kept], lower=True)
            left = whole[np.ix_(kept, kept)] - across.T @ across
            own_det = 2 * float(np.log(np.diag(lower)).sum())
            steady = own_det if key is None else steady
            more = 0.0 if key is None else log_det[key] + own_det - steady
            out[key] = _Sums(left[:size, :size], left[:size, size:], np.diag(left)[size:], more)
        return out, count

    @cached_property
    def _in_blocks(self) -> Columns:
        """The numbers of the columns that are computed for the blocks: of effects, and of fields that blocks show."""
        spans = [np.array(span) for field, span in self.spans.items() if field.in_blocks]
        return np.concatenate([np.arange(self.model.evidence.size), *spans]).astype(np.intp)

    @cached_property
    def _shown(self) -> Columns:
        """Those of `_in_blocks` that differ from 0 in some block."""
        errors = self.model.evidence.unocculted.errors
        seen = np.flatnonzero(np.abs(errors).max(axis=(1, 2), initial=0.0) > 0)
        return np.concatenate([seen, self._in_blocks[errors.shape[0] :]]).astype(np.intp)

    @cached_property
    def _place(self) -> Columns:
        """For each column its place in `_shown`; -1 if the blocks do not show it."""
        out = np.full(self._size, -1, dtype=np.intp)
        out[self._shown] = np.arange(self._shown.size)
        return out

    def _sun_of(self, images: Columns, means: Matrix, weight: Matrix) -> dict[str, Matrix]:
        """For each course: the change of the blocks of these images by each polynomial (images, blocks, polynomials),
        in units of the noise.
        """
        times = np.array([self.model.evidence.image_info[n].time_s for n in images])
        at = 2 * (times - times.min()) / max(float(np.ptp(times)), 1e-9) - 1
        out = {}
        for name, sizes in SUN_COURSES.items():
            terms = min(len(sizes), images.size - 1)
            basis = np.polynomial.legendre.legvander(at, terms)[:, 1:] * np.array(sizes[:terms])
            out[name] = _centred(basis[:, None, :] * means[..., None], weight)
        return out

    # --- evidence ------------------------------------------------------------------------------------------

    def normal(
        self, columns: Columns, sun: Sun | None = None, misfit: tuple[float, float] | None = None
    ) -> Matrix:
        """N of some columns."""
        of_discs, of_blocks = misfit or self.misfit
        discs = self._discs[:, columns]
        out = discs.T @ discs / of_discs
        shown = np.flatnonzero(self._place[columns] >= 0)
        if shown.size:
            places = self._place[columns[shown]]
            out[np.ix_(shown, shown)] += self._blocks[sun].normal[np.ix_(places, places)] / of_blocks
        return np.asarray(out)

    def score(
        self, columns: Columns, sun: Sun | None = None, misfit: tuple[float, float] | None = None
    ) -> Matrix:
        """S of some columns (columns, data)."""
        of_discs, of_blocks = misfit or self.misfit
        out = self._discs[:, columns].T @ self._values / of_discs
        shown = np.flatnonzero(self._place[columns] >= 0)
        out[shown] += self._blocks[sun].score[self._place[columns[shown]]] / of_blocks
        return np.asarray(out)

    def forget_suns(self) -> None:
        """Free the matrices with the Sun in the model, most of the memory. Later calls must not name a Sun."""
        self._blocks = {None: self._blocks[None]}

    def of_sun(self, sun: Sun | None) -> Vector:
        """Ln E of the Sun alone, relative to no cause (data,)."""
        fall = (self._blocks[None].chi2 - self._blocks[sun].chi2) / self.misfit[1]
        return np.asarray((fall - self._blocks[sun].log_det) / 2)

    def of_form(self, form: Form) -> tuple[Vector, Variant | None]:
        """Ln E of one form alone, relative to no cause (data,), and its best variant for the first data (None for the
        Sun).
        """
        if form.is_sun:
            return self.together([], SUNS), None
        # The squares have the same number of coefficients, so they are computed in one stack.
        alone = [one for one in form.variants if one.part.size == form.columns.size]
        each = [self._log_evidence([one], None) - one.cost for one in alone]
        squares = [one for one in form.variants if one.part.size < form.columns.size]
        if squares:
            each += list(self._of_squares(squares))
        whole = np.array(each)
        return logsumexp(whole, axis=0), [*alone, *squares][int(np.argmax(whole[:, 0]))]

    def _of_squares(self, squares: Sequence[Variant]) -> Matrix:
        """Ln E of variants with the same number of columns, of any sign, minus their cost (variants, data)."""
        form = squares[0].form
        normal, score = self.normal(form.columns), self.score(form.columns)
        parts = np.array([one.part for one in squares])
        width = np.array([one.width for one in squares])[:, :, None]
        inner = normal[parts[:, :, None], parts[:, None, :]] * width * np.swapaxes(width, 1, 2)
        lower = np.linalg.cholesky(np.eye(parts.shape[1]) + inner)
        z = np.linalg.solve(lower, score[parts] * width)
        log_det = np.log(np.einsum("kcc->kc", lower)).sum(axis=1)
        cost = np.array([one.cost for one in squares])
        return np.asarray((z**2).sum(axis=1) / 2 - (log_det + cost)[:, None])

    def together(self, variants: Sequence[Variant], suns: Sequence[Sun | None] = (None,)) -> Vector:
        """Ln E of variants that act together, relative to no cause (data,): the mean over these Suns."""
        each = np.array([self._log_evidence(variants, sun) for sun in suns])
        return np.asarray(logsumexp(each, axis=0) - math.log(len(each)) - sum(one.cost for one in variants))

    def _log_evidence(self, variants: Sequence[Variant], sun: Sun | None) -> Vector:
        """Eq. (2) (data,). The signs of parameters count only if there is one set of data."""
        found = self.of_sun(sun)
        if not variants:
            return found
        columns, width, positive, owner = _joined(variants)
        while True:
            inner = np.eye(columns.size) + self.normal(columns, sun) * np.outer(width, width)
            score = self.score(columns, sun) * width[:, None]
            lower = cholesky(inner, lower=True, check_finite=False)
            z = solve_triangular(lower, score, lower=True, check_finite=False)
            value = found + (z**2).sum(axis=0) / 2 - float(np.log(np.diag(lower)).sum())
            if not positive.any() or score.shape[1] > 1:
                return np.asarray(value)
            inverse = np.linalg.inv(inner)
            ratio = (inverse @ score[:, 0]) / np.sqrt(np.diag(inverse))
            if not (positive & (ratio < 0)).any():
                return np.asarray(value + float(np.sum(math.log(2) + log_ndtr(ratio[positive]))))
            keep = np.arange(columns.size) != np.argmin(np.where(positive, ratio, np.inf))
            columns, width, positive, owner = columns[keep], width[keep], positive[keep], owner[keep]
            if np.unique(owner).size < len(variants):  # a cause that cannot remove light does not act
                return np.full(found.shape, -np.inf)

    def fitted(self, variants: Sequence[Variant], sun: Sun | None = None) -> tuple[Vector, Matrix]:
        """Values and covariance of all columns of these variants, fitted together to the first data; a parameter with
        the wrong sign is 0.
        """
        columns, width, positive, _ = _joined(variants)
        normal, score = self.normal(columns, sun), self.score(columns, sun)[:, 0]
        keep = np.ones(columns.size, np.bool_)
        out, covariance = np.zeros(columns.size), np.zeros((columns.size,) * 2)
        while keep.any():
            at = np.flatnonzero(keep)
            inverse = scaled_inverse(normal[np.ix_(at, at)] + np.diag(width[at] ** -2.0), weakest=WEAKEST)
            values = inverse @ score[at]
            below = positive[at] & (values < 0)
            if not below.any():
                out[at], covariance[np.ix_(at, at)] = values, inverse
                break
            keep[at[np.argmin(np.where(below, values / np.sqrt(np.diag(inverse)), 0.0))]] = False
        return out, covariance

    def chi2_left(self, variants: Sequence[Variant], sun: Sun | None = None) -> tuple[float, float]:
        """chi2 per value of the discs and of the blocks after the fit of these variants, with the noise not raised."""
        if variants:
            columns, width, _, _ = _joined(variants)
            whole = self.normal(columns, sun, (1.0, 1.0)) + np.diag(width**-2.0)
            theta = scaled_inverse(whole, weakest=WEAKEST) @ self.score(columns, sun, (1.0, 1.0))[:, 0]
        else:
            columns, theta = np.zeros(0, np.intp), np.zeros(0)
        left = self._values[:, 0] - self._discs[:, columns] @ theta
        shown = np.flatnonzero(self._place[columns] >= 0)
        at, own, blocks = self._place[columns[shown]], theta[shown], self._blocks[sun]
        of_blocks = blocks.chi2[0] - 2 * own @ blocks.score[at, 0] + own @ blocks.normal[np.ix_(at, at)] @ own
        discs = max(left.size - len(self.model.evidence.base), 1)
        return float(left @ left) / discs, max(float(of_blocks), 0.0) / max(self._block_count, 1)


def _joined(variants: Sequence[Variant]) -> tuple[Columns, Vector, Flags, Columns]:
    """Columns, widths and signs of several variants, and for each column the number of its variant."""
    return (
        np.concatenate([one.columns for one in variants]),
        np.concatenate([one.width for one in variants]),
        np.concatenate([one.form.positive[one.part] for one in variants]),
        np.repeat(np.arange(len(variants)), [one.part.size for one in variants]),
    )


def _centred(design: Matrix, weight: Matrix) -> Matrix:
    """The design (images, blocks, columns), changed to units of the noise with the mean scene of each block eliminated.

    Parameters
    ----------
    weight
        The weight of each block (images, blocks).
    """
    # In place: for long transits of large images, the design takes most of the memory of a diagnosis.
    design -= np.einsum("nb,nbc->bc", weight / np.maximum(weight.sum(axis=0), 1e-300), design)
    design *= np.sqrt(weight)[..., None]
    return design
