"""The small diagnosis with answers made by hand: one for each kind of answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from unittest.mock import patch

import numpy as np

from psfcore.gap import diagnose as diagnosing
from psfcore.gap.diagnose import Diagnosis, diagnose
from psfcore.gap.evidence.closed_form import Form
from psfcore.gap.evidence.tree import SUN
from psfcore.gap.verdict.answer import Label, Verdict, causes_of
from psfcore.gap.verdict.calibration import Calibration
from tests.psfcore.gap.small_gaps import FEW, few_sign_flips, found

OFFSET, GAIN, BLUR = ("offset_place", "dark_offset"), ("gain_kind", "gain_mismatch"), ("core", "core_blur")
LIGHT, WARMING, THE_SUN = ("light_place", None), ("psf_time", None), ("sun", SUN)
LEVEL = 0.92
HOLDS_FOR = "The coverage holds for transits like these."
ABOUT = {"seed": 5, "version": "1.2.3", "command": "python -m made", "holds_for": HOLDS_FOR}


@dataclass(frozen=True)
class Given:
    """The probability of each set of labels, and the verdict and names that belong to them."""

    shares: Mapping[tuple[Label, ...], float]
    verdict: Verdict
    named: tuple[str, ...] = ()


GIVEN = {
    "none": Given({(): 0.7, (OFFSET,): 0.15, (LIGHT,): 0.08, (GAIN,): 0.07}, "none"),
    "name": Given({(OFFSET,): 0.95, (LIGHT,): 0.045, (): 0.005}, "attributed", ("dark_offset",)),
    "two": Given({(OFFSET, BLUR): 0.95, (OFFSET,): 0.05}, "attributed", ("dark_offset", "core_blur")),
    "beside": Given({(OFFSET, LIGHT): 0.95, (OFFSET,): 0.05}, "attributed", ("dark_offset", "unknown")),
    "sun": Given({(THE_SUN,): 0.96, (OFFSET,): 0.04}, "attributed", (SUN,)),
    "with_sun": Given({(OFFSET, THE_SUN): 0.95, (OFFSET,): 0.05}, "attributed", ("dark_offset", SUN)),
    "tie": Given({(OFFSET,): 0.5, (GAIN,): 0.47, (): 0.03}, "tie", ("dark_offset", "gain_mismatch")),
    "map": Given({(LIGHT,): 0.95, (OFFSET,): 0.05}, "unknown"),
    "curve": Given({(WARMING,): 0.95, (OFFSET,): 0.05}, "unknown"),
    "stage": Given({(OFFSET,): 0.6, (LIGHT,): 0.37, (): 0.03}, "inconclusive", ("dark_offset",)),
}


def with_shares(given: Given) -> Diagnosis:
    """The diagnosis as if these were the probabilities of the causes, without a full refit."""
    shares = {frozenset(labels): share for labels, share in given.shares.items()}
    answer, nothing = found().answer, np.zeros(0)
    sun = Form("sun", SUN, None, nothing.astype(int), nothing, nothing.astype(bool))
    answer = replace(
        answer,
        causes=causes_of(shares, LEVEL),
        verdict=given.verdict,
        named=given.named,
        none=shares.get(frozenset(), 0.0),
        hypotheses=shares,
        variants={**answer.variants, sun: None},
        evidence={**answer.evidence, sun: 0.0},
        level=LEVEL,
    )
    model, solution = found().model, found().solution
    with (
        patch.object(diagnosing, "linear_model_of", lambda *given, **how: (model, found().expected)),
        patch.object(diagnosing, "answer_of", lambda model, level: answer),
        few_sign_flips(),
    ):
        return diagnose(
            solution.transit,
            library=FEW,
            refit=False,
            calibration=Calibration((LEVEL,) * 19, ABOUT),
            solution=solution,
        )


@cache
def judged(kind: str) -> Diagnosis:
    """The diagnosis with this kind of answer (of GIVEN)."""
    return with_shares(GIVEN[kind])
