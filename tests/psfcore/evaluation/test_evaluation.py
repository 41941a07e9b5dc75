"""A PSF is judged by the light that it puts into an occulter: the true one leaves nothing, a wrong one what it must."""

from __future__ import annotations

import dataclasses
import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, gmres

from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.evaluation.evaluation import Evaluation, evaluate
from psfcore.evaluation.frame import FrameEvaluation
from psfcore.evaluation.plot import evaluation_png
from psfcore.evaluation.report import lines, report, slope_of, summaries, summary_of, trends
from psfcore.evaluation.superposed import Superposition
from psfcore.noise import Noise
from psfcore.scatter.inversion import LEAST_DARK_PIXELS, dark_pixels, invert
from psfcore.scatter.noise_transfer import noise_covariance
from psfcore.scatter.optics import Optics, pick, put
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from psfcore.scatter.validation.dark_offsets import DarkOffsetStudy, dark_offset_study, with_offset
from psfcore.scatter.validation.fold_fits import FoldKernels, fit_fold, fold_kernels
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import total_kernel
from psfcore.simulate.transit import simulate
from psfcore.transit.blocks import folds
from psfcore.transit.occulter import FoundPlace, fully_dark
from psfcore.transit.transit import Frame, Kernel, Place
from studies.transits import diffraction, drawn_truth
from tests.psfcore.small_transits import (
    DIFFRACTION,
    IMAGES,
    SCATTER,
    SIZE_PX,
    noise_free,
    observed,
    sky,
    solved,
    with_pixels,
)

SEEDS = range(11, 20)


@cache
def kernel_with(total: float = SCATTER.total) -> Kernel:
    """The true PSF, or one with another amount of scatter."""
    return total_kernel(dataclasses.replace(SCATTER, total=total), DIFFRACTION, 2 * SIZE_PX)


@cache
def judged(total: float = SCATTER.total) -> Evaluation:
    """The transit without noise, with a PSF that has so much scatter."""
    return evaluate(noise_free(sky()), lambda _: kernel_with(total))


@cache
def noisy(seed: int) -> Evaluation:
    """A transit with noise, with the true PSF."""
    return evaluate(observed(sky(), seed).transit, lambda _: kernel_with())


@cache
def held_out() -> FoldKernels:
    return fold_kernels(observed(sky()).transit, start=solved().inversion.coordinates)


@cache
def offsets() -> DarkOffsetStudy:
    return dark_offset_study(observed(sky()).transit, (-5.0, 5.0), nominal=solved().inversion)


def undone(through: Convolver, image: NDArray[np.float64]) -> NDArray[np.float64]:
    """What is seen as an image, by GMRES in double precision."""
    operator = LinearOperator(
        (image.size, image.size),
        lambda x: np.asarray(through.apply(x.reshape(image.shape))).ravel(),
        dtype=np.float64,
    )
    scene, failed = gmres(operator, image.ravel(), rtol=1e-7)
    assert failed == 0
    return np.asarray(scene).reshape(image.shape)


def rms(values: object) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# --- the answer -------------------------------------------------------------------------------------------


def test_the_true_psf_leaves_nothing() -> None:
    found = judged()
    assert len(found.frames) == IMAGES and not found.left_out
    assert max(abs(f.residual_pct) for f in found.frames) < 0.01
    assert max(float(np.abs(f.pe_pct).max()) for f in found.frames) < 0.1
    assert found.superposed.mape_mean_pct < 0.01
    for n, frame in enumerate(found.frames):
        assert frame.residual_against_pct(sky().noise_free[n]) == pytest.approx(frame.residual_pct, abs=1e-4)


