"""Searches before a fit: changes of the PSF, rotated meshes, blurs, halos and copies; patches around the discs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, rotate

from psfcore.arrays import cut
from psfcore.convolution.convolver import correlations
from psfcore.gap.evidence.cells import cells_of, sensitivities, whitening
from psfcore.gap.evidence.effect_fits import fit_effects
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.responses import gather
from psfcore.gap.evidence.search import NearDisc, displaced, distinguished, near_discs, place_search
from psfcore.gap.library.optics import ANGLES_DEG, BETWEEN_THEM, BLURS, DIRECTIONS, HALOS, blur_as
from psfcore.gap.view import View
from psfcore.psf import crop_or_pad
from psfcore.scatter.total_psf import Blur
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from tests.psfcore.gap.small_gaps import changed, clean, effect, fit, solution, view
from tests.transit_files import TRUTH, diffraction

Plane = NDArray[np.float64]
LINE = ((1, -1),)


def along_line(plane: np.ndarray) -> np.ndarray:
    """The plane, blurred by 1.5 px along LINE: nine steps of a random walk, each of variance 1/4 px2."""
    for _ in range(9):
        forth, back = (np.roll(plane, (step, -step), (0, 1)) for step in (1, -1))
        plane = (forth + 14 * plane + back) / 16
    return plane


@cache
def near() -> list[NearDisc]:
    return near_discs(view(), solution().part)


def response(n: int, change: Plane) -> float:
    """The response of the mean of disc n to a change of the PSF, from its sensitivities in the whole field."""
    dark = solution().sky.dark[n]
    (plane,) = sensitivities(solution().optics, dark, np.full((1, dark[0].size), 1 / dark[0].size))
    return float(np.vdot(plane, view().blurred(n, Blur(change, solution().transit.shape))))


def gain_by_hand(change: Plane, with_cells: bool) -> float:
    """Eq. (2) of `search` for a change of the PSF."""
    frames = solution().inversion.frames
    sigma = np.array([np.hypot(f.noise, FLOOR * f.expected) for f in frames])
    means = np.array([response(n, change) for n in solution().part]) / sigma
    residual = np.array([f.observed - f.expected for f in frames]) / sigma
    absorbed = np.array([f.mean_jacobian for f in frames]) / sigma[:, None]
    if with_cells:
        means = np.append(means, [disc.of_kernel(change) for disc in near()])
        residual = np.append(residual, [disc.residual for disc in near()])
        slopes = view().slope_kernels
        absorbed = np.vstack([absorbed, *(np.array([d.of_kernel(k) for k in slopes]).T for d in near())])
    basis = np.linalg.qr(absorbed)[0]
    left, seen = (one - basis @ (basis.T @ one) for one in (residual, means))
    along = float(left @ seen)
    return max(along, 0.0) ** 2 / float(seen @ seen)


def test_the_gain_of_a_change_of_the_psf_is_that_of_the_whole_field() -> None:
    search = place_search(view())
    assert place_search(view()) is search
    kernel = np.random.default_rng(1).normal(size=(31, 31))
    for change in (kernel, -kernel):
        assert search.kernels([change])[0] == pytest.approx(gain_by_hand(change, True), rel=0.02, abs=1e-3)
    wide = HALOS[2](255)
    for change in (wide, -wide):
        assert search.wide_kernels([change])[0] == pytest.approx(
            gain_by_hand(change, False), rel=0.1, abs=0.1
        )
    assert search.kernels([kernel, -kernel]).max() > 0.01
    for gains, number in (([3, 3, 3], 1.0), ([80, 0, 0, 0], 4.0), ([80, 80, 0, 0], 2.0), ([7], 1.0)):
        assert distinguished(np.array(gains, dtype=float)) == pytest.approx(number), gains


def test_a_blur_is_not_negative_and_has_its_nominal_width() -> None:
    """The change by a blur, per unit of its variance, of a point that is seen with a PSF that is a point."""
    point = np.zeros((63, 63))
    point[31, 31] = 1.0
    size = SimpleNamespace(transit=SimpleNamespace(shape=point.shape), threads=1)
    sharp = SimpleNamespace(
        kernel=point,
        solution=size,
        blurred=lambda n, blur, weight: blur.field(blur.convolve(blur.lanes(point))),
    )
    y, x = np.indices(point.shape) - 31
    for width, steps in BLURS:
        (change,) = blur_as(cast(View, sharp), width, steps)
        seen = point + width**2 * change.change(0, [])
        assert seen.min() > -1e-5 and seen.sum() == pytest.approx(1.0, abs=1e-5)
        # Along its own direction; an even one along any.
        dy, dx = steps[0]
        along = (y * dy + x * dx) / np.hypot(dy, dx)
        assert float((seen * along**2).sum()) == pytest.approx(width**2, rel=1e-3), (width, steps)
    assert {steps for _, steps in BLURS} == {*DIRECTIONS, *BETWEEN_THEM}


def test_a_turned_mesh_is_found_at_its_angle() -> None:
    """The rotation is larger than the width of the orders, so a derivative could not find it."""
    cross = np.zeros((127, 127))  # a core with orders from 3 to 45 px
    for r in range(3, 46, 3):
        cross[63, 63 + r] = cross[63, 63 - r] = cross[63 + r, 63] = cross[63 - r, 63] = 1 / r
    cross *= 0.3 / cross.sum()
    cross[63, 63] = 0.7
    turned = np.maximum(rotate(cross, 12.0, reshape=False, order=1), 0.0)
    plan = default_plan(12, 128, oversampling=1, brightness=8.0)
    transit = simulate(plan, TRUTH, turned / turned.sum(), seed=4).transit
    turned_mesh = fit(replace(transit, diffraction=cross))
    mesh, seen = effect("mesh_rotation"), View(turned_mesh)
    model = LinearModel(gather(turned_mesh, [mesh], view=seen), FLOOR)
    angle_deg, sigma_deg, unit = fit_effects(model, [mesh]).values["angle"]
    assert unit == "deg" and angle_deg == pytest.approx(12.0, abs=2.0) and sigma_deg < 2.0
    assert mesh.distinguished is not None
    assert 1 <= mesh.distinguished(seen) <= 2 * len(ANGLES_DEG)


def test_a_halo_of_share_one_holds_all_light() -> None:
    for halo in HALOS[:4]:
        kernel = halo(1023)
        assert kernel.min() >= 0 and kernel.shape == (1023, 1023)
        assert kernel[511, 511] == kernel.max()
        # One thirteenth of a Moffat of 40 px lies outside the plane.
        assert float(kernel.sum()) == pytest.approx(1.0, abs=0.08)


def test_a_wide_halo_is_found_at_about_its_width() -> None:
    """An exponential of 30 px, between two scales of the search; the refitted power law absorbs most of it."""
    plan = default_plan(18, 128, oversampling=1, brightness=60.0)
    kernel = crop_or_pad(diffraction(), 255)
    y, x = np.indices(kernel.shape) - 127
    wide = np.exp(-np.hypot(x, y) / 30.0)
    transit = simulate(plan, TRUTH, 0.8 * kernel + 0.2 * wide / wide.sum(), seed=4).transit
    seen, halo = View(fit(replace(transit, diffraction=kernel))), effect("wide_halo")
    size = seen.solution.total.size
    gains = place_search(seen).wide_kernels([one(size) for one in HALOS])
    assert 2 <= int(np.argmax(gains)) < 6
    assert halo.distinguished is not None and halo.held is not None
    held = halo.held(seen).distinguished
    assert held is not None
    # Of the search, not of the refit.
    assert held(view()) == halo.distinguished(seen) == pytest.approx(distinguished(gains))
    library = [halo, effect("dark_offset")]
    model = LinearModel(gather(seen.solution, library, view=seen), FLOOR)
    share, sigma, _ = fit_effects(model, library[:1]).values["share"]
    assert share > 5 * sigma


def test_a_copy_is_found_at_its_place_with_its_blur() -> None:
    transit = changed(
        clean(), lambda n, f: f.pixels + 0.06 * displaced(gaussian_filter(f.pixels, 8.0), 24, 16)
    )
    (blur_px, x, y), copies = place_search(View(fit(transit))).copy
    assert copies > 10 * place_search(view()).copy[1]  # noise alone prefers no displacement
    assert (x, y) == pytest.approx((24, 16), abs=4) and blur_px in (4.0, 8.0)


def test_the_direction_of_a_directional_blur_is_found() -> None:
    """The discs' means hardly show it, but their outermost cells do."""
    seen = View(fit(changed(clean(), lambda n, f: along_line(f.pixels.astype(np.float64)))))
    (found,) = effect("core_blur").changes(seen)
    first = found.change(0, seen.expected)
    (same,) = [
        (width, steps)
        for width, steps in BLURS
        if np.allclose(blur_as(seen, width, steps)[0].change(0, seen.expected), first)
    ]
    assert same[1] == LINE and same[0] <= 1.5


