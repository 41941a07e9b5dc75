"""What is looked for before it is fitted: changes of the PSF, a turned mesh, a blur, a Sun that changes; and a second effect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, rotate

from psfcore.errors import DataError
from psfcore.gap.effect import Effect, View, _ratio
from psfcore.gap.evidence.cells import sensitivities
from psfcore.gap.evidence.evidence import gather
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.search import STEP_PX, coarse_kernel, displaced, place_search
from psfcore.gap.library.optics import (
    ANGLES_DEG,
    BETWEEN_THEM,
    BLURS,
    DIRECTIONS,
    HALOS,
    Halo,
    _blurred,
    _copy,
    _sought,
    _sought_halo,
    _turned,
)
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.verdict import correction
from psfcore.gap.verdict import judge as judging
from psfcore.gap.verdict.correction import _with_noise_of, add_to_model, beyond, corrected
from psfcore.gap.verdict.judge import fitted
from psfcore.psf import crop_or_pad
from psfcore.scatter.inversion import Solution, invert
from psfcore.scatter.optics import Blur
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.occulter import coverage
from psfcore.transit.transit import Transit
from tests.transit_files import TRUTH, diffraction

Plane = NDArray[np.float64]


@cache
def clean(images: int = 18) -> Transit:
    plan = default_plan(images, 128, oversampling=1, brightness=8.0)
    return simulate(plan, TRUTH, diffraction(), seed=3).transit


@cache
def solution() -> Solution:
    return invert(clean())


def effect(name: str):  # type: ignore[no-untyped-def]
    return next(one for one in LIBRARY if one.name == name)


def test_a_change_of_the_psf_moves_the_discs_as_its_sum_over_displacements_says() -> None:
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


def test_a_blur_is_nowhere_negative_and_as_wide_as_it_says() -> None:
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
    """A core with orders along a cross that is 3 to 45 px from it, 127 px, sum 1."""
    plane = np.zeros((127, 127))
    for r in range(3, 46, 3):
        plane[63, 63 + r] = plane[63, 63 - r] = plane[63 + r, 63] = plane[63 - r, 63] = 1 / r
    plane *= 0.3 / plane.sum()
    plane[63, 63] = 0.7
    return plane


def test_a_turned_mesh_is_found_at_its_angle() -> None:
    """Turned by more than its orders are wide: what a derivative cannot tell."""
    plan = default_plan(12, 128, oversampling=1, brightness=8.0)
    turned = np.maximum(rotate(cross(), 12.0, reshape=False, order=1), 0.0)
    transit = simulate(plan, TRUTH, turned / turned.sum(), seed=4).transit
    view = View(invert(replace(transit, diffraction=cross())))
    assert _sought(view, _turned, ANGLES_DEG) == pytest.approx(12.0, abs=2.0)


def test_a_wide_change_of_the_psf_moves_the_discs_as_its_sum_over_coarse_displacements_says() -> None:
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
    beyond = 0.08  # of a Moffat of 80 px a thirteenth lies beyond the plane
    assert float(kernel.sum()) == pytest.approx(1.0, abs=beyond)


def test_a_wide_halo_is_found_at_about_its_width() -> None:
    """An exponential of 30 px, between two that are tried; the power law refitted takes up the most of it."""
    plan = default_plan(18, 128, oversampling=1, brightness=60.0)
    kernel = crop_or_pad(diffraction(), 255)
    y, x = np.indices(kernel.shape) - 127
    wide = np.exp(-np.hypot(x, y) / 30.0)
    transit = simulate(plan, TRUTH, 0.8 * kernel + 0.2 * wide / wide.sum(), seed=4).transit
    found = invert(replace(transit, diffraction=kernel))
    halo = _sought_halo(View(found))
    assert halo in HALOS[2:6]
    library = [effect("wide_halo"), effect("dark_offset")]
    model = LinearModel(gather(found, library), FLOOR)
    share, sigma, _ = fitted(model, library[:1]).values["share"]
    assert share > 5 * sigma


def brightening(share: float) -> Transit:
    """A patch of the first pointing brightens by a share in its images' time; behind the occulter it does not show."""
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
def test_a_sun_that_changes_shows_in_the_lit_parts_alone(share: float, seen: bool) -> None:
    evidence = gather(invert(brightening(share)), [effect("scene_evolution")])
    columns = evidence.columns["scene_evolution"]
    assert all((disc.answers[list(columns)] == 0).all() for disc in evidence.discs)
    model = LinearModel(evidence, FLOOR)
    tried = fitted(model, evidence.effects)
    # It pays for every number that was taken from the lit parts, and for no more than these have.
    assert 10 < evidence.numbers_of(columns) < evidence.whole_lit.freedom
    assert (tried.p_value < 1e-6, tried.score > 0) == (seen, seen)
    # It changed evenly: the uneven part is not worth its numbers.
    assert set(tried.values) == ({"rms"} if seen else set())