@pytest.mark.parametrize("total", [1.1 * SCATTER.total, 0.0])
def test_a_wrong_psf_leaves_what_an_exact_inverse_leaves(total: float) -> None:
    """By brute force: the scene in double precision, blanked, seen again."""
    found = judged(total)
    through = Convolver(kernel_with(total), (SIZE_PX, SIZE_PX), dtype=np.float64)
    for n in (0, 5):
        frame, image = found.frames[n], found.transit.frames[n].pixels.astype(np.float64)
        lit = undone(through, image)
        lit[frame.dark] = 0.0
        expected, seen = through.apply(lit)[frame.dark].mean(), image[frame.dark].mean()
        assert frame.residual_pct == pytest.approx(100 * (expected - seen) / seen, abs=0.02)


def test_too_much_scatter_is_too_much_light_and_too_little_too_little() -> None:
    """A tenth more or less, of the half and more of a disc's light that is scattered."""
    more, less, none = (judged(share * SCATTER.total) for share in (1.1, 0.9, 0.0))
    for a, b, c in zip(more.frames, less.frames, none.frames, strict=True):
        assert 4 < a.residual_pct < 20 and -20 < b.residual_pct < -4
        assert a.residual_pct == pytest.approx(-b.residual_pct, rel=0.35)
        assert -100 < c.residual_pct < -40
        assert a.centre_pct > 4
    assert more.superposed.mpe_rms_pct > 4
    assert summaries(more)[-1].mean_pct > 5 > -5 > summaries(less)[-1].mean_pct


def test_it_is_what_the_inversion_says_of_its_own_solution() -> None:
    solution = solved()
    kernel = solution.total.kernel(solution.inversion.coordinates)
    found = evaluate(solution.transit, lambda _: kernel)
    for here, there in zip(found.frames, solution.inversion.frames, strict=True):
        assert here.residual_pct == pytest.approx(there.residual_pct, abs=0.03)
        assert here.noise_dn_s == pytest.approx(there.noise, rel=1e-3)
        assert here.observed_dn_s == pytest.approx(there.observed, rel=1e-4)


def test_threads_change_nothing() -> None:
    two = evaluate(noise_free(sky()), lambda _: kernel_with(0.3), threads=2)
    one = evaluate(noise_free(sky()), lambda _: kernel_with(0.3))
    for a, b in zip(one.frames, two.frames, strict=True):
        np.testing.assert_array_equal(a.simulated, b.simulated)
    np.testing.assert_array_equal(one.superposed.noise_mape_pct, two.superposed.noise_mape_pct)


# --- noise ------------------------------------------------------------------------------------------------


def test_residuals_scatter_by_their_stated_noise() -> None:
    """108 discs: the width of their pulls is known to 7 %."""
    frames = [frame for seed in SEEDS for frame in noisy(seed).frames]
    assert 0.83 < rms([f.residual_pct / f.noise_pct for f in frames]) < 1.17
    assert 0.83 < rms([f.error_dn_s / f.noise_dn_s for f in frames]) < 1.17
    centre = [f.centre_pct / f.centre_noise_pct for f in frames]
    assert 0.83 < rms(centre) < 1.17
    assert abs(np.mean(centre)) < 0.35 and abs(np.mean([f.residual_pct / f.noise_pct for f in frames])) < 0.35
    assert all(3 * f.noise_pct < f.centre_noise_pct < 8 * f.noise_pct for f in frames)


def test_noise_is_carried_as_pixel_after_pixel_would_carry_it() -> None:
    """Every pixel of a small field in turn brighter by one: what it does to the mean, and to a lopsided template."""
    size = 36
    optics = Optics(kernel_with(), (size, size))
    place = Place(20.3, 15.1, 5.2)
    dark = np.nonzero(fully_dark((size, size), place))
    lopsided = (dark[1] - place.x_px) / dark[0].size
    templates = [np.full(dark[0].size, 1 / dark[0].size), lopsided]
    frame = Frame("a", np.full((size, size), 9.0, np.float32), 1, place, 2.0, 0.0)
    by_hand = np.zeros((2, 2))
    for j in range(size * size):
        one = np.zeros((size, size), np.float32)
        one.flat[j] = 1.0
        scene = optics.invert_once(optics.lanes(one))
        put(scene, dark, 0.0)
        left = one[dark] - pick(optics.convolve(scene), dark)
        b = np.array([t @ left for t in templates])
        by_hand += np.outer(b, b) * (6.0 * 9.0 / 2.0 + 4.0 / 4.0)
    found = noise_covariance(optics, frame, dark, templates, Noise(6.0, 2.0))
    np.testing.assert_allclose(found, by_hand, rtol=2e-4, atol=1e-4 * by_hand.max())


