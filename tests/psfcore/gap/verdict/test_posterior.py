"""The posterior: probabilities of hypotheses."""

from __future__ import annotations

from dataclasses import replace

import pytest

from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.library.detector import EFFECTS
from psfcore.gap.verdict.posterior import (
    NONE,
    UNKNOWN,
    Names,
    kind_of,
    posterior,
    without_idle,
)
from psfcore.scatter.inversion import Solution
from tests.psfcore.gap.linear_models import with_residuals

OFFSET: Names = ("dark_offset",)


def strong_offset(evidence: Evidence) -> LinearModel:
    return replace(with_residuals(evidence, {"dark_offset": 300.0}), scale_error=0.1)


def test_noise_alone_is_no_gap_and_an_offset_is_an_offset(evidence: Evidence) -> None:
    clean = replace(with_residuals(evidence, {}, noise=0.5), scale_error=0.1)
    for model, best in ((clean, NONE), (strong_offset(evidence), OFFSET)):
        found = without_idle(posterior(model).probabilities())
        assert next(iter(found)) == best
        assert sum(found.values()) == pytest.approx(1.0)
        assert UNKNOWN in found


def test_a_temperature_makes_the_probabilities_more_alike(evidence: Evidence) -> None:
    found = posterior(with_residuals(evidence, {"dark_offset": 3.0}))
    assert max(found.probabilities(3.0).values()) < max(found.probabilities().values())


def test_a_pair_that_the_data_do_not_show_counts_to_its_effect() -> None:
    found = without_idle(
        {NONE: 0.1, ("a",): 0.47, ("b",): 0.05, ("a", "b"): 0.08, ("b", "c"): 0.3, ("c",): 0.0}
    )
    assert found == {("a",): pytest.approx(0.55), ("b", "c"): 0.3, NONE: 0.1, ("b",): 0.05, ("c",): 0.0}
    assert list(found) == [("a",), ("b", "c"), NONE, ("b",), ("c",)]
    assert [kind_of(names) for names in (NONE, UNKNOWN, *found)][:3] == ["none", "unknown", "single"]


def test_a_pair_that_is_nearly_as_probable_as_its_effect_stays() -> None:
    one, both = ("a",), ("a", "b")
    assert without_idle({one: 0.6, both: 0.4}) == {one: 0.6, both: 0.4}
    assert without_idle({one: 0.9, both: 0.1}) == {one: pytest.approx(1.0)}


def test_a_triple_that_the_data_do_not_show_counts_to_two_of_its_effects() -> None:
    a, ab, abc, bcd = ("a",), ("a", "b"), ("a", "b", "c"), ("b", "c", "d")
    assert [kind_of(names) for names in (a, ab, abc)] == ["single", "pair", "triple"]
    found = without_idle({NONE: 0.05, a: 0.1, ab: 0.5, abc: 0.1, bcd: 0.25})
    assert found == {ab: pytest.approx(0.6), bcd: 0.25, a: 0.1, NONE: 0.05}
    assert without_idle({NONE: 0.1, a: 0.7, ab: 0.1, abc: 0.1}) == {a: pytest.approx(0.9), NONE: 0.1}


def test_every_third_effect_is_weighed_beside_the_most_probable_pair(solution: Solution) -> None:
    evidence = gather(solution, EFFECTS[:4])
    assert [effect.name for effect in evidence.effects][:1] == ["dark_offset"]
    both = replace(with_residuals(evidence, {"dark_offset": 300.0}), scale_error=0.1)
    found = posterior(both)
    pairs, triples = ([n for n in found.log_weights if kind_of(n) == kind] for kind in ("pair", "triple"))
    best = max(pairs, key=lambda names: found.log_weights[names])
    assert len(triples) == len(evidence.effects) - 2 and all(set(best) < set(names) for names in triples)
    assert all(names == tuple(e.name for e in evidence.effects if e.name in names) for names in triples)


def test_after_a_failed_refit_a_pair_without_any_weight_counts_to_its_other_effect() -> None:
    """One effect alone was left out. The pair is so improbable that its share is 0."""
    only, pair = ("b",), ("a", "b")
    assert without_idle({NONE: 1.0, only: 0.0, pair: 0.0}) == {NONE: 1.0, only: 0.0}
    assert without_idle({NONE: 1.0, pair: 0.0}) == {NONE: 1.0, pair: 0.0}
    assert without_idle({NONE: 0.5, only: 0.1, pair: 0.4}) == {NONE: 0.5, pair: 0.4, only: 0.1}
