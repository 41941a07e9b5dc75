"""The published recipe: the fits of its equations recover known coefficients, and each bias has the stated cause.

Its Richardson-Lucy method conserves the light of a field and does not restore light that scatters out of it. The
scatter of the images is compact so that this effect is small: a hundredth of the light lands beyond 50 px.
"""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX, cumulative_curve, squared_radii
from psfcore.scatter import as_published
from psfcore.scatter.as_published import (
    AS_PUBLISHED,
    CORRECTED_ALONE,
    OCCULTED_EQUATIONS,
    SHRUNK_PX,
    UNOCCULTED,
    UNOCCULTED_EQUATIONS,
    Choices,
    Equations,
    Published,
    SubsetFits,
    choose_subset,
    free_fit,
    invert_as_published,
    power_law_fit,
)
from psfcore.scatter.segments import Segments, shells_as_published
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.transit.transit import Place, Transit
from tests.psfcore.small_transits import COMPACT, faint, recipe, true_curve

Vector = NDArray[np.float64]

# --- equations --------------------------------------------------------------------------------------------

LAW = A, B, C = 0.154, 6.15, 2.53
# No pixel lies at 2.5 to 2.6 px: one shell is empty.
SEGMENTS = Segments(tuple(sorted({*shells_as_published(91.0)[::4], 2.6})), reach_grid_px=128)
COUNTS = SEGMENTS.counts.astype(np.float64)
PLANTED = SEGMENTS.mean_of_map(A * (B + np.sqrt(squared_radii((128, 128)))) ** -C)


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
    return Equations(*(values[chosen] for values in vars(of).values()))


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


def test_free_shells_are_those_planted_and_the_worst_subsets_are_dropped() -> None:
    found, full = free_fit(made_equations(), COUNTS, seed=1, subsets=10), COUNTS > 0
    assert found.fits.shape == (7, COUNTS.size)
    np.testing.assert_allclose(found.mean * COUNTS, PLANTED * COUNTS, atol=1e-3)
    spread = found.fits.std(axis=0, ddof=1)
    assert np.abs((found.mean - PLANTED)[full] / spread[full]).max() < 10  # subsets share equations
    assert found.mean[~full] == [0.0]
    again, other = (free_fit(made_equations(), COUNTS, seed=seed, subsets=10).mean for seed in (1, 2))
    np.testing.assert_array_equal(found.mean, again)
    assert (found.mean != other).any()
    # One equation of 1500 is wrong; subsets that contain it have a larger misfit.
    bad = made_equations()
    bad.observed[7] *= 1.5
    found = free_fit(bad, COUNTS, seed=1, subsets=20)
    assert found.fits.shape[0] == 14
    np.testing.assert_allclose(found.mean * COUNTS, PLANTED * COUNTS, atol=2e-3)
    assert free_fit(bad, COUNTS, seed=1, subsets=1).fits.shape[0] == 1
    found = free_fit(made_equations(noise=3.0, seed=2), COUNTS, seed=1, subsets=4)
    assert found.fits.min() >= 0
    # Without the bound, some would be negative.
    assert (found.fits < 1e-3 * PLANTED)[:, COUNTS > 0].any()


def test_an_unconstrained_shell_stays_at_the_prior_and_the_others_do_not() -> None:
    """If the scene is uniform at the shell's distance, light in the shell and at the centre have the same effect."""
    towards = 1.3 * PLANTED
    for shell in (0, COUNTS.size - 1):
        of = made_equations()
        of.ring_sums[:, shell] = of.unscattered * COUNTS[shell]
        observed = of.ring_sums @ PLANTED + (1 - COUNTS @ PLANTED) * of.unscattered
        of = dataclasses.replace(of, observed=observed)
        found = free_fit(of, COUNTS, seed=1, subsets=3, towards=towards).mean
        assert found[shell] == pytest.approx(towards[shell], rel=1e-6)
        others = np.delete(np.arange(COUNTS.size), shell)
        np.testing.assert_allclose((found * COUNTS)[others], (PLANTED * COUNTS)[others], atol=1e-3)
        assert free_fit(of, COUNTS, seed=1, subsets=3).mean[shell] == pytest.approx(0, abs=1e-9)