def test_against_images_without_noise_little_is_left() -> None:
    against = [f.residual_against_pct(sky().noise_free[f.index]) for f in noisy(11).frames]
    assert rms(against) < 0.6 < rms([f.noise_pct for f in noisy(11).frames])


def test_maps_of_clean_images_are_what_noise_alone_makes() -> None:
    maps = [noisy(seed).superposed for seed in SEEDS]
    ratio = [m.mape_mean_pct / m.mape_noise_mean_pct for m in maps]
    assert np.abs(np.subtract(ratio, 1)).max() < 0.1
    assert np.mean(ratio) == pytest.approx(1, abs=0.03)
    assert np.mean([m.mpe_rms_pct / m.mpe_noise_rms_pct for m in maps]) == pytest.approx(1, abs=0.08)
    # Hand-made: E|N(0, s)| = s sqrt(2 / pi), s of a pixel's own photons and readout.
    noise = sky().plan.noise
    by_hand = [
        100 * np.sqrt(2 / np.pi * noise.variance(f.simulated, t.exposure_s)).mean() / f.observed_dn_s
        for f, t in zip(noisy(11).frames, noisy(11).transit.frames, strict=True)
    ]
    assert maps[0].mape_noise_mean_pct == pytest.approx(np.mean(by_hand), rel=0.08)


def test_maps_of_a_wrong_psf_are_not() -> None:
    wrong = evaluate(observed(sky(), 11).transit, lambda _: kernel_with(1.25 * SCATTER.total)).superposed
    assert wrong.mape_mean_pct > 1.15 * wrong.mape_noise_mean_pct
    assert wrong.mpe_rms_pct > 1.5 * wrong.mpe_noise_rms_pct


def test_errors_are_mapped_to_the_nearest_pixel_and_averaged_where_discs_are_dark() -> None:
    laid = Superposition(3.0, 1)
    rows, columns = np.array([20, 21, 20]), np.array([30, 30, 33])
    laid.add(Place(30.4, 19.6, 3.0), (rows, columns), np.array([1.0, 2.0, 3.0]), [np.array([4.0, -4.0, 0.0])])
    laid.add(Place(29.6, 20.4, 3.0), (rows[:2], columns[:2]), np.array([-3.0, 4.0]), [np.array([-2.0, 2.0])])
    maps = laid.superposed()
    assert maps.images == 2 and maps.half_px == 4 and maps.count.shape == (9, 9)
    assert maps.count[4, 4] == 2 and maps.count[4, 7] == 1 and maps.count.sum() == 5
    assert (maps.mpe_pct[4, 4], maps.mape_pct[4, 4]) == (-1.0, 2.0)
    assert (maps.mpe_pct[5, 4], maps.mape_pct[5, 4]) == (3.0, 3.0)
    assert (maps.noise_mpe_pct[4, 4], maps.noise_mape_pct[4, 4]) == (1.0, 3.0)
    assert np.isnan(maps.mpe_pct).sum() == 81 - 3
    assert (maps.mape_mean_pct, maps.mape_largest_pct) == (8 / 3, 3.0)
    assert maps.mpe_rms_pct == pytest.approx(np.sqrt(19 / 3))
    for _ in range(3):  # a place that fewer than half of the images show is no place of the map
        laid.add(Place(30.0, 20.0, 3.0), (rows[:1], columns[:1]), np.array([0.0]), [np.array([0.0])])
    assert np.isfinite(laid.superposed().mpe_pct).sum() == 1


