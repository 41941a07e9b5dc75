"""The fields of an unknown cause: where it acts, what kind of change it is, and how large it can be.

A field is fitted in the linear model, beside the effects of the hypothesis that contains it; if these effects were refitted,
in the model of that refit. Its strength is its value at the point where it is clearest, in units of its error.

The distance of a field from an effect of the library is the square root of the chi2 that remains if the effect is fitted to the
change by the field: below 3 the data hardly tell them apart.

The bound of a field is the largest value at the discs that the data allow with a probability of 95 %: the largest sum of the value
and UPPER errors over the places of the discs, or over the times of the images. The prior of the coefficients has ten times the likely width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psfcore.arrays import scaled_inverse
from psfcore.gap.evidence.fields import Field, FieldColumns, FieldShape
from psfcore.gap.evidence.likelihood import Likelihood
from psfcore.gap.evidence.linear_model import WEAKEST, LinearModel
from psfcore.gap.verdict.posterior import Form, Names, Posterior

LIKELY_FIELD = 0.05  # fields with a smaller probability are not listed
MOST_FIELDS = 4
MOST_ALIKE = 3
UPPER = 1.645  # 95 % of a Gaussian lie below this number of errors


@dataclass(frozen=True, eq=False)
class UnknownField:
    """A field of an unknown cause.

    beside: the effects of the library that act beside it. probability: if an unknown cause acts. resembles: the effects of the
    library that it resembles most, with their distance in sigma.
    """

    field: Field
    beside: Names
    probability: float
    shape: FieldShape
    resembles: tuple[tuple[str, float], ...]

    @property
    def form(self) -> Form:
        """The form of the hypothesis that contains the field."""
        return Form(self.beside, self.field)

    @property
    def strength(self) -> tuple[float, float] | None:
        """The value where the field is clearest, and its error; None if the field has no shape."""
        if not self.shape.values.size:
            return None
        k = self.shape.clearest
        return float(self.shape.values[k]), float(self.shape.sigma[k])


def unknown_fields(model: LinearModel, columns: FieldColumns, found: Posterior) -> tuple[UnknownField, ...]:
    """The most probable fields if an unknown cause acts, the most probable first. model: without any refit; columns: its fields."""
    shares = found.fields()
    listed = [one for one, share in shares.items() if share >= LIKELY_FIELD][:MOST_FIELDS]
    models = {beside: found.models.get(Form(beside), model) for beside, _ in listed}
    of_models = {beside: FieldColumns(own.evidence, columns) for beside, own in models.items()}
    return tuple(
        _fitted(models[beside], of_models[beside], found, Form(beside, field), shares[beside, field])
        for beside, field in listed
    )


def _fitted(
    model: LinearModel, columns: FieldColumns, found: Posterior, form: Form, share: float
) -> UnknownField:
    assert form.field is not None
    evidence = model.evidence
    likelihood = Likelihood(model).with_further(columns.of(form.field))
    further = list(likelihood.further_columns)
    groups = [list(evidence.columns[name]) for name in form.effects]
    # The template error of the effects follows from their values in the fit of the form.
    weighed = found.forms[form]
    values = dict(zip(weighed.columns, weighed.values, strict=True))
    start = [values.get(c, 0.0) for group in groups for c in group] + [0.0] * len(further)
    coefficients, covariance = likelihood.fitted([*groups, further], start)
    own = slice(-len(further), None)
    shape = columns.shown(form.field, coefficients[own], covariance[own, own])
    alike = _distances(
        likelihood, {e.name: evidence.columns[e.name] for e in evidence.effects}, coefficients[own]
    )
    nearest = sorted(alike.items(), key=lambda one: one[1])[:MOST_ALIKE]
    return UnknownField(form.field, form.effects, share, shape, tuple(nearest))


def _distances(
    likelihood: Likelihood, effects: Mapping[str, Sequence[int]], coefficients: np.ndarray
) -> dict[str, float]:
    """The distance of a field with these coefficients from each effect, in sigma."""
    columns = [c for own in effects.values() for c in own]
    at = {column: k for k, column in enumerate(columns)}
    normal = likelihood.normal([*columns, *likelihood.further_columns])
    field = slice(len(columns), None)
    whole = float(coefficients @ normal[field, field] @ coefficients)
    out = {}
    for name, own in effects.items():
        here = [at[column] for column in own]
        across = normal[here, field] @ coefficients
        fits = float(across @ scaled_inverse(normal[np.ix_(here, here)], weakest=WEAKEST) @ across)
        out[name] = float(np.sqrt(max(whole - fits, 0.0)))
    return out


def bounds(
    model: LinearModel, columns: FieldColumns, fields: Sequence[Field]
) -> dict[Field, tuple[float, str]]:
    """The bound of each of these fields that has a map of the detector or a curve in time, and its unit."""
    likelihood = Likelihood(model)
    places = np.array([(info.x_px, info.y_px) for info in model.evidence.image_info])
    out = {}
    for field in fields:
        if field.stage in (None, "optics"):
            continue
        with_field = likelihood.with_further(columns.of(field))
        further = list(with_field.further_columns)
        shape = columns.shown(field, *with_field.fitted([further], [0.0] * len(further)))
        here = np.arange(shape.values.size)
        if shape.axes == ("x_px", "y_px"):
            here = np.hypot(*(shape.at[:, None] - places[None]).transpose(2, 0, 1)).argmin(axis=0)
        out[field] = float(np.max(np.abs(shape.values[here]) + UPPER * shape.sigma[here])), shape.unit
    return out