# --- patches around the discs -----------------------------------------------------------------------------


def by_whole_field(image: np.ndarray, n: int) -> np.ndarray:
    """The response of the cells of disc n to an image, by sensitivities of the whole field, without its brightness."""
    place, dark = solution().sky.found[n].place, solution().sky.dark[n]
    cells = cells_of(dark, place.x_px, place.y_px)
    planes = sensitivities(solution().optics, dark, cells.weights)
    frame = solution().transit.frames[n]
    variance = solution().transit.noise.variance(frame.pixels.astype(np.float64), frame.exposure_s)
    flat = planes.reshape(planes.shape[0], -1).astype(np.float64)
    white = whitening((flat * variance.ravel()) @ flat.T)
    level = white @ (cells.weights @ solution().residual(n)[1])
    moved = white @ (flat @ image.ravel())
    return np.asarray(moved - level * float(level @ moved) / float(level @ level))


def test_sums_over_displacements_and_whitening_match_their_definitions() -> None:
    rng = np.random.default_rng(1)
    planes, scene, reach = rng.normal(size=(2, 6, 7)), rng.normal(size=(12, 13)), 3
    sums = correlations(planes, scene, reach)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            there = scene[reach - dy : reach - dy + 6, reach - dx : reach - dx + 7]
            by_hand = (planes * there).sum(axis=(1, 2))
            assert sums[:, reach + dy, reach + dx] == pytest.approx(by_hand)
    assert not whitening(np.zeros((3, 3))).any()
    row = np.array([1.0, 2.0, -1.0])
    white = whitening(np.outer(row, row))
    assert np.isfinite(white).all()
    assert np.linalg.norm(white @ row) == pytest.approx(1.0)


