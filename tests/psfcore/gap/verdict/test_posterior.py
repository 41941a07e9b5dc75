"""The posterior: probabilities of hypotheses."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest

from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.fields import Field, FieldColumns
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.library.detector import EFFECTS
from psfcore.gap.verdict.posterior import (
    NONE,
    PRIOR,
    UNKNOWN,
    Form,
    Names,
    Posterior,
    kind_of,
    posterior,
    without_idle,
)
from psfcore.scatter.reconstruction import Solution
from tests.psfcore.gap.linear_models import with_residuals
from tests.psfcore.gap.posteriors import of_evidence, weighed

OFFSET: Names = ("dark_offset",)


def strong_offset(evidence: Evidence) -> LinearModel:
    return replace(with_residuals(evidence, {"dark_offset": 300.0}), scale_error=0.1)


def test_noise_alone_is_no_gap_and_an_offset_is_an_offset(evidence: Evidence, columns: FieldColumns) -> None:
    clean = replace(with_residuals(evidence, {}, noise=0.5), scale_error=0.1)
    for model, best in ((clean, NONE), (with_residuals(evidence, {"dark_offset": 30.0}), OFFSET)):
        found = without_idle(posterior(model, columns).probabilities())
        assert next(iter(found)) == best
        assert sum(found.values()) == pytest.approx(1.0)
        assert UNKNOWN in found
    weak = posterior(with_residuals(evidence, {"dark_offset": 3.0}), columns)
    assert max(weak.probabilities(3.0).values()) < max(weak.probabilities().values())  # a temperature


def test_the_hypotheses_of_a_kind_share_the_prior_of_their_kind() -> None:
    """However many effects the library has: with equal evidence, its pairs together have the prior of a pair."""
    for effects in (4, 7):
        names = [tuple(one) for k in range(4) for one in itertools.combinations("abcdefg"[:effects], k)]
        mixed = [(*one, "unknown") for one in names if len(one) < 2]
        weights = of_evidence(dict.fromkeys([*names, *mixed], 0.0)).log_weights
        for kind, prior in PRIOR.items():
            share = sum(math.exp(weights[one]) for one in weights if kind_of(one) == kind)
            assert share == pytest.approx(prior), kind


def test_an_effect_has_the_form_of_the_library_or_of_a_field_with_its_name() -> None:
    order = ("intensity_gradient", "flat_field_residual")
    wide, gain, fine = (
        Field("detector", form, width) for form, width in (("light", 0.8), ("gain", 0.4), ("gain", 0.8))
    )
    spot = Field("detector", "light", 0.2)
    logs = {
        Form(("intensity_gradient",)): 1.0,
        Form((), wide): 3.0,
        Form(("flat_field_residual",)): 0.0,
        Form((), gain): 2.0,
        Form((), fine): 4.0,
        Form((), spot): 5.0,
        Form(("intensity_gradient",), spot): 6.0,
    }
    made = Posterior({form: weighed(log) for form, log in logs.items()}, order)
    single = math.log(PRIOR["single"] / 2)
    assert made.log_weights == pytest.approx(
        {
            ("intensity_gradient",): single + math.log((math.exp(1) + math.exp(3)) / 2),
            ("flat_field_residual",): single + math.log(1 / 2 + (math.exp(2) + math.exp(4)) / 4),
            UNKNOWN: math.log(PRIOR["unknown"]) + 5.0,
            ("intensity_gradient", "unknown"): math.log(PRIOR["mixed"] / 2) + 6.0,
        }
    )
    assert made.leading(("flat_field_residual",)) == Form((), fine)
    both = {((), spot): PRIOR["unknown"] * math.exp(5), (order[:1], spot): PRIOR["mixed"] / 2 * math.exp(6)}
    assert made.fields() == pytest.approx({one: share / sum(both.values()) for one, share in both.items()})
    # Data that cannot show the effect of the library: its fields are an unknown cause.
    assert Form((), wide).names(()) == UNKNOWN


def test_hypotheses_that_the_data_do_not_show_count_to_one_with_fewer_effects() -> None:
    a, b, c, ab, bc, abc, bcd = (tuple(word) for word in ("a", "b", "c", "ab", "bc", "abc", "bcd"))
    rows: list[tuple[dict[Names, float], dict[Names, float]]] = [
        (
            {NONE: 0.1, a: 0.47, b: 0.05, ab: 0.08, bc: 0.3, c: 0.0},
            {a: 0.55, bc: 0.3, NONE: 0.1, b: 0.05, c: 0.0},
        ),
        # A pair that is nearly as probable as its effect stays.
        ({a: 0.6, ab: 0.4}, {a: 0.6, ab: 0.4}),
        ({a: 0.9, ab: 0.1}, {a: 1.0}),
        # A triple counts to two of its effects.
        ({NONE: 0.05, a: 0.1, ab: 0.5, abc: 0.1, bcd: 0.25}, {ab: 0.6, bcd: 0.25, a: 0.1, NONE: 0.05}),
        ({NONE: 0.1, a: 0.7, ab: 0.1, abc: 0.1}, {a: 0.9, NONE: 0.1}),
        # After a failed refit of one effect, a pair without any weight counts to its other effect.
        ({NONE: 1.0, b: 0.0, ab: 0.0}, {NONE: 1.0, b: 0.0}),
        ({NONE: 1.0, ab: 0.0}, {NONE: 1.0, ab: 0.0}),
        ({NONE: 0.5, b: 0.1, ab: 0.4}, {NONE: 0.5, ab: 0.4, b: 0.1}),
    ]
    for shares, shown in rows:
        found = without_idle(shares)
        assert found == pytest.approx(shown) and list(found) == list(shown), shares
    kinds = [kind_of(names) for names in (NONE, UNKNOWN, a, ab, abc)]
    assert kinds == ["none", "unknown", "single", "pair", "triple"]


def test_every_third_effect_is_weighed_beside_the_most_probable_pair(solution: Solution) -> None:
    evidence = gather(solution, EFFECTS[:4])
    assert [effect.name for effect in evidence.effects][:1] == ["dark_offset"]
    found = posterior(strong_offset(evidence))
    pairs, triples = ([n for n in found.log_weights if kind_of(n) == kind] for kind in ("pair", "triple"))
    best = max(pairs, key=lambda names: found.log_weights[names])
    assert len(triples) == len(evidence.effects) - 2 and all(set(best) < set(names) for names in triples)
    assert all(names == tuple(e.name for e in evidence.effects if e.name in names) for names in triples)
