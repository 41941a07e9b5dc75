"""The posterior: probabilities of hypotheses, and blocks at a refit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.library.detector import EFFECTS
from psfcore.gap.verdict.posterior import (
    NONE,
    UNKNOWN,
    Names,
    _with_blocks_of,
    _with_same_discs,
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
        {NONE: 0.1, ("a",): 0.4, ("b",): 0.05, ("a", "b"): 0.15, ("b", "c"): 0.3, ("c",): 0.0}
    )
    assert found == {("a",): pytest.approx(0.55), ("b", "c"): 0.3, NONE: 0.1, ("b",): 0.05, ("c",): 0.0}
    assert list(found) == [("a",), ("b", "c"), NONE, ("b",), ("c",)]
    assert [kind_of(names) for names in (NONE, UNKNOWN, *found)][:3] == ["none", "unknown", "single"]


def test_a_triple_that_the_data_do_not_show_counts_to_two_of_its_effects() -> None:
    a, ab, abc, bcd = ("a",), ("a", "b"), ("a", "b", "c"), ("b", "c", "d")
    assert [kind_of(names) for names in (a, ab, abc)] == ["single", "pair", "triple"]
    found = without_idle({NONE: 0.05, a: 0.1, ab: 0.4, abc: 0.2, bcd: 0.25})
    assert found == {ab: pytest.approx(0.6), bcd: 0.25, a: 0.1, NONE: 0.05}
    assert without_idle({NONE: 0.1, a: 0.5, ab: 0.1, abc: 0.3}) == {a: pytest.approx(0.9), NONE: 0.1}


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


def test_the_blocks_of_a_refit_keep_their_noise_and_lose_the_effect(evidence: Evidence) -> None:
    """The refit has other blocks and its own order of columns; only the errors of the first model count."""
    (column,) = evidence.columns["dark_offset"]
    other = evidence.columns["column_smear"]
    moved = replace(
        evidence,
        effects=evidence.effects[::-1],
        columns={"column_smear": evidence.columns["dark_offset"] + other[:1], "dark_offset": (other[1],)},
        unocculted=replace(evidence.unocculted, levels=0.5 * evidence.unocculted.levels),
    )
    after = _with_blocks_of(evidence, moved, {"dark_offset": (2.0,)}).unocculted
    change = evidence.unocculted.errors[column]
    np.testing.assert_allclose(after.levels, evidence.unocculted.levels - 2.0 * change)
    np.testing.assert_array_equal(after.errors[other[1]], change)
    np.testing.assert_array_equal(after.variance, evidence.unocculted.variance)


def test_every_refit_is_judged_by_the_same_discs(evidence: Evidence) -> None:
    """The refit lost the first disc, and could use a disc that the fit before it could not use."""
    first, *rest = evidence.discs
    fit = replace(evidence, discs=(first, *rest[:-1]))
    offset, *_ = evidence.columns["dark_offset"]
    moved = np.arange(1.0, 1.0 + len(evidence.base))
    after = _with_same_discs(fit, replace(evidence, discs=tuple(rest)), {"dark_offset": (2.0,)}, moved)
    assert after.images == fit.images
    change = moved @ first.jacobian[list(evidence.base)] + 2.0 * first.jacobian[offset]
    np.testing.assert_allclose(after.discs[0].residual, first.residual - change)
    np.testing.assert_array_equal(after.discs[0].jacobian, first.jacobian)
    assert after.discs[1:] == fit.discs[1:]
