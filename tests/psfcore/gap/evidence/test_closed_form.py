"""The evidence in closed form, compared with dense Gaussian likelihoods of all cells and blocks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.linalg import null_space
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from psfcore.gap.evidence.closed_form import SUN_COURSES, ClosedForm, Form, Inexact, Sun, Variant
from psfcore.gap.evidence.columns import FieldColumns
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.responses import Evidence
from psfcore.gap.evidence.tree import SUN, Field
from tests.psfcore.gap.linear_models import (
    LIGHT,
    dense,
    drawn,
    sigma_of,
    use_fields,
    with_left,
    with_residuals,
    with_sun,
)

PATCHES = Field("gain_place", "gain", "place", 0.4)
FALLING = Field("offset_time", "offset", "time", 0.8)
SPOT = Field("light_place", "light", "place", 0.1)
WARMING = Field("psf_time", "ring", "time")


@pytest.fixture(autouse=True, scope="module")
def _few_fields() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        use_fields(patched, LIGHT, SPOT, WARMING, PATCHES, FALLING)
        yield


@pytest.fixture(scope="module")
def model(evidence: Evidence) -> LinearModel:
    """An offset in discs and blocks, and noise."""
    return drawn(LinearModel(with_sun(evidence), FLOOR), {("dark_offset", 0): 0.5}, 3)


@pytest.fixture(scope="module")
def closed(model: LinearModel, columns: FieldColumns) -> ClosedForm:
    return ClosedForm(model, columns)


def form_of(closed: ClosedForm, which: str | Field) -> Form:
    return next(one for one in closed.forms if which == (one.field or one.effect))


def variant_of(closed: ClosedForm, which: str | Field, *part: int, scale: float = 1.0) -> Variant:
    """One variant of a form, at no cost, whose coefficients have any sign. part: its coefficients; none: all."""
    form = form_of(closed, which)
    form = replace(form, positive=np.zeros_like(form.positive))
    return Variant(form, np.array(part or range(form.columns.size)), scale, 0.0)


class Rows:
    """All cells and blocks in units of their noise, without what PSF and scenes can change. Those have no prior."""

    def __init__(self, model: LinearModel, columns: FieldColumns) -> None:
        evidence, blocks = model.evidence, model.evidence.unocculted
        self._evidence, self._columns = evidence, columns
        self._white = [
            np.linalg.inv(
                np.linalg.cholesky(d.covariance + model.floor**2 * np.outer(d.expected, d.expected))
            )
            for d in evidence.discs
        ]
        together = blocks.pointing[:, None] == blocks.pointing
        self._use = blocks.free & (together @ blocks.free.astype(int) >= 3)
        self._sigma = np.sqrt(blocks.variance * model.unocculted_scale)
        self._cells = sum(disc.residual.size for disc in evidence.discs)
        scenes = [
            self._of_blocks((blocks.pointing == one)[:, None] & (np.arange(self._use.shape[1]) == block))
            for one in np.unique(blocks.pointing)
            for block in range(self._use.shape[1])
        ]
        psf = [
            self._of_columns([d.jacobian[k] for d in evidence.discs], 0 * blocks.levels)
            for k in evidence.base
        ]
        flat = np.array([*psf, *(one for one in scenes if one.any())])
        self._free = null_space(flat / np.linalg.norm(flat, axis=1)[:, None]).T
        images = np.eye(len(blocks.levels))
        self.bright = (
            self._free
            @ np.array([self._of_blocks(one[:, None] * blocks.means * blocks.gain_width) for one in images]).T
        )
        self.data = self._free @ self._of_columns([d.residual for d in evidence.discs], blocks.levels)

    def _of_columns(self, discs: Sequence[np.ndarray], blocks: np.ndarray) -> np.ndarray:
        cells = np.concatenate([white @ one for white, one in zip(self._white, discs, strict=True)])
        return np.concatenate([cells, (blocks / self._sigma)[self._use]])

    def _of_blocks(self, blocks: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros(self._cells), (blocks / self._sigma)[self._use]])

    def of(self, variant: Variant) -> np.ndarray:
        """The change by each coefficient of a variant, of its likely size (rows, coefficients)."""
        evidence, field = self._evidence, variant.form.field
        found = []
        for k, width in zip(variant.part, variant.width, strict=True):
            if field is None:
                column = variant.form.columns[k]
                change = [d.jacobian[column] for d in evidence.discs], evidence.unocculted.errors[column]
            else:
                discs = zip(evidence.discs, self._columns.discs(field), strict=True)
                change = [c[: d.residual.size, k] for d, c in discs], self._columns.all_blocks(field)[..., k]
            found.append(width * self._free @ self._of_columns(*change))
        return np.array(found).T

    def of_sun(self, sun: Sun) -> np.ndarray:
        """The change by the Sun: each block by its own polynomials (rows, blocks x polynomials)."""
        course, size = sun
        blocks, found = self._evidence.unocculted, []
        times = np.array([info.time_s for info in self._evidence.image_info])
        for one in np.unique(blocks.pointing):
            here = blocks.pointing == one
            first, last = times[here].min(), times[here].max()
            for degree, likely in enumerate(SUN_COURSES[course][: here.sum() - 1], 1):
                curve = here * np.polynomial.Legendre.basis(degree)(2 * (times - first) / (last - first) - 1)
                for block in np.eye(blocks.means.shape[1]):
                    found.append(self._of_blocks(size * likely * curve[:, None] * blocks.means * block))
        return self._free @ np.array(found).T

    def log_evidence(self, *random: np.ndarray) -> float:
        """ln of the likelihood of all rows with these random changes, relative to none of them."""

        def log_likelihood(*changes: np.ndarray) -> float:
            covariance = np.eye(self.data.size) + sum(one @ one.T for one in (self.bright, *changes))
            return float(multivariate_normal(cov=covariance).logpdf(self.data))

        return log_likelihood(*random) - log_likelihood()


@pytest.fixture(scope="module")
def rows(model: LinearModel, columns: FieldColumns) -> Rows:
    return Rows(model, columns)


def test_the_evidence_of_causes_is_that_of_dense_gaussians(closed: ClosedForm, rows: Rows) -> None:
    offset = variant_of(closed, "dark_offset")
    for variants in (
        [offset],
        [variant_of(closed, "dark_offset", scale=10.0)],
        [variant_of(closed, LIGHT)],
        [variant_of(closed, WARMING, scale=10.0)],
        [offset, variant_of(closed, LIGHT, 1, 2)],
        [variant_of(closed, "column_smear"), variant_of(closed, WARMING)],
    ):
        exact = rows.log_evidence(*map(rows.of, variants))
        assert closed.together(variants)[0] == pytest.approx(exact, rel=1e-6, abs=1e-6)
    assert abs(rows.log_evidence(rows.of(offset))) > 1


def test_the_evidence_of_the_sun_is_that_of_blocks_that_change(closed: ClosedForm, rows: Rows) -> None:
    offset = variant_of(closed, "dark_offset")
    suns: list[Sun] = [("smooth", 0.02), ("rough", 0.5)]
    alone = [rows.log_evidence(rows.of_sun(sun)) for sun in suns]
    assert [closed.of_sun(sun)[0] for sun in suns] == pytest.approx(alone, rel=1e-6)
    beside = [rows.log_evidence(rows.of(offset), rows.of_sun(sun)) for sun in suns]
    assert [closed.together([offset], [sun])[0] for sun in suns] == pytest.approx(beside, rel=1e-6)
    mean = logsumexp(beside) - math.log(len(suns))
    assert closed.together([offset], suns)[0] == pytest.approx(mean, rel=1e-6)


def test_a_parameter_that_cannot_be_negative_has_half_a_gaussian(
    evidence: Evidence, columns: FieldColumns
) -> None:
    sigma = sigma_of(evidence, "column_smear")
    for share in (5.0, -5.0):
        model = with_residuals(evidence, {"column_smear": share * sigma})
        model = replace(model, evidence=replace(model.evidence, unocculted=evidence.unocculted))
        closed, rows = ClosedForm(model, columns), Rows(model, columns)
        half = Variant(form_of(closed, "column_smear"), np.array([0]), 10.0, 0.0)
        (change,) = rows.of(half).T
        whitener = np.linalg.inv(np.eye(change.size) + rows.bright @ rows.bright.T)
        strengths = np.linspace(0, 12, 200_001)
        normal, score = change @ whitener @ change, change @ whitener @ rows.data
        grown = math.sqrt(2 / math.pi) * np.exp(score * strengths - (normal + 1) * strengths**2 / 2)
        odds = pytest.approx(math.log(trapezoid(grown, strengths)), rel=1e-6) if share > 0 else -math.inf
        assert closed.together([half])[0] == odds
        # The fit leaves it out too.
        (value,), _ = closed.fitted([half])
        assert value == (pytest.approx(share * sigma, rel=0.1) if share > 0 else 0.0)


def test_a_form_is_the_mean_over_its_variants(closed: ClosedForm) -> None:
    for which in (SPOT, PATCHES, LIGHT, "dark_offset"):
        form = form_of(closed, which)
        each = [closed.together([one])[0] for one in form.variants]
        log_evidence, best = closed.of_form(form)
        assert log_evidence[0] == pytest.approx(logsumexp(each), rel=1e-9)
        assert best is form.variants[int(np.argmax(each))]
        assert sum(math.exp(-one.cost) for one in form.variants) == pytest.approx(1.0)
    assert {one.part.size for one in form_of(closed, SPOT).variants} == {4}
    # A search among ten templates costs a factor of ten.
    searched = replace(form_of(closed, "dark_offset"), log_templates=math.log(10.0))
    cost = closed.of_form(form_of(closed, "dark_offset"))[0] - closed.of_form(searched)[0]
    assert cost == pytest.approx(math.log(10.0))
    assert closed.of_form(form_of(closed, SUN))[1] is None


def test_draws_give_what_separate_data_give(
    evidence: Evidence, model: LinearModel, columns: FieldColumns
) -> None:
    models = [model, drawn(replace(model, evidence=evidence), {}, 5)]
    discs = np.array([np.concatenate([disc.residual for disc in one.discs]) for one in models]).T
    levels = np.stack([one.evidence.unocculted.levels for one in models], axis=-1)
    together = ClosedForm(model, columns, draws=(discs, levels))
    for which in ("dark_offset", SPOT, WARMING, SUN):
        alone = [
            float(closed.of_form(form_of(closed, which))[0][0])
            for closed in (
                ClosedForm(replace(model, evidence=with_sun(one.evidence)), columns) for one in models
            )
        ]
        assert together.of_form(form_of(together, which))[0] == pytest.approx(alone, rel=1e-6), which


def test_raised_noise_counts_as_noise(model: LinearModel, columns: FieldColumns) -> None:
    """The variance of the discs is four times, and that of the blocks nine times, as large."""
    closed = ClosedForm(replace(model, floor=0.0), columns)
    closed.misfit = (4.0, 9.0)
    blocks = model.evidence.unocculted
    wide = replace(model.evidence, unocculted=replace(blocks, given_gain_width=3 * blocks.gain_width))
    noisy = ClosedForm(
        replace(model, evidence=wide, floor=0.0, disc_scale=4.0, unocculted_scale=9.0), columns
    )
    for which in ("dark_offset", LIGHT, WARMING):
        raised, exact = (one.of_form(form_of(one, which))[0][0] for one in (closed, noisy))
        assert raised == pytest.approx(exact, rel=1e-6)
    variants = [variant_of(closed, "dark_offset")]
    assert closed.chi2_left(variants)[0] == pytest.approx(4 * noisy.chi2_left(variants)[0], rel=1e-3)


def test_the_fit_of_causes_leaves_their_noise(model: LinearModel, closed: ClosedForm) -> None:
    variants = [variant_of(closed, "dark_offset")]
    values, covariance = closed.fitted(variants)
    assert values[0] == pytest.approx(0.5, abs=4 * math.sqrt(covariance[0, 0]))
    before, after = closed.chi2_left([]), closed.chi2_left(variants)
    cells = dense(model)[1].size - len(model.evidence.base)
    assert after[0] == pytest.approx(1.0, abs=3 * math.sqrt(2 / cells)) and after[1] == pytest.approx(
        1.0, abs=0.3
    )
    assert sum(before) > sum(after)


def test_an_error_of_form_of_a_strong_cause_hides_what_is_a_small_share_of_it(
    evidence: Evidence, columns: FieldColumns
) -> None:
    """An offset of 1000 DN that falls by 3 % in time: only an exact model needs a second cause for that."""
    (offset,), blocks = evidence.columns["dark_offset"], evidence.unocculted
    model = drawn(LinearModel(evidence, FLOOR), {("dark_offset", 0): 1000.0}, 1)
    more = 30.0 * np.linspace(0.5, -0.5, len(evidence.image_info))
    changed = with_left(model, lambda disc: disc.residual + more[disc.index] * disc.jacobian[offset])
    levels = model.evidence.unocculted.levels + more[:, None] * blocks.errors[offset]
    seen = replace(changed.evidence, unocculted=replace(model.evidence.unocculted, levels=levels))
    exact = ClosedForm(replace(changed, evidence=seen), columns)
    first = variant_of(exact, "dark_offset", scale=1000.0)
    second = variant_of(exact, FALLING)
    inexact = ClosedForm(exact.model, columns, inexact=Inexact((first,), exact.fitted([first])[0]))
    gains = [float((one.together([first, second]) - one.together([first]))[0]) for one in (exact, inexact)]
    assert gains[0] > 10 and gains[1] < 3
    assert inexact.together([first])[0] > 100
