"""Ranks, percentiles and parts of equal size agree with those of a full sort."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from psfcore.deconvolve.assess.ranks import Portions, medians, parts_of_equal_size, percentiles

RNG = np.random.default_rng(3)
VALUES = {
    "smooth": RNG.normal(5.0, 40.0, 30_001),
    "whole numbers": np.round(RNG.normal(0.0, 3.0, 20_000)),
    "all equal": np.full(1000, -2.5),
    "one": np.array([7.0]),
    "far apart": np.concatenate(
        [-(10.0 ** RNG.uniform(-30, 30, 500)), [0.0], 10.0 ** RNG.uniform(-30, 30, 500)]
    ),
}
LEVELS = (0.0, 0.1, 1.0, 50.0, 99.9, 100.0)


@pytest.mark.parametrize("kind", VALUES)
def test_percentiles_are_those_of_numpy(kind: str) -> None:
    values = VALUES[kind].astype(np.float32)
    np.testing.assert_allclose(
        percentiles(values, LEVELS), np.percentile(values.astype(float), LEVELS), rtol=1e-6
    )


def test_a_value_too_large_for_single_precision_stays_finite() -> None:
    assert np.isfinite(percentiles(np.array([1e300, -1e300, 0.0]), LEVELS)).all()


@pytest.mark.parametrize("kind", ["smooth", "whole numbers", "all equal"])
def test_parts_are_those_of_a_stable_sort(kind: str) -> None:
    values = VALUES[kind].astype(np.float32)
    sizes = [len(part) for part in np.array_split(values, 16)]
    expected = np.empty(values.size, int)
    expected[np.argsort(values, kind="stable")] = np.repeat(np.arange(16), sizes)
    portions = Portions.of(values)
    parts, middles = parts_of_equal_size(portions, 16)
    np.testing.assert_array_equal(parts, expected)
    by_part = [np.median(values[expected == number].astype(float)) for number in range(16)]
    np.testing.assert_allclose(medians(replace(portions, groups=parts), 16), by_part, rtol=1e-6)
    np.testing.assert_allclose(middles, by_part, rtol=1e-6)