# --- whose PSF --------------------------------------------------------------------------------------------


def test_each_image_is_judged_with_its_own_psf_alone() -> None:
    """What a frame gives does not depend on the PSF of others, not even where they are its neighbours."""
    kernels = [kernel_with(0.3) if n % 2 else kernel_with() for n in range(IMAGES)]
    mixed = evaluate(observed(sky(), 11).transit, lambda n: kernels[n])
    alone = noisy(11)
    for n in range(0, IMAGES, 2):
        assert mixed.frames[n].found == alone.frames[n].found
        np.testing.assert_array_equal(mixed.frames[n].simulated, alone.frames[n].simulated)
    assert [f.index for f in mixed.frames] == list(range(IMAGES))
    assert all(mixed.frames[n].residual_pct < -5 for n in range(1, IMAGES, 2))


def test_a_fold_s_psf_knows_nothing_of_what_it_holds_out() -> None:
    transit, fold = observed(sky()).transit, folds(IMAGES)[3]
    start = solved().inversion.coordinates
    hidden = set(range(IMAGES)) - set(fold.fitted)
    assert len(hidden) > len(fold.held_out)
    spoilt = [np.zeros_like(f.pixels) if n in hidden else f.pixels for n, f in enumerate(transit.frames)]
    once = fit_fold(transit, fold, start=start)
    np.testing.assert_array_equal(
        fit_fold(with_pixels(transit, spoilt), fold, start=start).kernel, once.kernel
    )
    assert len(once.inversion.frames) == len(fold.fitted)
    moved = np.abs(once.inversion.coordinates - start) / np.sqrt(np.diag(once.inversion.covariance))
    assert 0.02 < moved.max() < 4


def test_every_image_has_the_psf_of_the_fold_that_holds_it_out() -> None:
    kernels = held_out()
    assert len(kernels.fits) == len(folds(IMAGES)) == 4
    for fit in kernels.fits:
        for n in fit.fold.held_out:
            assert kernels(n) is fit.kernel
    assert len({id(kernels(n)) for n in range(IMAGES)}) == 4
    found = evaluate(observed(sky()).transit, kernels)
    against = [f.residual_against_pct(sky().noise_free[f.index]) for f in found.frames]
    assert 0.2 < rms(against) < 2.5


def test_a_few_images_make_no_folds_and_a_fold_that_fails_is_named() -> None:
    transit = noise_free(sky())
    with pytest.raises(DataError, match=r"too-few-frames.*at least 6 images.*got 5"):
        fold_kernels(dataclasses.replace(transit, frames=transit.frames[:5]))
    emptied = [f.pixels if n < 4 else np.full_like(f.pixels, 7.0) for n, f in enumerate(transit.frames)]
    with pytest.raises(DataError, match=r"too-few-frames: without 000\.fits to 002\.fits: expected"):
        fold_kernels(with_pixels(transit, emptied), start=solved().inversion.coordinates)


# --- trends -----------------------------------------------------------------------------------------------


def x_px(frame: FrameEvaluation) -> float:
    return frame.found.place.x_px


def noise_dn_s(frame: FrameEvaluation) -> float:
    return frame.noise_dn_s


