"""The response of the discs' cells to kernels and to copies of the image, computed in small patches around the discs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from psfcore.convolution.convolver import correlations
from psfcore.gap.evidence.cells import cells_of, sensitivities, whitening
from psfcore.gap.evidence.near_discs import NearDiscs, cut
from psfcore.gap.evidence.search import displaced, place_search
from psfcore.gap.library.optics import _blurred, _core_blur
from psfcore.gap.view import View
from psfcore.psf import crop_or_pad
from psfcore.scatter.inversion import invert
from psfcore.scatter.optics import Blur
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import Transit
from tests.transit_files import TRUTH, diffraction

LINE = ((1, -1),)


@cache
def clean() -> Transit:
    plan = default_plan(12, 160, oversampling=1, brightness=8.0)
    return simulate(plan, TRUTH, diffraction(), seed=3).transit


@cache
def view() -> View:
    return View(invert(clean()))


@cache
def near() -> NearDiscs:
    return place_search(view())._near


def by_whole_field(image: np.ndarray, n: int) -> np.ndarray:
    """The response of the cells of disc n to an image, by sensitivities of the whole field, without the disc's brightness."""
    solution = view().solution
    place, dark = solution.sky.found[n].place, solution.sky.dark[n]
    cells = cells_of(dark, place.x_px, place.y_px)
    planes = sensitivities(solution.optics, dark, cells.weights)
    frame = solution.transit.frames[n]
    variance = solution.transit.noise.variance(frame.pixels.astype(np.float64), frame.exposure_s)
    flat = planes.reshape(planes.shape[0], -1).astype(np.float64)
    white = whitening((flat * variance.ravel()) @ flat.T)
    level = white @ (cells.weights @ solution.residual(n)[1])
    moved = white @ (flat @ image.ravel())
    return np.asarray(moved - level * float(level @ moved) / float(level @ level))


def first_cells(responses: np.ndarray, disc: int) -> np.ndarray:
    """The cells of one disc among those of all."""
    sizes = [near()._planes[n].shape[0] for n in view().solution.part]
    return responses[sum(sizes[:disc]) : sum(sizes[: disc + 1])]


def test_sums_over_displacements_match_the_definition() -> None:
    rng = np.random.default_rng(1)
    planes, scene, reach = rng.normal(size=(2, 6, 7)), rng.normal(size=(12, 13)), 3
    found = correlations(planes, scene, reach)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            there = scene[reach - dy : reach - dy + 6, reach - dx : reach - dx + 7]
            by_hand = (planes * there).sum(axis=(1, 2))
            assert found[:, reach + dy, reach + dx] == pytest.approx(by_hand)


def test_a_patch_is_zero_outside_the_field() -> None:
    plane = np.arange(20.0).reshape(4, 5)
    assert cut(plane, -1, 3, (3, 3)).tolist() == [[0, 0, 0], [3, 4, 0], [8, 9, 0]]
    assert cut(plane, 2, -1, (2, 3)).tolist() == [[0, 10, 11], [0, 15, 16]]
    assert not cut(plane, 7, 0, (3, 3)).any() and not cut(plane, 0, -9, (3, 3)).any()


@pytest.mark.parametrize("disc", [5, 9])
def test_a_patch_gives_the_same_response_as_the_whole_field(disc: int) -> None:
    n = view().solution.part[disc]
    kernel = crop_or_pad(view().kernel, 129)
    change = _blurred(kernel, 1.5, LINE) - kernel
    found = first_cells(near().of_kernel(change), disc)
    shape = view().solution.transit.shape
    expected = by_whole_field(view().blurred(n, Blur(change, shape)).astype(np.float64), n)
    assert np.linalg.norm(found - expected) < 0.05 * np.linalg.norm(expected)
    copy = gaussian_filter(view().expected[n], 3.0)
    places = [(20, -12), (-30, 6)]
    found = near().of_copies(n, copy, places)
    for k, (dx, dy) in enumerate(places):
        expected = by_whole_field(displaced(copy, dx, dy).astype(np.float64), n)
        # A copy is light all over the field, and what scatters in from beyond the patch is left out.
        assert np.linalg.norm(found[:, k] - expected) < 0.5 * np.linalg.norm(expected)


def test_the_direction_of_a_directional_blur_is_found() -> None:
    """The discs' means hardly show it, but their outermost cells do."""
    blurred = tuple(
        replace(
            f,
            pixels=np.asarray(_blurred(f.pixels.astype(np.float64), 1.5, LINE), np.float32),
        )
        for f in clean().frames
    )
    width, steps = _core_blur(View(invert(replace(clean(), frames=blurred)))).best
    assert steps == LINE and width <= 1.5


def test_the_cells_give_the_place_and_blur_of_a_copy() -> None:
    dx, dy = 24, 16
    frames = tuple(
        replace(f, pixels=f.pixels + 0.06 * displaced(gaussian_filter(f.pixels, 8.0), dx, dy))
        for f in clean().frames
    )
    blur, x, y = place_search(View(invert(replace(clean(), frames=frames)))).copy
    assert (x, y) == pytest.approx((dx, dy), abs=4) and blur in (4.0, 8.0)


def test_a_field_smaller_than_a_patch_is_used_whole() -> None:
    plan = default_plan(12, 76, oversampling=1, brightness=8.0)
    small = View(invert(simulate(plan, TRUTH, diffraction(), seed=3).transit))
    found = place_search(small)._near
    shape = small.solution.transit.shape
    assert {plane.shape[1:] for plane in found._planes.values()} == {shape}
    assert found.residual.size == sum(plane.shape[0] for plane in found._planes.values())
    n = small.solution.part[0]
    change = _blurred(small.kernel, 0.8, LINE) - small.kernel
    first = found.of_kernel(change)[: found._planes[n].shape[0]]
    moved = found.of_copies(n, small.blurred(n, Blur(change, shape)), [(0, 0)])[:, 0]
    assert np.linalg.norm(first - moved) < 0.05 * np.linalg.norm(moved)


def test_whitening_handles_cells_without_independent_noise() -> None:
    assert not whitening(np.zeros((3, 3))).any()
    row = np.array([1.0, 2.0, -1.0])
    white = whitening(np.outer(row, row))
    assert np.isfinite(white).all()
    assert np.linalg.norm(white @ row) == pytest.approx(1.0)
