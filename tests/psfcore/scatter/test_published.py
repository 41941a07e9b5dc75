"""The published recipe runs, and each of its biases has the stated cause.

Its Richardson-Lucy method conserves the light of a field and does not restore light that scatters out of it. The
scatter in these tests is compact so that this effect is small: a hundredth of the light lands beyond 50 px.
"""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX, cumulative_curve
from psfcore.scatter import published
from psfcore.scatter.published import (
    AS_PUBLISHED,
    CORRECTED_ALONE,
    SHRUNK_PX,
    Choices,
    Published,
    invert_as_published,
)
from psfcore.scatter.published_equations import UNOCCULTED, Equations, SubsetFits
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.transit.transit import Place, Transit
from tests.psfcore.small_transits import COMPACT, faint, recipe, true_curve

IMAGES, SIZE_PX, GRID_PX = 9, 96, 95
ALL_CORRECTED = Choices(False, False, False, False)


def off(of: Published) -> NDArray[np.float64]:
    """Fitted minus true cumulative curve, percentage points."""
    return np.asarray(of.curve_pct - true_curve(tuple(of.radii_px.tolist()), COMPACT))


def test_the_recipe_is_followed_to_its_end() -> None:
    of, seen = recipe(AS_PUBLISHED)
    assert [fit for fit, _ in of.rounds] == ["free shells"] * 3 + ["softened power law"] * 3
    assert len(dict.fromkeys(seen)) == 12  # deconvolving and equations, six times
    assert of.radii_px.tolist() == [0.5, 2, 5, 10, 20, 50]
    assert of.grid_px == GRID_PX == of.scatter.shape[0]
    assert all(np.isfinite(value) for value in of.spread.values())


def test_its_law_is_its_scatter_and_its_curve() -> None:
    """a / (b + r)^c outside the centre, the remaining light at the centre, convolved with diffraction."""
    for choices, grid_px in ((AS_PUBLISHED, GRID_PX), (ALL_CORRECTED, REACH_GRID_PX)):
        of, _ = recipe(choices)
        scatter, middle = of.scatter, of.grid_px // 2
        assert of.grid_px == grid_px
        assert scatter[middle, middle + 20] == pytest.approx(of.a * (of.b_px + 20) ** -of.c)
        assert scatter.sum() == pytest.approx(1, abs=1e-12)
        assert cumulative_curve(scatter, [0.5])[0] == pytest.approx(100 * of.total)
    law = ScatterTruth(of.b_px, of.c, of.total)
    np.testing.assert_allclose(of.curve_pct, true_curve(tuple(of.radii_px.tolist()), law), atol=0.01)


def test_the_corrected_fit_is_near_the_truth_and_the_published_one_is_not() -> None:
    """In discs of few photons, the published fit gives most weight to pixels that are faint by chance."""
    corrected, published_fit = recipe(ALL_CORRECTED)[0], recipe(AS_PUBLISHED)[0]
    assert np.abs(off(corrected)).max() < 4
    assert corrected.total == pytest.approx(0.4, abs=0.05)
    assert (off(published_fit)[:4] < -5).all()
    assert (np.abs(off(corrected)) < np.abs(off(published_fit))).all()


class _SeenEnough(Exception):
    """Raised when the equations of the first round exist."""


def equations_of(transit: Transit, choices: Choices) -> tuple[Equations, NDArray[np.float64]]:
    """The equations of the first round, and the number of pixels of each segment."""
    seen: list[tuple[Equations, NDArray[np.float64]]] = []

    def stop(equations: Equations, counts: NDArray[np.float64], **_: object) -> SubsetFits:
        seen.append((equations, counts))
        raise _SeenEnough

    with pytest.MonkeyPatch.context() as patched, pytest.raises(_SeenEnough):
        patched.setattr(published, "free_fit", stop)
        invert_as_published(transit, choices, seed=1)
    return seen[0]


@cache
def first_equations(choices: Choices) -> tuple[Equations, NDArray[np.float64]]:
    """Those of the faint images."""
    return equations_of(faint(), choices)


def test_equations_are_of_all_occulted_pixels_and_some_unocculted_ones() -> None:
    equations, _ = first_equations(AS_PUBLISHED)
    assert (equations.stratum == UNOCCULTED).sum() == 10 * IMAGES
    assert (equations.stratum != UNOCCULTED).sum() == pytest.approx(
        IMAGES * np.pi * (10.75 - SHRUNK_PX) ** 2, rel=0.03
    )
    assert set(np.unique(equations.stratum)) == set(range(-1, 10))
    dark = equations.stratum != UNOCCULTED
    assert equations.unscattered[~dark].mean() > 3 * equations.unscattered[dark].mean()


