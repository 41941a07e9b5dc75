"""The system of equations: its random subsets, and the fits that recover known coefficients."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from threadpoolctl import threadpool_info, threadpool_limits

from psfcore.errors import DataError
from psfcore.psf import squared_radii
from psfcore.scatter import published_equations
from psfcore.scatter.published_equations import (
    OCCULTED_EQUATIONS,
    PIVOT_PX,
    UNOCCULTED,
    UNOCCULTED_EQUATIONS,
    Equations,
    SegmentMean,
    choose_subset,
    free_fit,
    power_law_fit,
)
from psfcore.scatter.segments import Segments, shells_as_published

Vector = NDArray[np.float64]

A, B, C = 0.154, 6.15, 2.53
SEGMENTS = Segments(shells_as_published(91.0)[::4], reach_grid_px=128)
COUNTS = SEGMENTS.counts.astype(np.float64)


def mean_of_law(a: float, b: float, c: float) -> Vector:
    """The mean of a (b + r)^-c over the pixels of each segment."""
    return SEGMENTS.mean_of_map(a * (b + np.sqrt(squared_radii((128, 128)))) ** -c)


PLANTED = mean_of_law(A, B, C)


def made_equations(occulted: int = 3000, strata: int = 6, noise: float = 1e-3, seed: int = 1) -> Equations:
    """Equations of a variable scene convolved with PLANTED; noise is a fraction of the intensity."""
    rng = np.random.default_rng(seed)
    n = occulted + 200
    stratum = np.concatenate((np.arange(occulted) % strata, np.full(200, UNOCCULTED)))
    unscattered = np.where(stratum == UNOCCULTED, 100.0, 5.0) * rng.uniform(0.5, 1.5, n)
    ring_sums = COUNTS * 100 * rng.uniform(0.2, 1.8, (n, COUNTS.size))
    expected = ring_sums @ PLANTED + (1 - COUNTS @ PLANTED) * unscattered
    scale = noise * expected
    return Equations(expected + rng.normal(0, scale), ring_sums, unscattered, scale, stratum)


def some(of: Equations, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> Equations:
    return Equations(
        of.observed[chosen],
        of.ring_sums[chosen],
        of.unscattered[chosen],
        of.scale[chosen],
        of.stratum[chosen],
    )


def test_small_systems_are_solved_by_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """For any limit of threads: they slow down such small factorisations, most of all on busy cores."""
    seen = []

    def counted(*arguments: object, **options: object) -> object:
        seen.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        return lsq_linear(*arguments, **options)

    monkeypatch.setattr(published_equations, "lsq_linear", counted)
    with threadpool_limits(limits=2, user_api="blas"):
        before = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
        free_fit(made_equations(), COUNTS, seed=1, subsets=2)
        after = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
    assert seen and set(seen) == {1}
    assert before == after and set(before) == {2}


# --- subsets ----------------------------------------------------------------------------------------------


def test_a_subset_has_equal_numbers_from_each_stratum_and_unocculted_ones() -> None:
    whole, rng = made_equations(), np.random.default_rng(0)
    chosen = choose_subset(whole, rng)
    stratum, share = whole.stratum[chosen], -(-OCCULTED_EQUATIONS // 6)
    assert [int((stratum == k).sum()) for k in range(6)] == [share] * 6
    assert (stratum == UNOCCULTED).sum() == UNOCCULTED_EQUATIONS
    assert np.unique(chosen).size == chosen.size
    # Subsets differ, and together contain every equation.
    assert set(chosen) != set(choose_subset(whole, rng))
    reached = set().union(*(choose_subset(whole, rng).tolist() for _ in range(30)))
    assert len(reached) > 0.99 * len(whole)
    # A stratum with few equations contributes all.
    few = some(whole, np.sort(np.concatenate((np.arange(0, 60, 6), np.flatnonzero(whole.stratum != 0)))))
    stratum = few.stratum[choose_subset(few, rng)]
    assert ((stratum == 0).sum(), (stratum == 1).sum()) == (10, share)
    occulted = some(few, few.stratum != UNOCCULTED)
    assert (occulted.stratum[choose_subset(occulted, rng)] != UNOCCULTED).all()
    with pytest.raises(DataError, match="no-lines"):
        choose_subset(some(whole, whole.stratum == UNOCCULTED), rng)


def test_equations_of_frames_are_joined_in_order() -> None:
    whole = made_equations()
    half = np.arange(len(whole)) < 1500
    joined = Equations.joined([some(whole, half), some(whole, ~half)])
    for name in ("observed", "ring_sums", "unscattered", "scale", "stratum"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))


# --- free shells ------------------------------------------------------------------------------------------


def test_free_shells_are_those_planted() -> None:
    found = free_fit(made_equations(), COUNTS, seed=1, subsets=10)
    assert found.fits.shape == (7, COUNTS.size)
    np.testing.assert_allclose(found.mean * COUNTS, PLANTED * COUNTS, atol=1e-3)
    spread = found.fits.std(axis=0, ddof=1)
    assert np.abs((found.mean - PLANTED) / spread).max() < 10  # subsets share equations
    assert found.cost == pytest.approx(np.ones(7), abs=0.15)
    assert (np.diff(found.cost) >= 0).all()


def test_the_worst_subsets_are_dropped() -> None:
    """One equation of 1500 is wrong; subsets that contain it have a higher cost."""
    bad = made_equations()
    bad.observed[7] *= 1.5
    found = free_fit(bad, COUNTS, seed=1, subsets=20)
    assert found.fits.shape[0] == 14
    assert found.cost.max() < 50
    np.testing.assert_allclose(found.mean * COUNTS, PLANTED * COUNTS, atol=2e-3)
    assert free_fit(bad, COUNTS, seed=1, subsets=1).fits.shape[0] == 1


def test_no_shell_is_negative() -> None:
    loud = made_equations(noise=3.0, seed=2)
    found = free_fit(loud, COUNTS, seed=1, subsets=4)
    assert found.fits.min() >= 0
    assert (found.fits < 1e-3 * PLANTED).any()  # without the bound, some would be negative


def test_one_seed_gives_one_fit() -> None:
    once, again, other = (free_fit(made_equations(), COUNTS, seed=seed, subsets=3).mean for seed in (1, 1, 2))
    np.testing.assert_array_equal(once, again)
    assert (once != other).any()


def unconstrained(shell: int) -> Equations:
    """If the scene is uniform at the shell's distance, light in the shell and at the centre have the same effect."""
    of = made_equations()
    of.ring_sums[:, shell] = of.unscattered * COUNTS[shell]
    observed = of.ring_sums @ PLANTED + (1 - COUNTS @ PLANTED) * of.unscattered
    return Equations(observed, of.ring_sums, of.unscattered, of.scale, of.stratum)


