"""The p-value of a gap: noise hardly ever has a small one; a gap in the discs or in the unocculted field has a tiny one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.gap_test import p_value_of_gap
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from tests.psfcore.gap.linear_models import drawn, with_residuals

DRAWS = 100


@pytest.fixture(scope="module")
def of_noise(evidence: Evidence) -> np.ndarray:
    """P-values of data that are noise."""
    model = LinearModel(evidence, FLOOR)
    return np.array([p_value_of_gap(drawn(model, {}, seed)) for seed in range(DRAWS)])


@pytest.mark.parametrize("level", [0.3, 0.1, 0.02])
def test_noise_is_below_a_level_no_more_often_than_stated(of_noise: np.ndarray, level: float) -> None:
    """The smallest of four p-values times four is at least as large as a uniform number."""
    assert np.mean(of_noise < level) <= level + 2 * np.sqrt(level * (1 - level) / DRAWS)


def test_p_values_of_noise_are_not_all_one(of_noise: np.ndarray) -> None:
    assert of_noise.max() <= 1.0
    assert np.mean(of_noise < 0.9) > 0.3


def test_a_strong_offset_has_a_tiny_p_value(evidence: Evidence) -> None:
    model = LinearModel(evidence, FLOOR)
    strong = [p_value_of_gap(drawn(model, {("dark_offset", 0): dn}, 1)) for dn in (3.0, 10.0)]
    assert strong[1] < strong[0] < 1e-8


def test_a_gap_in_the_discs_alone_is_seen(evidence: Evidence) -> None:
    """The unocculted field is not used."""
    assert p_value_of_gap(with_residuals(evidence, {"dark_offset": 10.0}, noise=1.0)) < 1e-8


def test_a_gap_in_the_unocculted_field_alone_is_seen(evidence: Evidence) -> None:
    """A tenth of the light of each second block flickers from image to image; the discs are noise."""
    model = drawn(LinearModel(evidence, FLOOR), {}, 1)
    blocks = model.evidence.unocculted
    images, across = np.indices(blocks.levels.shape)
    levels = blocks.levels * (1 + 0.1 * (-1.0) ** images * (across % 2))
    changed = replace(model, evidence=replace(model.evidence, unocculted=replace(blocks, levels=levels)))
    assert p_value_of_gap(model) > 1e-3 > 1e-8 > p_value_of_gap(changed)