def test_a_gradient_over_the_detector_is_found() -> None:
    """Even light, in proportion to the occulter's x, leaves D H D G e: what a disc of it would hold of itself."""
    clean = noise_free(sky())
    added = np.array([0.02 * f.place.x_px for f in clean.frames])  # DN/s
    transit = with_pixels(clean, [f.pixels + a for f, a in zip(clean.frames, added, strict=True)])
    found = evaluate(transit, lambda _: kernel_with())
    through = Convolver(kernel_with(), (SIZE_PX, SIZE_PX), dtype=np.float64)
    behind = undone(through, np.ones((SIZE_PX, SIZE_PX)))
    left = []
    for frame, light in zip(found.frames, added, strict=True):
        disc = np.zeros((SIZE_PX, SIZE_PX))
        disc[frame.dark] = light * behind[frame.dark]
        left.append(-through.apply(disc)[frame.dark].mean())
    share = -np.array(left) / added
    assert share.min() > 0.6 and share.max() < 1
    for trend in (t for t in trends(found) if t.against == "x"):
        here = [n for n, f in enumerate(found.frames) if f.fov == trend.fov]
        where, noise = (np.array([get(found.frames[n]) for n in here]) for get in (x_px, noise_dn_s))
        expected = np.polyfit(where, np.array(left)[here], 1, w=1 / noise)[0]
        assert trend.absolute_dn_s.per_100_px == pytest.approx(100 * expected, rel=0.03)
        assert expected < -0.012
    for trend in trends(judged()):
        assert abs(trend.absolute_dn_s.per_100_px) < 0.02 and abs(trend.relative_pct.per_100_px) < 0.02
    assert {(t.fov, t.against, t.images) for t in trends(found)} == {
        (f, a, 4) for f in (1, 2, 3) for a in "xy"
    }


def test_a_slope_and_its_error_are_those_of_weighted_least_squares() -> None:
    rng = np.random.default_rng(5)
    where, noise = rng.uniform(0, 500, 30), rng.uniform(0.5, 3, 30)
    pulls = []
    for _ in range(300):
        error = 2.0 + 0.013 * where + noise * rng.normal(size=30)
        slope = slope_of(where, error, noise)
        pulls.append((slope.per_100_px - 1.3) / slope.sigma)
    (by_numpy, _), covariance = np.polyfit(where, error, 1, w=1 / noise, cov="unscaled")
    assert slope.per_100_px == pytest.approx(100 * by_numpy)
    assert slope.sigma >= 100 * math.sqrt(covariance[0, 0]) * (1 - 1e-9)
    assert 0.8 < np.std(pulls) < 1.05 and abs(np.mean(pulls)) < 0.2
    # Beyond noise the slope is as unsure as the scatter shows: three times as much.
    wild = slope_of(where, error + 8 * noise * rng.normal(size=30), noise)
    assert 5 < wild.sigma / slope.sigma < 11


def test_two_images_or_one_place_have_no_trend() -> None:
    transit = noise_free(sky())
    two = evaluate(
        dataclasses.replace(transit, frames=(*transit.frames[:2], *transit.frames[4:8])),
        lambda _: kernel_with(),
    )
    assert {t.fov for t in trends(two)} == {2}


# --- images that take no part -----------------------------------------------------------------------------


def test_images_that_cannot_be_judged_are_named() -> None:
    transit = noise_free(sky())
    pixels = [f.pixels for f in transit.frames]
    pixels[6] = sky().seen_scenes[2].astype(np.float32)
    place = transit.frames[0].place
    y, x = (a - b for a, b in zip(np.indices((SIZE_PX, SIZE_PX)), (place.y_px, place.x_px), strict=True))
    pixels[0] = np.where(np.hypot(x, y) < place.radius_px, np.float32(-2.0), pixels[0])
    frames = list(with_pixels(transit, pixels).frames)
    frames[2] = dataclasses.replace(frames[2], filled=np.ones((SIZE_PX, SIZE_PX), bool))
    found = evaluate(dataclasses.replace(transit, frames=tuple(frames)), lambda _: kernel_with())
    assert set(found.left_out) == {"000.fits", "002.fits", "006.fits"}
    assert "found none there" in found.left_out["006.fits"] and "-2 DN/s" in found.left_out["000.fits"]
    assert found.left_out["002.fits"] == f"expected at least {LEAST_DARK_PIXELS} fully dark pixels; got 0"
    assert [f.index for f in found.frames] == [1, 3, 4, 5, 7, 8, 9, 10, 11]
    # The neighbours in time of a frame without occulter are none the worse for it.
    assert max(abs(f.residual_pct) for f in found.frames) < 0.3
    assert any("002.fits" in line for line in lines(found))


