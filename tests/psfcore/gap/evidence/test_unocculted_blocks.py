"""Blocks of the unocculted field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from psfcore.gap.evidence.evidence import gather
from psfcore.scatter.inversion import Solution
from tests.psfcore.gap.linear_models import FEW


def test_blocks_recover_an_added_effect_whatever_the_brightness(solution: Solution) -> None:
    evidence = gather(solution, FEW)
    (column,) = evidence.columns["dark_offset"]
    unocculted = evidence.unocculted
    before = unocculted.equations([column])
    rng = np.random.default_rng(2)
    waver = 1 + 0.004 * rng.standard_normal(len(evidence.image_info))
    added = replace(unocculted, levels=unocculted.levels * waver[:, None] + 1.5 * unocculted.errors[column])
    after = added.equations([column])
    found, was = (float(e.score[0] / e.normal[0, 0]) for e in (after, before))
    assert found - was == pytest.approx(1.5, abs=0.15)
