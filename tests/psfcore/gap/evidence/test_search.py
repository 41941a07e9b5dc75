"""Searches before a fit: changes of the PSF, rotated meshes, blurs, halos, copies, and a changing Sun."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, rotate

from psfcore.gap.evidence.cells import sensitivities
from psfcore.gap.evidence.effect_fits import fit_effects
from psfcore.gap.evidence.evidence import gather
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.search import (
    STEP_PX,
    PlaceSearch,
    _along_copy,
    coarse_kernel,
    displaced,
    distinguished,
    place_search,
)
from psfcore.gap.library.optics import (
    ANGLES_DEG,
    BETWEEN_THEM,
    BLURS,
    DIRECTIONS,
    HALOS,
    Halo,
    _amount,
    _blurred,
    _halo,
    _turned,
)
from psfcore.gap.view import View
from psfcore.psf import crop_or_pad
from psfcore.scatter.inversion import invert
from psfcore.scatter.optics import Blur
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.occulter import coverage
from psfcore.transit.transit import Transit
from tests.psfcore.gap.small_transits import clean, effect, solution
from tests.transit_files import TRUTH, diffraction

Plane = NDArray[np.float64]


def test_the_sum_over_displacements_predicts_the_effect_of_a_psf_change_on_the_discs() -> None:
    view, rng = View(solution()), np.random.default_rng(1)
    kernel = rng.normal(size=(31, 31))
    search, blur = place_search(view), Blur(kernel, solution().transit.shape)
    half = search._to_displacements.shape[1] // 2
    window = search._to_displacements[:, half - 15 : half + 16, half - 15 : half + 16]
    for k, n in enumerate(solution().part[:4]):
        dark = solution().sky.dark[n]
        (plane,) = sensitivities(solution().optics, dark, np.full((1, dark[0].size), 1 / dark[0].size))
        moved = float(np.vdot(plane, view.blurred(n, blur)))
        assert float(np.vdot(window[k], kernel)) == pytest.approx(moved, rel=2e-3, abs=1e-4)
    assert place_search(view) is search


@pytest.mark.parametrize("by", [(0, 0), (3, -4), (-31, 2), (29, 19), (-29, -19), (5, 25), (40, 1), (-7, 6)])
def test_the_response_to_a_copy_equals_the_sum_over_the_displaced_plane(by: tuple[int, int]) -> None:
    q, plane = np.random.default_rng(1).normal(size=(2, 20, 30))
    assert _along_copy(q, plane, *by) == pytest.approx(float(np.vdot(q, displaced(plane, *by))), abs=1e-12)


def test_a_blur_is_not_negative_and_has_its_nominal_width() -> None:
    point = np.zeros((63, 63))
    point[31, 31] = 1.0
    y, x = np.indices(point.shape) - 31
    for width, steps in BLURS:
        seen = _blurred(point, width, steps)
        assert seen.min() > -1e-12 and seen.sum() == pytest.approx(1.0)
        # Along its own direction; an even one along any.
        dy, dx = steps[0]
        along = (y * dy + x * dx) / np.hypot(dy, dx)
        assert float((seen * along**2).sum()) == pytest.approx(width**2, rel=1e-6)
    assert {steps for _, steps in BLURS} == {*DIRECTIONS, *BETWEEN_THEM}


@cache
def cross() -> Plane:
    """A core with orders along a cross from 3 to 45 px, 127 px wide, sum 1."""
    plane = np.zeros((127, 127))
    for r in range(3, 46, 3):
        plane[63, 63 + r] = plane[63, 63 - r] = plane[63 + r, 63] = plane[63 - r, 63] = 1 / r
    plane *= 0.3 / plane.sum()
    plane[63, 63] = 0.7
    return plane


def test_a_turned_mesh_is_found_at_its_angle() -> None:
    """The rotation is larger than the width of the orders, so a derivative could not find it."""
    plan = default_plan(12, 128, oversampling=1, brightness=8.0)
    turned = np.maximum(rotate(cross(), 12.0, reshape=False, order=1), 0.0)
    transit = simulate(plan, TRUTH, turned / turned.sum(), seed=4).transit
    view = View(invert(replace(transit, diffraction=cross())))
    found = _amount(view, _turned, ANGLES_DEG)
    assert found.best == pytest.approx(12.0, abs=2.0)
    assert 1 <= found.distinguished <= 2 * len(ANGLES_DEG)


def test_the_coarse_sum_predicts_the_effect_of_a_wide_psf_change_on_the_discs() -> None:
    view = View(solution())
    search, blur = place_search(view), Blur(HALOS[2](255), solution().transit.shape)
    coarse = coarse_kernel(HALOS[2](255), STEP_PX)
    half, reach = search._to_far.shape[1] // 2, coarse.shape[0] // 2
    least = min(half, reach)
    window = search._to_far[:, half - least : half + least + 1, half - least : half + least + 1]
    kernel = coarse[reach - least : reach + least + 1, reach - least : reach + least + 1]
    for k, n in enumerate(solution().part[:4]):
        dark = solution().sky.dark[n]
        (plane,) = sensitivities(solution().optics, dark, np.full((1, dark[0].size), 1 / dark[0].size))
        moved = float(np.vdot(plane, view.blurred(n, blur)))
        assert float(np.vdot(window[k], kernel)) == pytest.approx(moved, rel=0.05)


@pytest.mark.parametrize("halo", HALOS[:6])
def test_a_halo_of_share_one_holds_all_light(halo: Halo) -> None:
    kernel = halo(2047)
    assert kernel.min() >= 0 and kernel.shape == (2047, 2047)
    assert kernel[1023, 1023] == kernel.max()
    beyond = 0.08  # one thirteenth of a Moffat of 80 px lies outside the plane
    assert float(kernel.sum()) == pytest.approx(1.0, abs=beyond)


def test_a_wide_halo_is_found_at_about_its_width() -> None:
    """An exponential of 30 px, between two scales of the search; the refitted power law absorbs most of it."""
    plan = default_plan(18, 128, oversampling=1, brightness=60.0)
    kernel = crop_or_pad(diffraction(), 255)
    y, x = np.indices(kernel.shape) - 127
    wide = np.exp(-np.hypot(x, y) / 30.0)
    transit = simulate(plan, TRUTH, 0.8 * kernel + 0.2 * wide / wide.sum(), seed=4).transit
    found = invert(replace(transit, diffraction=kernel))
    view = View(found)
    assert _halo(view).best in HALOS[2:6]
    halo = effect("wide_halo")
    assert halo.distinguished is not None and halo.held is not None
    held = halo.held(view).distinguished
    assert held is not None and held(View(solution())) == halo.distinguished(view), (
        "of the search, not of the refit"
    )
    library = [effect("wide_halo"), effect("dark_offset")]
    model = LinearModel(gather(found, library), FLOOR)
    share, sigma, _ = fit_effects(model, library[:1]).values["share"]
    assert share > 5 * sigma


def brightening(share: float) -> Transit:
    """A patch of the first pointing brightens by a share over its images; behind the occulter it does not show."""
    transit = clean()
    first = [frame for frame in transit.frames if frame.pointing == 1]
    start, end = first[0].time_s, first[-1].time_s
    y, x = np.indices(transit.shape)
    patch = np.exp(-((y - 90) ** 2 + (x - 40) ** 2) / (2 * 15**2))
    frames = []
    for frame in transit.frames:
        at = (frame.time_s - start) / (end - start) - 0.5 if frame.pointing == 1 else 0.0
        seen = 1 + share * at * patch * (1 - coverage(transit.shape, frame.place))
        frames.append(replace(frame, pixels=(frame.pixels * seen).astype(np.float32)))
    return replace(transit, frames=tuple(frames))


@pytest.mark.parametrize(("share", "seen"), [(0.0, False), (1.0, True)])
def test_a_changing_sun_shows_only_in_the_unocculted_field(share: float, seen: bool) -> None:
    evidence = gather(invert(brightening(share)), [effect("scene_evolution")])
    columns = evidence.columns["scene_evolution"]
    assert all((disc.jacobian[list(columns)] == 0).all() for disc in evidence.discs)
    model = LinearModel(evidence, FLOOR)
    fit = fit_effects(model, evidence.effects)
    # It pays for every number measured in the unocculted field, but for no more than that field has.
    assert 10 < evidence.numbers_of(columns) < evidence.all_unocculted.freedom
    assert (fit.p_value < 1e-6) == seen
    # The change is linear in time, so the uneven part is left out.
    assert set(fit.values) == ({"rms"} if seen else set())


@pytest.mark.parametrize(
    ("gains", "wanted"),
    [([3.0, 3.0, 3.0], 1.0), ([80.0, 0.0, 0.0, 0.0], 4.0), ([80.0, 80.0, 0.0, 0.0], 2.0), ([7.0], 1.0)],
)
def test_templates_that_explain_the_data_equally_well_are_not_distinguished(
    gains: list[float], wanted: float
) -> None:
    assert distinguished(np.array(gains)) == pytest.approx(wanted)


def test_a_copy_is_found_at_its_place() -> None:
    dx, dy = 66, -30
    transit = simulate(
        default_plan(9, 160, oversampling=1, brightness=4.0), TRUTH, diffraction(), seed=5
    ).transit
    frames = tuple(
        replace(f, pixels=f.pixels + 0.05 * displaced(gaussian_filter(f.pixels, 4.0), dx, dy))
        for f in transit.frames
    )
    blur, x, y = PlaceSearch(View(invert(replace(transit, frames=frames)))).copy
    assert (x, y) == pytest.approx((dx, dy), abs=6) and blur in (2.0, 4.0, 8.0)