def test_a_transit_without_any_occulter_is_refused() -> None:
    filled = np.ones((SIZE_PX, SIZE_PX), bool)
    transit = noise_free(sky())
    frames = tuple(dataclasses.replace(f, filled=filled) for f in transit.frames)
    with pytest.raises(DataError, match=r"no-occulter.*000\.fits: expected at least"):
        evaluate(dataclasses.replace(transit, frames=frames), lambda _: kernel_with())


def test_a_centre_that_is_filled_has_no_error_of_its_own() -> None:
    transit = noise_free(sky())
    place = transit.frames[5].place
    filled = np.zeros((SIZE_PX, SIZE_PX), bool)
    y, x = round(place.y_px), round(place.x_px)
    filled[y - 5 : y + 6, x - 5 : x + 6] = True
    frames = list(transit.frames)
    frames[5] = dataclasses.replace(frames[5], filled=filled)
    found = evaluate(dataclasses.replace(transit, frames=tuple(frames)), lambda _: kernel_with())
    assert math.isnan(found.frames[5].centre_pct) and math.isnan(found.frames[5].centre_noise_pct)
    said = report(found)
    assert said["frames"][5]["centre_residual_pct"] is None
    assert math.isfinite(said["pointings"][1]["centre_mean_pct"])


# --- slices, report, picture ------------------------------------------------------------------------------


def test_slices_run_through_the_middle_of_discs() -> None:
    found = judged(1.1 * SCATTER.total)
    kept = [f for f in found.frames if f.along_x is not None]
    assert [sum(f.fov == fov for f in kept) for fov in (1, 2, 3)] == [3, 3, 3]
    frame = kept[4]
    assert frame.along_x is not None and frame.along_y is not None
    y, x = round(frame.found.place.y_px), round(frame.found.place.x_px)
    pixels = found.transit.frames[frame.index].pixels
    np.testing.assert_array_equal(frame.along_x.observed, pixels[y, x - 20 : x + 21])
    np.testing.assert_array_equal(frame.along_y.observed, pixels[y - 20 : y + 21, x])
    assert frame.along_x.offset_px[20] == pytest.approx(x - frame.found.place.x_px)
    assert {int(along.dark.sum()) for along in (frame.along_x, frame.along_y)} <= {20, 21}
    row = frame.dark[0] == y
    np.testing.assert_allclose(frame.along_x.simulated[frame.along_x.dark], frame.simulated[row])
    assert (frame.along_x.simulated > frame.along_x.observed)[frame.along_x.dark].all()


def test_slices_end_where_the_field_ends() -> None:
    frame = judged().frames[0]
    assert frame.along_x is not None
    first = round(frame.found.place.x_px) - 20
    assert first < 0
    assert frame.along_x.offset_px.size == 41 + first
    assert frame.along_x.offset_px[0] == pytest.approx(-frame.found.place.x_px)


def made_up(error_dn_s: float, noise_dn_s: float, observed_dn_s: float = 50.0) -> FrameEvaluation:
    rows, columns = (a.ravel() for a in np.mgrid[18:23, 28:33])
    found = FoundPlace(Place(30.0, 20.0, 10.75), 0.1, 0.1, 1.0, 4, 3, True)
    level = np.full(25, observed_dn_s)
    return FrameEvaluation(
        0, "a", 1, 0.0, found, (rows, columns), level, level + error_dn_s, noise_dn_s, 2 * noise_dn_s
    )