def test_a_power_law_is_the_one_planted() -> None:
    for noise, start, precision in ((1e-3, (1.0, 20.0, 3.0), 0.03), (1e-7, (0.1, 8.0, 2.4), 2e-3)):
        equations = made_equations(noise=noise)
        found = power_law_fit(equations, SEGMENTS, np.array(start), seed=1, subsets=6)
        assert found.mean == pytest.approx(LAW, rel=precision)
        a, b, c = found.mean
        assert a * (b + 15) ** -c == pytest.approx(A * (B + 15) ** -C, rel=1e-3)
        assert found.fits.shape == (4, 3)


# --- the recipe -------------------------------------------------------------------------------------------

IMAGES, SIZE_PX, GRID_PX = 9, 96, 95
ALL_CORRECTED = Choices(False, False, False, False)


def off(of: Published) -> Vector:
    """Fitted minus true cumulative curve, percentage points."""
    return np.asarray(of.curve_pct - true_curve(tuple(of.radii_px.tolist()), COMPACT))


def test_the_recipe_is_followed_and_its_law_is_its_scatter_and_its_curve() -> None:
    of, seen = recipe(AS_PUBLISHED)
    assert [fit for fit, _ in of.rounds] == ["free shells"] * 3 + ["softened power law"] * 3
    assert len(dict.fromkeys(seen)) == 12  # deconvolving and equations, six times
    assert of.radii_px.tolist() == [0.5, 2, 5, 10, 20, 50]
    assert of.spread is not None and all(np.isfinite(value) for value in of.spread.values())
    # a / (b + r)^c outside the centre, the remaining light at the centre, convolved with diffraction.
    for choices, grid_px in ((AS_PUBLISHED, GRID_PX), (ALL_CORRECTED, REACH_GRID_PX)):
        of, _ = recipe(choices)
        scatter, middle = of.scatter, grid_px // 2
        assert of.grid_px == grid_px == scatter.shape[0]
        assert scatter[middle, middle + 20] == pytest.approx(of.a * (of.b_px + 20) ** -of.c)
        assert scatter.sum() == pytest.approx(1, abs=1e-12)
        assert cumulative_curve(scatter, [0.5])[0] == pytest.approx(100 * of.total)
    law = ScatterTruth(of.b_px, of.c, of.total)
    np.testing.assert_allclose(of.curve_pct, true_curve(tuple(of.radii_px.tolist()), law), atol=0.01)


def test_the_corrected_fit_is_near_the_truth_and_the_published_one_is_not() -> None:
    """In discs of few photons, the published fit gives most weight to pixels that are faint by chance."""
    corrected, published = recipe(ALL_CORRECTED)[0], recipe(AS_PUBLISHED)[0]
    assert np.abs(off(corrected)).max() < 4
    assert corrected.total == pytest.approx(0.4, abs=0.05)
    assert (off(published)[:4] < -5).all()
    assert (np.abs(off(corrected)) < np.abs(off(published))).all()


class _SeenEnough(Exception):
    """Raised when the equations of the first round exist."""


def equations_of(transit: Transit, choices: Choices) -> tuple[Equations, Vector]:
    """The equations of the first round, and the number of pixels of each segment."""
    seen: list[tuple[Equations, Vector]] = []

    def stop(equations: Equations, counts: Vector, **_: object) -> SubsetFits:
        seen.append((equations, counts))
        raise _SeenEnough

    with pytest.MonkeyPatch.context() as patched, pytest.raises(_SeenEnough):
        patched.setattr(as_published, "free_fit", stop)
        invert_as_published(transit, choices, seed=1)
    return seen[0]


@cache
def first_equations(**corrected: bool) -> tuple[Equations, Vector]:
    """Those of the faint images."""
    return equations_of(faint(), dataclasses.replace(AS_PUBLISHED, **corrected))