def test_a_patch_gives_the_same_response_as_the_whole_field() -> None:
    plane = np.arange(20.0).reshape(4, 5)
    assert cut(plane, -1, 3, (3, 3)).tolist() == [[0, 0, 0], [3, 4, 0], [8, 9, 0]]
    assert cut(plane, 2, -1, (2, 3)).tolist() == [[0, 10, 11], [0, 15, 16]]
    assert not cut(plane, 7, 0, (3, 3)).any() and not cut(plane, 0, -9, (3, 3)).any()
    kernel = crop_or_pad(view().kernel, 129)
    change = along_line(kernel) - kernel
    shape = solution().transit.shape
    for k in (5, 9):
        n, near_disc = solution().part[k], near()[k]
        whole = by_whole_field(view().blurred(n, Blur(change, shape)).astype(np.float64), n)
        assert np.linalg.norm(near_disc.of_kernel(change) - whole) < 0.05 * np.linalg.norm(whole)
        copy = gaussian_filter(view().expected[n], 3.0)
        around = near_disc.of_copies(copy, 20, -12, 2)
        assert around.shape[1:] == (5, 5)
        for dx, dy in ((0, 0), (2, -1)):
            whole = by_whole_field(displaced(copy, 20 + dx, -12 + dy).astype(np.float64), n)
            # A copy is light all over the field, and what scatters in from beyond the patch is left out.
            left = around[:, 2 + dy, 2 + dx] - whole
            assert np.linalg.norm(left) < 0.5 * np.linalg.norm(whole)
    plan = default_plan(12, 76, oversampling=1, brightness=8.0)
    small = View(fit(simulate(plan, TRUTH, diffraction(), seed=3).transit))
    shape, n = small.solution.transit.shape, small.solution.part[0]
    (disc,) = near_discs(small, [n])
    change = along_line(small.kernel) - small.kernel
    moved = disc.of_copies(small.blurred(n, Blur(change, shape)), 0, 0, 0)[:, 0, 0]
    assert disc.residual.shape == moved.shape
    assert np.linalg.norm(disc.of_kernel(change) - moved) < 0.05 * np.linalg.norm(moved)