def test_figures_of_some_images() -> None:
    said = summary_of([made_up(1.0, 0.5), made_up(-2.0, 0.5), made_up(4.0, 2.0, observed_dn_s=100.0)], 7)
    assert (said.fov, said.images) == (7, 3)
    assert (said.mean_pct, said.largest_pct) == pytest.approx((2 / 3, 4.0))
    assert said.rms_pct == pytest.approx(math.sqrt((4 + 16 + 16) / 3))
    assert said.noise_pct == pytest.approx(math.sqrt((1 + 1 + 4) / 3))
    assert said.mean_noise_pct == pytest.approx(math.sqrt(6) / 3)
    assert said.gap_pct == pytest.approx(math.sqrt(10))
    assert (said.mean_dn_s, said.rms_dn_s) == pytest.approx((1.0, math.sqrt(7)))
    assert said.centre_noise_pct == pytest.approx(2 * said.noise_pct)
    assert summary_of([made_up(0.1, 1.0)], 1).gap_pct == 0


def test_a_residual_is_over_the_mean_observed() -> None:
    frame = dataclasses.replace(
        made_up(0.0, 1.0), observed=np.array([10.0, 20, 30]), simulated=np.array([12.0, 18, 33])
    )
    assert frame.residual_pct == pytest.approx(5.0)
    assert frame.pe_pct.tolist() == pytest.approx([10, -10, 15])
    assert frame.noise_pct == pytest.approx(5.0)


def test_the_report_is_plain_json_and_says_what_the_lines_say() -> None:
    found = noisy(11)
    said = json.loads(json.dumps(report(found, offsets()), allow_nan=False))
    assert said["schema"] == "evaluation/1"
    assert [p["fov"] for p in said["pointings"]] == [1, 2, 3] and said["all"]["images"] == IMAGES
    assert len(said["frames"]) == IMAGES and len(said["slices"]) == 9 and len(said["trends"]) == 6
    assert said["all"]["mean_pct"] == pytest.approx(np.mean([f["residual_pct"] for f in said["frames"]]))
    maps = said["superposed"]
    middle = maps["centre_index"]
    assert maps["mape_pct"][middle][middle] > 0 and maps["mape_pct"][0][0] is None
    text = "\n".join(lines(found, offsets()))
    assert f"all pointings: 12 images, mean {said['all']['mean_pct']:+.2f} %" in text
    assert f"MAPE {maps['mape_mean_pct']:.2f} %" in text
    assert f"at most {said['dark_offsets']['largest_weight_change_pct']:.1f} %" in text


def test_a_picture_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "e.png"
    evaluation_png(noisy(11), path, title="a PSF", study=offsets())
    picture = imread(path)
    assert picture.shape[:2] == (1570, 1600)
    for band in np.array_split(picture[:, :, :3], 4):
        assert band.std() > 0.1


def test_a_picture_of_one_pointing_is_drawn(tmp_path: Path) -> None:
    transit = noise_free(sky())
    alone = dataclasses.replace(transit, frames=transit.frames[4:6])
    evaluation_png(evaluate(alone, lambda _: kernel_with()), tmp_path / "e.png", title="two images")
    assert imread(tmp_path / "e.png").shape[:2] == (1200, 1600)


# --- dark offsets -----------------------------------------------------------------------------------------


def test_an_offset_is_a_readout_s() -> None:
    transit = observed(sky()).transit
    for before, after in zip(transit.frames, with_offset(transit, -3.0).frames, strict=True):
        np.testing.assert_allclose(
            after.pixels, before.pixels - 3.0 / before.exposure_s, rtol=1e-5, atol=1e-4
        )


def test_light_in_the_disc_that_is_none_is_taken_for_scatter() -> None:
    study = offsets()
    low, high = study.offsets
    assert (low.offset_dn, high.offset_dn) == (-5.0, 5.0)
    assert (high.curve_change_points > 0).all() and (low.curve_change_points < 0).all()
    assert (high.total_curve_change_points > 0).all()
    assert high.values["total"] > study.nominal["total"] > low.values["total"]
    assert study.radii_px[0] == 1 and study.radii_px[-1] == SIZE_PX - 1
    assert study.curve_radii_px[0] == 0.5
    # Outside the central pixel the curve is the total.
    for offset in study.offsets:
        change = offset.values["total"] - study.nominal["total"]
        assert offset.curve_change_points[0] == pytest.approx(100 * change, rel=1e-6)
    changes = [np.abs(o.weight_change_pct).max() for o in study.offsets]
    assert study.largest_weight_change_pct == max(changes) > 2
    assert 0.5 < study.largest_curve_change_points < 4


