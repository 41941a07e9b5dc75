"""The posterior: a probability for every hypothesis about the cause of the gap.

The hypotheses are: no effect acts (`NONE`); one effect of the library acts; two effects act together; three effects act
together, of which two are the most probable pair; an unknown cause acts (`UNKNOWN`); an effect of the library and an unknown
cause act together. `evidence.likelihood` computes the evidence E of each hypothesis:

    p(h) ~ prior(kind of h) / (number of hypotheses of this kind) * E(h)              Eq. (1)

A hypothesis can have several forms (`Form`): with the forms of the library alone, or with a field (`evidence.fields`). An
unknown cause is one of the fields that have no name; an effect whose form nobody knows has the form of the library, or that
of a field with its name. The evidence of a hypothesis is the mean over its forms: half of the weight belongs to the form of
the library, and the other half to the fields, with equal shares. A field beside an effect is weighed for the effects and fields
that are the most probable alone; the others count as if they had no evidence.

The linear model holds only for a small effect. A full refit of a hypothesis therefore gives this hypothesis a new
evidence. If a single effect was refitted, all pairs with this effect get a new evidence too, and so do the triples of the
most probable of these pairs and the fields beside this effect.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.fields import LIKELY, Field, FieldColumns, fields_of, refittable, with_likely
from psfcore.gap.evidence.fields import UNKNOWN as UNKNOWN_NAME
from psfcore.gap.evidence.likelihood import Likelihood, Weighed
from psfcore.gap.evidence.linear_model import LinearModel

Vector = NDArray[np.float64]
Names = tuple[str, ...]
Kind = Literal["none", "single", "pair", "triple", "unknown", "mixed"]

NONE: Names = ()
UNKNOWN: Names = (UNKNOWN_NAME,)
KINDS: tuple[Kind, ...] = ("none", "single", "pair", "triple")
# Prior probabilities of the kinds: near the maximum of the mean logarithm of the probability of the true cause in 144 simulated cases, for
# one effect, an unknown cause, and one beside the other; the ratios of the others were chosen (`studies.gap_calibration` computes them).
PRIOR: Mapping[Kind, float] = {
    "none": 0.33,
    "single": 0.14,
    "pair": 0.09,
    "triple": 0.01,
    "unknown": 0.31,
    "mixed": 0.12,
}
FORM_OF_LIBRARY = 0.5  # weight of the form of the library, if an effect can also have the form of a field
FIELDS_BESIDE = 3  # the most probable fields, which are weighed beside every effect

# The data do not show a further effect if it makes a hypothesis less probable by this factor. In 144 simulated cases (thresholds of one
# half for the other, prior probabilities before they were fitted anew), the factors 0.2, 0.5 and 1 give sets of 6.0, 5.4 and 5.3 members that cover the true cause in 0.90, 0.89 and 0.88;
# 0.14, 0.21 and 0.22 of the sets are right and have one member; a known effect beside an unknown one is covered in 0.72, 0.67 and 0.56.
IDLE = 0.5


def kind_of(names: Names) -> Kind:
    """The kind of a hypothesis."""
    if UNKNOWN_NAME in names:
        return "unknown" if names == UNKNOWN else "mixed"
    return KINDS[min(len(names), 3)]


def known_effects(names: Names) -> Names:
    """The effects of the library in a hypothesis."""
    return tuple(name for name in names if name != UNKNOWN_NAME)


def name_of(field: Field, order: Names) -> str:
    """The name of the cause that a field stands for. order: the effects that the data can show."""
    return field.effect if field.effect in order else UNKNOWN_NAME


@dataclass(frozen=True)
class Form:
    """A form of a hypothesis. effects: the effects that have the form of the library. field: a field that acts beside them."""

    effects: Names = ()
    field: Field | None = None

    @property
    def refittable(self) -> bool:
        """Whether a full refit can subtract the effects and the field from the images."""
        return self.field is None or refittable(self.field)

    def names(self, order: Names) -> Names:
        """The hypothesis: its effects in the order of the library, and UNKNOWN last."""
        own = {*self.effects, *(() if self.field is None else (name_of(self.field, order),))}
        return (*(name for name in order if name in own), *(name for name in UNKNOWN if name in own))


@dataclass(frozen=True, eq=False)
class Posterior:
    """The evidence of all forms of all hypotheses.

    forms: each form, weighed. order: the effects that these data can show, in the order of the library. models: the model of
    the full refit at which a form was weighed; a form that is missing was weighed in the model without any effect.
    """

    forms: dict[Form, Weighed]
    order: Names
    models: dict[Form, LinearModel] = dataclass_field(default_factory=dict)

    @cached_property
    def hypotheses(self) -> dict[Names, dict[Form, float]]:
        """For each hypothesis, ln of prior times evidence of each of its forms, up to a common constant."""
        every: dict[Names, list[Form]] = {}
        for form in self.forms:
            every.setdefault(form.names(self.order), []).append(form)
        alike = Counter(form.names(self.order) for form in self.forms if form.field and not form.effects)
        out: dict[Names, dict[Form, float]] = {}
        for names, forms in every.items():
            prior = _log_prior(names, len(self.order))
            sorts = {form.field is None for form in forms}
            out[names] = {}
            for form in forms:
                share = (
                    1.0 if len(sorts) == 1 else FORM_OF_LIBRARY if form.field is None else 1 - FORM_OF_LIBRARY
                )
                if form.field is not None:  # the fields of one name have equal shares
                    share /= max(alike[Form((), form.field).names(self.order)], 1)
                out[names][form] = prior + math.log(share) + self.forms[form].log_evidence
        return out

    @property
    def log_weights(self) -> dict[Names, float]:
        """ln of prior times evidence of each hypothesis, up to a common constant."""
        return {names: float(logsumexp(list(forms.values()))) for names, forms in self.hypotheses.items()}

    def leading(self, names: Names) -> Form:
        """The most probable form of a hypothesis."""
        forms = self.hypotheses[names]
        return max(forms, key=lambda form: forms[form])

    def fields(self) -> dict[tuple[Names, Field], float]:
        """The probability of each field, beside these effects, if an unknown cause acts; the most probable first."""
        found = {
            (form.effects, form.field): weight
            for names, forms in self.hypotheses.items()
            if UNKNOWN_NAME in names
            for form, weight in forms.items()
            if form.field is not None
        }
        whole = logsumexp(list(found.values())) if found else 0.0
        shares = {one: float(np.exp(weight - whole)) for one, weight in found.items()}
        return dict(sorted(shares.items(), key=lambda one: -one[1]))

    def probabilities(self, temperature: float = 1.0) -> dict[Names, float]:
        """The probability of each hypothesis, the most probable first. temperature: divides the logarithms of the weights."""
        return probabilities(self.log_weights, temperature)

    def with_evidence(self, forms: Mapping[Form, Weighed], model: LinearModel) -> Posterior:
        """The same posterior with a new evidence for the given forms, which were weighed in the model of a full refit."""
        return replace(self, forms=self.forms | dict(forms), models=self.models | dict.fromkeys(forms, model))

    def without(self, forms: Iterable[Form]) -> Posterior:
        """The same posterior without these forms."""
        gone = set(forms)
        return replace(self, forms={form: w for form, w in self.forms.items() if form not in gone})


def probabilities(log_weights: Mapping[Names, float], temperature: float = 1.0) -> dict[Names, float]:
    """The probability of each hypothesis, from its `Posterior.log_weights`, the most probable first."""
    weights = np.array(list(log_weights.values())) / temperature
    shares = np.exp(weights - logsumexp(weights))
    return _sorted(dict(zip(log_weights, shares.tolist(), strict=True)))


def without_idle(probabilities: Mapping[Names, float]) -> dict[Names, float]:
    """The probabilities, with the improbable pairs and triples merged into hypotheses with fewer effects.

    If a hypothesis is less probable than IDLE times the probability of one of its effects alone, or of two of its three effects,
    its probability is added to that hypothesis: the data then do not show the other effect. A hypothesis in the result
    means these effects alone, or together with an effect that the data do not show.
    """
    out = dict(probabilities)
    for names in sorted(probabilities, key=len, reverse=True):
        fewer = [part for n in range(1, len(names)) for part in itertools.combinations(names, n)]
        # A hypothesis whose refit failed is missing.
        likelier = max(
            (part for part in fewer if part in out), key=lambda part: probabilities[part], default=None
        )
        if likelier is not None and probabilities[names] <= IDLE * probabilities[likelier]:
            out[likelier] += out.pop(names)
    return _sorted(out)


def _sorted(probabilities: Mapping[Names, float]) -> dict[Names, float]:
    return dict(sorted(probabilities.items(), key=lambda one: -one[1]))


def posterior(model: LinearModel, columns: FieldColumns | None = None) -> Posterior:
    """The posterior in the linear model, without any full refit. columns: its fields, if they exist already."""
    evidence = model.evidence
    columns = columns or FieldColumns(evidence)
    likelihood = Likelihood(model)
    order = tuple(effect.name for effect in evidence.effects)
    singles = [Form((name,)) for name in order]
    pairs = [Form(names) for names in itertools.combinations(order, 2)]
    forms = {form: weigh(likelihood, evidence, form) for form in (Form(), *singles, *pairs)}
    forms |= _triples(likelihood, evidence, {form: forms[form] for form in pairs}, order)
    best = sorted(singles, key=lambda form: -forms[form].log_evidence)[:1]
    forms |= _with_fields(likelihood, evidence, columns, [Form(), *best], singles)
    return Posterior(forms, order)


def _with_fields(
    likelihood: Likelihood,
    evidence: Evidence,
    columns: FieldColumns,
    beside: Sequence[Form],
    others: Sequence[Form] = (),
    taken: Mapping[str, Sequence[float]] | None = None,
) -> dict[Form, Weighed]:
    """Weigh every field beside each of these forms, and the most probable fields also beside the `others`."""
    out: dict[Form, Weighed] = {}

    def weigh_beside(field: Field, forms: Sequence[Form]) -> None:
        with_field = likelihood.with_further(columns.of(field))
        for form in forms:
            if field.effect not in form.effects:
                whole = Form(form.effects, field)
                out[whole] = weigh(with_field, evidence, whole, taken)

    fields = fields_of(evidence)
    for field in fields:
        weigh_beside(field, beside)
    best = {
        field: max((w.log_evidence for form, w in out.items() if form.field == field), default=-math.inf)
        for field in fields
    }
    missing = [form for form in others if form not in beside]
    for field in sorted(best, key=lambda one: -best[one])[:FIELDS_BESIDE] if missing else []:
        weigh_beside(field, missing)
    return out


def _triples(
    likelihood: Likelihood,
    evidence: Evidence,
    pairs: Mapping[Form, Weighed],
    order: Names,
    taken: Mapping[str, Sequence[float]] | None = None,
) -> dict[Form, Weighed]:
    """Weigh the triples that contain the most probable of these pairs. taken: as in `at_refit`."""
    if not pairs:
        return {}
    best = max(pairs, key=lambda form: pairs[form].log_evidence).effects
    triples = [Form(Form((*best, other)).names(order)) for other in order if other not in best]
    return {form: weigh(likelihood, evidence, form, taken) for form in triples}


def at_refit(
    refit: LinearModel,
    before: LinearModel,
    columns: FieldColumns,
    form: Form,
    taken: Mapping[str, Sequence[float]],
    moved: Vector,
    order: Names,
) -> tuple[dict[Form, Weighed], LinearModel]:
    """The evidence from a full refit of a form, and the model in which it was weighed.

    After a refit of a single effect in the form of the library, the result also contains the pairs, triples and fields beside it.
    refit: the linear model at the refit, with the effects that may act. before, columns: the linear model without any effect, and
    its fields.     taken: the amounts of the parameters that the refit subtracted from the images, by effect. moved: the coordinates of
    the PSF of the refit minus those of the fit without any effect. order: the effects that the data can show.
    """
    evidence = with_same_data(before.evidence, refit.evidence, taken, moved)
    effects = tuple(with_likely(effect, LIKELY) if effect.exact else effect for effect in evidence.effects)
    model = replace(refit, evidence=replace(evidence, effects=effects))
    likelihood, evidence = Likelihood(model), model.evidence
    found = {form: weigh(likelihood, evidence, form, taken)}
    if form.field is None and len(form.effects) == 1:
        pairs = [
            Form(Form((*form.effects, other)).names(order)) for other in order if other not in form.effects
        ]
        of_pairs = {pair: weigh(likelihood, evidence, pair, taken) for pair in pairs}
        found |= of_pairs | _triples(likelihood, evidence, of_pairs, order, taken)
        found |= _with_fields(likelihood, evidence, FieldColumns(evidence, columns), [form], (), taken)
    return found, model


def with_same_data(
    before: Evidence, after: Evidence, taken: Mapping[str, Sequence[float]], moved: Vector
) -> Evidence:
    """The evidence of a refit (`after`) with the discs and the blocks of the evidence `before` it, minus the change by the effects.

    All hypotheses must explain the same data. A refit can lose discs, for example if an effect that is too strong was subtracted from a
    faint image: the lost discs are taken from before the refit, and respond to PSF and effects linearly. Discs that only the refit can
    use are left out. The change by some effects, for example a halo, is computed from each image and contains a part of its noise; if it
    is subtracted from the images, their blocks have less noise, and this would wrongly count in favour of the effect. taken, moved: as in
    `at_refit`.
    """
    # For each parameter of the effects: its column at the refit, its column before, and the amount that was subtracted.
    of_effects: list[tuple[int, int, float]] = []
    for effect in after.effects:
        columns = before.columns_of(effect.name)
        own = [p.name for p in effect.parameters]
        values = taken.get(effect.name, (0.0,) * len(own))
        of_effects += (
            (column, columns[name], value)
            for name, column, value in zip(own, after.columns[effect.name], values, strict=False)
        )
    blocks = before.unocculted
    errors, levels = np.zeros((after.size, *blocks.levels.shape)), blocks.levels.copy()
    for column, source, amount in of_effects:
        errors[column] = blocks.errors[source]
        levels -= amount * errors[column]
    discs = [disc for disc in after.discs if disc.index in before.images]
    for disc in before.discs:
        if disc.index in after.images:
            continue
        jacobian, residual = np.zeros((after.size, disc.residual.size)), disc.residual.copy()
        for column, source, amount in (
            *zip(after.base, before.base, moved.tolist(), strict=True),
            *of_effects,
        ):
            jacobian[column] = disc.jacobian[source]
            residual -= amount * jacobian[column]
        discs.append(replace(disc, jacobian=jacobian, residual=residual))
    return replace(
        after,
        discs=tuple(sorted(discs, key=lambda disc: disc.index)),
        unocculted=replace(blocks, errors=errors, levels=levels),
    )


def weigh(
    likelihood: Likelihood,
    evidence: Evidence,
    form: Form,
    taken: Mapping[str, Sequence[float]] | None = None,
) -> Weighed:
    """Weigh a form. The columns of its field are those of an effect of the evidence (after a full refit with this field), or the
    further columns of the likelihood. taken: as in `at_refit`."""
    names = form.effects
    if form.field is not None and not likelihood.further_columns:
        names = (*names, form.field.effect)
    columns = [list(evidence.columns_of(name).values()) for name in names]
    before = taken or {}
    subtracted = [
        value
        for name, some in zip(names, columns, strict=True)
        for value in before.get(name, (0.0,) * len(some))
    ]
    further = list(likelihood.further_columns)
    templates = math.prod(evidence.templates.get(name, 1.0) for name in form.effects)
    return likelihood.weigh(
        [*columns, further] if further else columns,
        templates=templates,
        subtracted=[*subtracted, *(0.0 for _ in further)],
    )


def _log_prior(names: Names, effects: int) -> float:
    count = {
        "single": effects,
        "pair": math.comb(effects, 2),
        "triple": math.comb(effects, 3),
        "mixed": effects,
    }
    kind = kind_of(names)
    return math.log(PRIOR[kind] / max(count.get(kind, 1), 1))