@pytest.mark.slow
def test_beside_an_effect_that_explains_the_lit_parts_a_second_is_found_in_the_discs() -> None:
    """A difference of gain, which the discs hide, and a light leak, which they alone show."""
    transit = clean()
    x = np.indices(transit.shape)[1] / 128 - 0.5
    frames = tuple(
        replace(
            frame,
            pixels=(
                (frame.pixels + 6.0 + 20.0 * x) * (1.1 if (frame.gain_mode or "") == "combined" else 1.0)
            ).astype(np.float32),
        )
        for frame in transit.frames
    )
    found = invert(replace(transit, frames=frames))
    library = [effect(name) for name in ("gain_mismatch", "intensity_gradient", "dark_offset", "core_blur")]
    model = LinearModel(gather(found, library), FLOOR)
    best = fitted(model, [library[0]])
    added = add_to_model(found, [library[0]], best, model)
    second = judging._beside(model, best, lambda tried: beyond(added, library, model))
    assert second is not None and second.verdict == "attributed"
    assert second.answer == ("gain_mismatch", "intensity_gradient")
    nothing = judging._beside(model, best, judging.no_refit)
    assert nothing is None


def test_a_round_that_leaves_more_than_the_one_before_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """An offset of 1 DN; in the second round the images lose what was never there."""
    offset = effect("dark_offset")
    frames = tuple(
        replace(frame, pixels=frame.pixels + np.float32(1.0 / frame.exposure_s)) for frame in clean().frames
    )
    found = invert(replace(clean(), frames=frames))
    model = LinearModel(gather(found, [offset]), FLOOR)
    taken_out: list[float] = []
    as_it_is = correction.corrected

    def spoiled(
        transit: Transit, view: View, effects: Sequence[Effect], theta: NDArray[np.float64]
    ) -> Transit:
        taken_out.append(float(theta[0]))
        again = as_it_is(transit, view, effects, theta)
        if len(taken_out) == 1:
            return again
        light = np.linspace(0.0, 40.0, again.shape[1], dtype=np.float32)
        return replace(again, frames=tuple(replace(f, pixels=f.pixels + light) for f in again.frames))

    monkeypatch.setattr(correction, "corrected", spoiled)
    monkeypatch.setattr(correction, "SETTLED", 0.0)
    added = add_to_model(found, [offset], fitted(model, [offset]), model)
    value, sigma, _ = added.values["offset"]
    assert len(taken_out) == 2 and added.rounds == 1
    assert value == pytest.approx(1.0, abs=4 * sigma)


def test_a_share_of_light_is_never_less_than_none() -> None:
    """Images that lost a share of their columns' light: by a smear that adds light nothing of it is explained."""
    smear = effect("column_smear")
    frames = tuple(
        replace(frame, pixels=frame.pixels - np.float32(0.03) * frame.pixels.mean(axis=0))
        for frame in clean().frames
    )
    found = invert(replace(clean(), frames=frames))
    model = LinearModel(gather(found, [smear]), FLOOR)
    below = fitted(model, [smear], any_sign=True)
    assert all(value < 0 for value, _, _ in below.values.values())
    with pytest.raises(DataError, match="expected column_smear to add light") as caught:
        add_to_model(found, [smear], below, model)
    assert caught.value.code == "effect-unseen"


def test_a_scene_is_as_bright_as_the_image_s_own() -> None:
    """The second image is 5 % brighter than the others of its pointing, which do not know it."""
    frames = tuple(
        replace(frame, pixels=frame.pixels * np.float32(1.05 if n == 1 else 1.0))
        for n, frame in enumerate(clean().frames)
    )
    view = View(invert(replace(clean(), frames=frames)))
    of_one, of_next = (float(view.expected[n].mean() / frames[n].pixels.mean()) for n in (1, 2))
    assert of_one == pytest.approx(of_next, rel=2e-3)
    assert _ratio(2.0, 4.0) == 0.5 and _ratio(-1.0, 4.0) == 0.0 and _ratio(1.0, 0.0) == 1.0


def test_what_is_taken_out_of_an_image_is_as_bright_as_the_image() -> None:
    """A copy of every image, and a Sun that is not steady to 2 %: without the copy the images of a pointing agree no less."""
    rng = np.random.default_rng(4)
    frames = tuple(
        replace(
            frame,
            pixels=(
                (frame.pixels + 0.4 * displaced(gaussian_filter(frame.pixels, 12.0), 40, -30))
                * (1 + 0.02 * rng.standard_normal())
            ).astype(np.float32),
        )
        for frame in clean().frames
    )
    found = invert(replace(clean(), frames=frames))
    view, copy = View(found), replace(effect("ghost"), changes=lambda view: _copy(12.0, 40, -30), held=None)
    before = gather(found, [copy], view=view)
    without = invert(corrected(found.transit, view, [copy], np.array([0.4])))
    after = _with_noise_of(before, gather(without, [copy]))
    assert after.whole_lit.chi2 < before.whole_lit.chi2 * 1.02
