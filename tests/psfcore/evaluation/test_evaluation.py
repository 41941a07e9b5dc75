"""The evaluation of a PSF: a correct PSF leaves only noise, in discs and superposed maps, and a wrong one more."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.evaluation.evaluation import Superposed, evaluate, half_width_px, superposed, superposed_maps
from psfcore.evaluation.report import report
from psfcore.evaluation.summary_lines import summary_lines
from psfcore.noise import Noise
from psfcore.scatter.reconstruction import LEAST_DARK_PIXELS
from psfcore.scatter.total_psf import Optics, noise_covariance, pick, put
from psfcore.transit.occulter import disc_distance, fully_dark
from psfcore.transit.transit import Frame, Place
from tests.psfcore.evaluation.small_evaluations import (
    SEEDS,
    exact_scene,
    judged,
    kernel_with,
    noisy,
    residual_against_pct,
    rms,
)
from tests.psfcore.small_transits import (
    IMAGES,
    SCATTER,
    SIZE_PX,
    noise_free,
    observed,
    sky,
    solved,
    with_pixels,
)


def test_a_wrong_psf_leaves_the_residual_of_an_exact_inverse() -> None:
    found = judged()
    assert len(found.frames) == IMAGES and not found.left_out
    assert max(abs(f.residual_pct) for f in found.frames) < 0.01
    assert max(float(np.abs(f.pe_pct).max()) for f in found.frames) < 0.1
    assert found.superposed.mape_mean_pct < 0.01
    for n, frame in enumerate(found.frames):
        assert residual_against_pct(frame, sky().expected(n)) == pytest.approx(frame.residual_pct, abs=1e-4)
    # Compared with a double-precision inverse: invert, set the disc to zero, convolve.
    for total, n in ((1.1 * SCATTER.total, 0), (0.0, 5)):
        found = judged(total)
        through = Convolver(kernel_with(total), (SIZE_PX, SIZE_PX), dtype=np.float64)
        frame, image = found.frames[n], found.transit.frames[n].pixels.astype(np.float64)
        lit = exact_scene(through, image)
        lit[frame.dark] = 0.0
        expected, seen = through.apply(lit)[frame.dark].mean(), image[frame.dark].mean()
        assert frame.residual_pct == pytest.approx(100 * (expected - seen) / seen, abs=0.02)


def test_it_agrees_with_the_residuals_of_the_inversion() -> None:
    solution = solved()
    kernel = solution.total.kernel(solution.inversion.coordinates)
    found = evaluate(solution.transit, lambda _: kernel)
    for here, there in zip(found.frames, solution.inversion.frames, strict=True):
        assert here.residual_pct == pytest.approx(there.residual_pct, abs=0.03)
        assert here.noise_dn_s == pytest.approx(there.noise, rel=1e-3)
        assert here.observed_dn_s == pytest.approx(there.observed, rel=1e-4)


def test_residuals_scatter_by_their_stated_noise() -> None:
    """For 108 discs, the width of the pulls is known to 7 %."""
    frames = [frame for seed in SEEDS for frame in noisy(seed).frames]
    assert 0.83 < rms([f.residual_pct / f.noise_pct for f in frames]) < 1.17
    assert 0.83 < rms([f.error_dn_s / f.noise_dn_s for f in frames]) < 1.17
    centre = [f.centre_pct / f.centre_noise_pct for f in frames]
    assert 0.83 < rms(centre) < 1.17
    assert abs(np.mean(centre)) < 0.35 and abs(np.mean([f.residual_pct / f.noise_pct for f in frames])) < 0.35
    assert all(3 * f.noise_pct < f.centre_noise_pct < 8 * f.noise_pct for f in frames)
    # Noise of the disc's own pixels makes most of a residual: relative to images without noise it is small.
    against = [residual_against_pct(f, sky().expected(f.index)) for f in noisy(11).frames]
    assert rms(against) < 0.6 < rms([f.noise_pct for f in noisy(11).frames])


def test_noise_is_propagated_as_pixel_by_pixel() -> None:
    """Each pixel of a small field is raised in turn; its effect on the mean and on an asymmetric template is summed."""
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


def test_each_image_is_evaluated_with_its_own_psf_alone() -> None:
    """The result for a frame does not depend on the PSF of other frames, not even of its neighbours."""
    kernels = [kernel_with(0.3) if n % 2 else kernel_with() for n in range(IMAGES)]
    mixed = evaluate(observed(sky(), 11).transit, lambda n: kernels[n])
    alone = noisy(11)
    for n in range(0, IMAGES, 2):
        assert mixed.frames[n].found == alone.frames[n].found
        np.testing.assert_array_equal(mixed.frames[n].simulated, alone.frames[n].simulated)
    assert [f.index for f in mixed.frames] == list(range(IMAGES))
    assert all(mixed.frames[n].residual_pct < -5 for n in range(1, IMAGES, 2))


def test_images_that_cannot_be_evaluated_are_left_out_with_a_reason() -> None:
    transit = noise_free(sky())
    pixels = [f.pixels for f in transit.frames]
    pixels[6] = sky().seen_scenes[2].astype(np.float32)
    place = transit.frames[0].place
    within = disc_distance(transit.shape, place) < place.radius_px
    pixels[0] = np.where(within, np.float32(-2.0), pixels[0])
    filled = np.ones((SIZE_PX, SIZE_PX), bool)
    frames = list(with_pixels(transit, pixels).frames)
    frames[2] = dataclasses.replace(frames[2], filled=filled)
    found = evaluate(dataclasses.replace(transit, frames=tuple(frames)), lambda _: kernel_with())
    assert set(found.left_out) == {"000.fits", "002.fits", "006.fits"}
    assert "found no occulter there" in found.left_out["006.fits"] and "-2 DN/s" in found.left_out["000.fits"]
    assert f"at least {LEAST_DARK_PIXELS} fully dark pixels; got 0" in found.left_out["002.fits"]
    assert [f.index for f in found.frames] == [1, 3, 4, 5, 7, 8, 9, 10, 11]
    # A frame without occulter does not affect its neighbours in time.
    assert max(abs(f.residual_pct) for f in found.frames) < 0.3
    assert any("002.fits" in line for line in summary_lines(report(found)))
    # A transit without any occulter is refused.
    nowhere = tuple(dataclasses.replace(f, filled=filled) for f in transit.frames[:4])
    with pytest.raises(DataError, match=r"no-occulter.*000\.fits: expected at least"):
        evaluate(dataclasses.replace(transit, frames=nowhere), lambda _: kernel_with())


def test_slices_run_through_the_middle_of_discs() -> None:
    found = judged(1.1 * SCATTER.total)
    kept = [f for f in found.frames if f.along_x is not None]
    assert [sum(f.pointing == fov for f in kept) for fov in (1, 2, 3)] == [3, 3, 3]
    frame = kept[4]
    assert frame.along_x is not None and frame.along_y is not None
    y, x = round(frame.found.place.y_px), round(frame.found.place.x_px)
    pixels = found.transit.frames[frame.index].pixels
    np.testing.assert_array_equal(frame.along_x.observed_dn_s, pixels[y, x - 20 : x + 21])
    np.testing.assert_array_equal(frame.along_y.observed_dn_s, pixels[y - 20 : y + 21, x])
    assert frame.along_x.offset_px[20] == pytest.approx(x - frame.found.place.x_px)
    assert {int(along.dark.sum()) for along in (frame.along_x, frame.along_y)} <= {20, 21}
    row = frame.dark[0] == y
    np.testing.assert_allclose(frame.along_x.simulated_dn_s[frame.along_x.dark], frame.simulated[row])
    assert (frame.along_x.simulated_dn_s > frame.along_x.observed_dn_s)[frame.along_x.dark].all()
    # At the edge of the field, slices end where the field ends.
    frame = judged().frames[0]
    assert frame.along_x is not None
    first = round(frame.found.place.x_px) - 20
    assert first < 0
    assert frame.along_x.offset_px.size == 41 + first
    assert frame.along_x.offset_px[0] == pytest.approx(-frame.found.place.x_px)


# --- superposed maps ---------------------------------------------------------------------------------------


def test_maps_for_the_true_psf_are_those_of_noise_alone() -> None:
    maps = [noisy(seed).superposed for seed in SEEDS]
    ratio = [m.mape_mean_pct / m.mape_noise_mean_pct for m in maps]
    assert np.abs(np.subtract(ratio, 1)).max() < 0.1
    assert np.mean(ratio) == pytest.approx(1, abs=0.03)
    assert np.mean([m.mpe_rms_pct / m.mpe_noise_rms_pct for m in maps]) == pytest.approx(1, abs=0.08)
    # By hand: E|N(0, s)| = s sqrt(2 / pi), s of a pixel's own photons and readout.
    noise = sky().plan.noise
    by_hand = [
        100 * np.sqrt(2 / np.pi * noise.variance(f.simulated, t.exposure_s)).mean() / f.observed_dn_s
        for f, t in zip(noisy(11).frames, noisy(11).transit.frames, strict=True)
    ]
    assert maps[0].mape_noise_mean_pct == pytest.approx(np.mean(by_hand), rel=0.08)


def test_errors_are_mapped_to_the_nearest_pixel_and_averaged_where_discs_are_dark() -> None:
    rows, columns = np.array([20, 21, 20]), np.array([30, 30, 33])
    discs = [
        (Place(30.4, 19.6, 3.0), 3, [1.0, 2.0, 3.0], [4.0, -4.0, 0.0]),
        (Place(29.6, 20.4, 3.0), 2, [-3.0, 4.0], [-2.0, 2.0]),
        *[(Place(30.0, 20.0, 3.0), 1, [0.0], [0.0])] * 3,
    ]

    def laid(count: int) -> Superposed:
        """The maps of the first discs."""
        frames = [
            dataclasses.replace(
                noisy(11).frames[0],
                found=dataclasses.replace(noisy(11).frames[0].found, place=place),
                dark=(rows[:pixels], columns[:pixels]),
            )
            for place, pixels, _, _ in discs[:count]
        ]
        pe, noise = ([np.array(disc[k]) for disc in discs[:count]] for k in (2, 3))
        half_px = half_width_px(3.0)
        return superposed(superposed_maps(frames, pe, half_px), superposed_maps(frames, noise, half_px)[None])

    maps = laid(2)
    assert maps.images == 2 and maps.half_px == 4 and maps.count.shape == (9, 9)
    assert maps.count[4, 4] == 2 and maps.count[4, 7] == 1 and maps.count.sum() == 5
    assert (maps.mpe_pct[4, 4], maps.mape_pct[4, 4]) == (-1.0, 2.0)
    assert (maps.mpe_pct[5, 4], maps.mape_pct[5, 4]) == (3.0, 3.0)
    assert (maps.noise_mpe_pct[4, 4], maps.noise_mape_pct[4, 4]) == (1.0, 3.0)
    assert np.isnan(maps.mpe_pct).sum() == 81 - 3
    assert (maps.mape_mean_pct, maps.mape_largest_pct) == (8 / 3, 3.0)
    assert maps.mpe_rms_pct == pytest.approx(np.sqrt(19 / 3))
    # The map omits a position that fewer than half of the images show.
    assert np.isfinite(laid(5).mpe_pct).sum() == 1
