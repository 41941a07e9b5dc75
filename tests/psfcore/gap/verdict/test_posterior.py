"""The posterior: probabilities of hypotheses, full refits that replace the linear model, and blocks at a refit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.likelihood import Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.verdict.posterior import (
    NONE,
    UNKNOWN,
    Names,
    _with_blocks_of,
    kind_of,
    posterior,
    without_idle,
)
from psfcore.gap.verdict.settled import VISIBLE, settled_posterior
from tests.psfcore.gap.linear_models import with_residuals

OFFSET: Names = ("dark_offset",)


def weighed(log_evidence: float) -> Weighed:
    return Weighed(log_evidence, (), np.zeros(0), 0.0)


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


def test_a_strong_effect_is_refitted_and_the_evidence_of_the_refit_counts(evidence: Evidence) -> None:
    asked: list[Names] = []

    def refit(names: Names) -> Mapping[Names, Weighed]:
        asked.append(names)
        return {names: weighed(-1e6)}

    model = strong_offset(evidence)
    assert posterior(model).visible_error[OFFSET] > VISIBLE
    found, failed = settled_posterior(model, refit)
    assert asked[0] == OFFSET and failed == ()
    assert len(set(asked)) == len(asked)
    assert OFFSET not in list(found.probabilities())[:2]


def test_a_hypothesis_whose_refit_fails_is_left_out(evidence: Evidence) -> None:
    found, failed = settled_posterior(strong_offset(evidence), lambda names: None)
    assert failed[0] == OFFSET
    assert not set(failed) & set(found.probabilities())


def test_a_weak_effect_needs_no_refit(evidence: Evidence) -> None:
    def refit(names: Names) -> Mapping[Names, Weighed]:
        raise AssertionError(f"{names} was refitted")

    settled_posterior(replace(with_residuals(evidence, {}, noise=0.5), scale_error=0.1), refit)


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