def test_an_unconstrained_shell_stays_at_the_prior_and_the_others_do_not() -> None:
    towards = 1.3 * PLANTED
    for shell in (0, COUNTS.size - 1):
        found = free_fit(unconstrained(shell), COUNTS, seed=1, subsets=3, towards=towards).mean
        assert found[shell] == pytest.approx(towards[shell], rel=1e-6)
        others = np.delete(np.arange(COUNTS.size), shell)
        np.testing.assert_allclose((found * COUNTS)[others], (PLANTED * COUNTS)[others], atol=1e-3)
        free = free_fit(unconstrained(shell), COUNTS, seed=1, subsets=3).mean
        assert free[shell] == pytest.approx(0, abs=1e-9)


def test_an_empty_shell_has_no_weight_of_its_own() -> None:
    of, counts = made_equations(), np.append(COUNTS, 0.0)
    wider = Equations(
        of.observed, np.column_stack((of.ring_sums, np.zeros(len(of)))), of.unscattered, of.scale, of.stratum
    )
    found = free_fit(wider, counts, seed=1, subsets=3).mean
    assert found[-1] == 0
    np.testing.assert_allclose(found[:-1], free_fit(of, COUNTS, seed=1, subsets=3).mean, rtol=1e-9)


# --- the power law ----------------------------------------------------------------------------------------


def radii_of(segments: Segments) -> list[tuple[Vector, Vector]]:
    """For each segment, the distances of its pixels and the number of pixels at each."""
    size = segments.reach_grid_px
    squares, label = squared_radii((size, size)), segments.label_map(size)
    pairs = (np.unique(squares[label == k], return_counts=True) for k in range(segments.size))
    return [(np.sqrt(found), count.astype(np.float64)) for found, count in pairs]


RADII = radii_of(SEGMENTS)


def theta(a: float, b: float, c: float) -> Vector:
    """ln of the weight at PIVOT_PX, ln b, c."""
    return np.array([np.log(a * (b + PIVOT_PX) ** -c), np.log(b), c])


def test_a_law_averaged_over_a_segment_is_its_mean() -> None:
    for a, b, c in ((A, B, C), (2.0, 0.4, 3.5), (1e-3, 40.0, 1.2)):
        np.testing.assert_allclose(SegmentMean(RADII)(theta(a, b, c)), mean_of_law(a, b, c), rtol=1e-7)


def test_an_empty_segment_has_no_mean() -> None:
    """Tested in the middle and at the end; the other segments are unchanged."""
    marked = (np.array([5.0]), np.zeros(1))
    with_marked = SegmentMean([*RADII[:3], marked, *RADII[3:], marked])(theta(A, B, C))
    expected = np.insert(np.append(SegmentMean(RADII)(theta(A, B, C)), 0.0), 3, 0.0)
    np.testing.assert_allclose(with_marked, expected, rtol=1e-12)


def test_a_power_law_is_the_one_planted() -> None:
    for start in ((0.15, 6.0, 2.5), (1.0, 20.0, 3.0)):
        found = power_law_fit(made_equations(), COUNTS, RADII, np.array(start), seed=1, subsets=6)
        a, b, c = found.mean
        assert (a, b, c) == pytest.approx((A, B, C), rel=0.03)
        weight = a * (b + PIVOT_PX) ** -c
        assert weight == pytest.approx(A * (B + PIVOT_PX) ** -C, rel=1e-3)
        assert found.fits.shape == (4, 3)
        assert found.cost == pytest.approx(np.ones(4), abs=0.15)
    exact, start = made_equations(noise=1e-7), np.array([0.1, 8.0, 2.4])
    found = power_law_fit(exact, COUNTS, RADII, start, seed=1, subsets=2)
    assert found.mean == pytest.approx((A, B, C), rel=1e-5)