def test_each_choice_changes_its_own_part_of_an_equation() -> None:
    assert [sum(dataclasses.astuple(choices)) for choices in CORRECTED_ALONE.values()] == [3, 3, 3, 3]
    as_published, counts = first_equations(AS_PUBLISHED)
    dark = as_published.stratum != UNOCCULTED
    first = as_published.observed[: int(np.argmin(dark))]  # the disc of the first image
    assert first.min() < 0.5 * first.mean()
    # However low the observed intensity, the weight of a pixel is limited.
    np.testing.assert_allclose(
        as_published.scale[: first.size], np.maximum(first, 0.5 * first.mean()), rtol=1e-12
    )

    weighed, _ = first_equations(dataclasses.replace(AS_PUBLISHED, weighed_by_observed=False))
    assert np.unique(weighed.scale[dark]).size == IMAGES  # one for each disc
    np.testing.assert_array_equal(weighed.ring_sums, as_published.ring_sums)
    exposure_s = faint().frames[0].exposure_s
    noise = np.sqrt(6.0 * first.mean() * exposure_s + 2.0**2) / exposure_s
    np.testing.assert_allclose(weighed.scale[: first.size], noise)

    convolved, _ = first_equations(dataclasses.replace(AS_PUBLISHED, added=False))
    np.testing.assert_array_equal(convolved.unscattered, as_published.unscattered)
    assert not np.allclose(convolved.ring_sums, as_published.ring_sums, rtol=1e-3)
    # Diffracted light is smoother, and its total is the same.
    near = slice(0, 5)
    assert convolved.ring_sums[dark, near].sum() > as_published.ring_sums[dark, near].sum()
    assert convolved.ring_sums.sum() == pytest.approx(as_published.ring_sums.sum(), rel=0.02)

    reaching, all_counts = first_equations(dataclasses.replace(AS_PUBLISHED, counted_on_array=False))
    assert counts.sum() == GRID_PX**2 - 1
    assert all_counts.sum() == REACH_GRID_PX**2 - 1
    np.testing.assert_array_equal(reaching.unscattered, as_published.unscattered)

    fully, _ = first_equations(dataclasses.replace(AS_PUBLISHED, whole_disc_blanked=False))
    assert (fully.ring_sums.sum(axis=1) >= as_published.ring_sums.sum(axis=1) * (1 - 1e-6)).all()
    assert fully.ring_sums.sum() > 1.0001 * as_published.ring_sums.sum()


def test_filled_pixels_give_no_equations() -> None:
    whole, _ = first_equations(AS_PUBLISHED)
    place = faint().frames[4].place
    filled = np.zeros((SIZE_PX, SIZE_PX), bool)
    filled[round(place.y_px) - 1 : round(place.y_px) + 2, round(place.x_px)] = True
    frames = list(faint().frames)
    frames[4] = dataclasses.replace(frames[4], filled=filled)
    fewer, _ = equations_of(dataclasses.replace(faint(), frames=tuple(frames)), AS_PUBLISHED)
    assert len(fewer) == len(whole) - 3


def test_one_subset_has_no_spread() -> None:
    """Of two subsets, one is kept."""
    of = invert_as_published(faint(), subsets=2)
    assert of.spread is None
    assert np.isfinite(of.curve_pct).all()


def test_shells_brighter_than_the_centre_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The four pixels next to the centre contain less than all light, but each is brighter than the centre."""
    nearest = np.zeros(50)
    nearest[0] = 0.22
    monkeypatch.setattr(
        published, "free_fit", lambda *_, **__: SubsetFits(nearest[None], np.zeros(1), nearest)
    )
    with pytest.raises(DataError, match=r"round 1: free shells: .* 1 px") as caught:
        invert_as_published(faint(), subsets=1)
    assert caught.value.code == "no-scatter"


def test_without_an_occulted_pixel_it_is_refused() -> None:
    frames = [dataclasses.replace(f, place=Place(50.0, 50.0, 0.9)) for f in faint().frames]
    with pytest.raises(DataError, match="no-lines"):
        invert_as_published(dataclasses.replace(faint(), frames=tuple(frames)), subsets=1)