def test_weights_change_as_the_formula_says() -> None:
    study = offsets()
    nominal, other = ({**v} for v in (study.nominal, study.offsets[1].values))
    kernels = [SOFTENED_POWER_LAW.kernel(SOFTENED_POWER_LAW.coordinates(v), 512) for v in (other, nominal)]
    at = np.flatnonzero(study.radii_px == 20)[0]
    ratio = kernels[0][256, 276] / kernels[1][256, 276]
    assert study.offsets[1].weight_change_pct[at] == pytest.approx(100 * (ratio - 1), abs=0.02)


def test_no_offset_changes_nothing() -> None:
    study = dark_offset_study(observed(sky()).transit, (0.0,), nominal=solved().inversion)
    assert study.largest_curve_change_points < 0.05
    assert study.largest_weight_change_pct < 0.5


# --- clean transits of the usual size ---------------------------------------------------------------------


@pytest.mark.slow
def test_held_out_discs_of_clean_transits_are_met() -> None:
    """Against the simulator's discs without noise: mean within 1 %, rms within 2 %, at every pointing.

    Noise in the images that are fitted moves the mean of a limb pointing by 0.6 to 0.7 %, one standard error, so
    that a single transit's may be just beyond 1 %: three together may not.
    """
    off: dict[int, list[float]] = {1: [], 2: [], 3: []}
    for seed in (0, 1, 2):
        made = simulate(default_plan(30, 512), drawn_truth(seed), diffraction(1024), seed)
        start = invert(made.transit).inversion.coordinates
        found = evaluate(made.transit, fold_kernels(made.transit, start=start))
        print("\n".join(["", f"seed {seed}", *lines(found)]))
        for fov in off:
            planes = made.noise_free
            here = [f.residual_against_pct(planes[f.index]) for f in found.frames if f.fov == fov]
            print(f"pointing {fov}, discs without noise: mean {np.mean(here):+.2f} %, rms {rms(here):.2f} %")
            assert abs(np.mean(here)) < 1.5 and rms(here) < 2
            off[fov] += here
        maps = found.superposed
        assert maps.mape_mean_pct == pytest.approx(maps.mape_noise_mean_pct, rel=0.05)
        assert maps.mpe_rms_pct == pytest.approx(maps.mpe_noise_rms_pct, rel=0.15)
    for fov, values in off.items():
        print(f"pointing {fov} of three transits: mean {np.mean(values):+.2f} %, rms {rms(values):.2f} %")
        assert abs(np.mean(values)) < 1 and rms(values) < 2


@pytest.mark.slow
@pytest.mark.parametrize("brightness", [1.0, 3.0])
def test_dark_offsets_of_a_transit_of_the_usual_size(brightness: float) -> None:
    made = simulate(default_plan(30, 512, brightness=brightness), drawn_truth(0), diffraction(1024), 0)
    faintest = min(
        made.noise_free[n][dark_pixels(f, FoundPlace(made.truth.places[n], 0, 0, 1, 4, 3, True))].mean()
        * f.exposure_s
        for n, f in enumerate(made.transit.frames)
    )
    study = dark_offset_study(made.transit)
    print(f"\nbrightness {brightness:g}: faintest disc {faintest:.0f} DN")
    for o in study.offsets:
        print(
            f"{o.offset_dn:+g} DN: weights {np.abs(o.weight_change_pct).max():.1f} % at most, "
            f"diffuse light beyond {np.abs(o.curve_change_points).max():.2f} points at most, "
            f"total {np.abs(o.total_curve_change_points).max():.2f}"
        )
    assert study.largest_weight_change_pct < 60 / brightness
    assert study.largest_curve_change_points < 5 / brightness