def test_equations_are_of_all_occulted_pixels_that_are_not_filled_and_some_unocculted_ones() -> None:
    equations, _ = first_equations()
    dark = equations.stratum != UNOCCULTED
    assert (~dark).sum() == 10 * IMAGES
    assert dark.sum() == pytest.approx(IMAGES * np.pi * (10.75 - SHRUNK_PX) ** 2, rel=0.03)
    assert set(np.unique(equations.stratum)) == set(range(-1, 10))
    assert equations.unscattered[~dark].mean() > 3 * equations.unscattered[dark].mean()
    frames = list(faint().frames)
    filled, place = np.zeros((SIZE_PX, SIZE_PX), bool), frames[4].place
    filled[round(place.y_px) - 1 : round(place.y_px) + 2, round(place.x_px)] = True
    frames[4] = dataclasses.replace(frames[4], filled=filled)
    fewer, _ = equations_of(dataclasses.replace(faint(), frames=tuple(frames)), AS_PUBLISHED)
    assert len(fewer) == len(equations) - 3


def test_each_choice_changes_its_own_part_of_an_equation() -> None:
    assert [sum(dataclasses.astuple(choices)) for choices in CORRECTED_ALONE.values()] == [3, 3, 3, 3]
    published, counts = first_equations()
    dark = published.stratum != UNOCCULTED
    first = published.observed[: int(np.argmin(dark))]  # the disc of the first image
    assert first.min() < 0.5 * first.mean()
    # However low the observed intensity, the weight of a pixel is limited.
    limited = np.maximum(first, 0.5 * first.mean())
    np.testing.assert_allclose(published.scale[: first.size], limited, rtol=1e-12)

    weighed, _ = first_equations(weighed_by_observed=False)
    assert np.unique(weighed.scale[dark]).size == IMAGES  # one for each disc
    np.testing.assert_array_equal(weighed.ring_sums, published.ring_sums)
    exposure_s = faint().frames[0].exposure_s
    noise = np.sqrt(6.0 * first.mean() * exposure_s + 2.0**2) / exposure_s
    np.testing.assert_allclose(weighed.scale[: first.size], noise)

    convolved, _ = first_equations(added=False)
    np.testing.assert_array_equal(convolved.unscattered, published.unscattered)
    assert not np.allclose(convolved.ring_sums, published.ring_sums, rtol=1e-3)
    # Diffracted light is smoother, and its total is the same.
    assert convolved.ring_sums[dark, :5].sum() > published.ring_sums[dark, :5].sum()
    assert convolved.ring_sums.sum() == pytest.approx(published.ring_sums.sum(), rel=0.02)

    reaching, all_counts = first_equations(counted_on_array=False)
    assert (counts.sum(), all_counts.sum()) == (GRID_PX**2 - 1, REACH_GRID_PX**2 - 1)
    np.testing.assert_array_equal(reaching.unscattered, published.unscattered)

    fully, _ = first_equations(whole_disc_blanked=False)
    assert (fully.ring_sums.sum(axis=1) >= published.ring_sums.sum(axis=1) * (1 - 1e-6)).all()
    assert fully.ring_sums.sum() > 1.0001 * published.ring_sums.sum()


def test_one_subset_has_no_spread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two subsets, one is kept."""
    monkeypatch.setattr(as_published, "FREE_ROUNDS", 1)
    monkeypatch.setattr(as_published, "POWER_LAW_ROUNDS", 1)
    assert invert_as_published(faint(), subsets=2).spread is None


def test_shells_brighter_than_the_centre_and_images_without_an_occulted_pixel_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames = [dataclasses.replace(f, place=Place(50.0, 50.0, 0.9)) for f in faint().frames]
    with pytest.raises(DataError, match="no-lines"):
        invert_as_published(dataclasses.replace(faint(), frames=tuple(frames)), subsets=1)
    # The four pixels next to the centre contain less than all light, but each is brighter than the centre.
    nearest = np.zeros(50)
    nearest[0] = 0.22
    monkeypatch.setattr(as_published, "free_fit", lambda *_, **__: SubsetFits(nearest[None], nearest))
    with pytest.raises(DataError, match=r"round 1: free shells: .* 1 px") as caught:
        invert_as_published(faint(), subsets=1)
    assert caught.value.code == "no-scatter"
