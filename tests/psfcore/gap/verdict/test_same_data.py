"""The evidence of a refit for the discs and blocks from before the refit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.verdict.same_data import _with_blocks_of, _with_same_discs


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
