"""What a deconvolution changed in an image, and the signs of artefacts, compared with filters of SciPy."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import convolve, maximum_filter, median_filter, minimum_filter

from psfcore.deconvolve.assess.artefacts import (
    DETECTION_SIGMA,
    EXTREME_SIGMA,
    HOLE_SHARE,
    classes_of,
    find_artefacts,
    noise_levels,
    ringing_pct,
)
from psfcore.deconvolve.assess.changes import BLOCKS_PX, block_means, measure_changes
from psfcore.deconvolve.assess.compared import Compared, single
from psfcore.deconvolve.assess.pictures import changes_png
from psfcore.deconvolve.assess.ranks import Portions
from psfcore.errors import DataError
from psfcore.image import Image
from psfcore.noise import Noise
from psfcore.psf import Psf, crop_centred
from psfcore.simulate.scene import observe, solar_scene
from tests.psfcore.conftest import delta, make_image, make_psf
from tests.psfcore.deconvolve.scattering import richardson_lucy, scattering_psf

Plane = NDArray[np.float64]
Flags = NDArray[np.bool_]
SIZE_PX, EDGE_PX = 384, 24
HRI = "eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits"


@pytest.fixture(scope="module")
def psf() -> Psf:
    return scattering_psf(512)


@pytest.fixture(scope="module")
def seen(psf: Psf) -> Image:
    scene = solar_scene((SIZE_PX, SIZE_PX), 1)
    pixels = observe(scene, psf, exposure_s=1.4, photon_gain_dn=6.0, read_noise_dn=2.0, seed=1)
    image = make_image(pixels)
    return Image(pixels, image.mask, image.header, "DN/s", 1.4)


@pytest.fixture(scope="module")
def result(seen: Image, psf: Psf) -> Plane:
    """The image after twenty steps."""
    return richardson_lucy(seen, psf, steps=20, threads=2).pixels


# --- figures ---


def test_one_thread_gives_the_same_changes_without_a_second_thread(
    seen: Image, psf: Psf, result: Plane, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_two = measure_changes(seen, result, psf, edge_px=EDGE_PX, threads=2)
    with monkeypatch.context() as patched:
        patched.delattr(threading.Thread, "start")
        with_one = measure_changes(seen, result, psf, edge_px=EDGE_PX, threads=1)
    assert with_one.as_json() == with_two.as_json()


def test_a_result_equal_to_the_image_has_no_changes(seen: Image) -> None:
    report = measure_changes(seen, seen.pixels, make_psf(delta(32)))
    assert report.flux_change_pct == 0
    assert set(report.change_pct.values()) == {0.0}
    assert all(row.sum_pct == row.median_pct == row.up_to_pct == 0 for row in report.structures)
    assert all(row.dynamic_before == row.dynamic_after for row in report.ranges)
    assert report.artefacts.score == 0 and not report.artefacts.suspected.any()


def test_known_changes_of_known_structures_are_found() -> None:
    """A quarter of the pixels is bright and rises by 40 %, a quarter is dark and falls by 85 %, in blocks of 32."""
    before = np.full((256, 256), 100.0)
    before[:64], before[-64:] = 1000.0, 10.0
    after = before * np.where(before == 1000, 1.4, np.where(before == 10, 0.15, 1.0))
    report = measure_changes(make_image(before), after, make_psf(delta(32)))
    assert {row.block_px for row in report.structures} == set(BLOCKS_PX)
    for row in report.structures:
        wanted = 40.0 if row.kind == "bright" else -85.0
        assert (row.sum_pct, row.median_pct, row.up_to_pct) == pytest.approx((wanted,) * 3)
        assert row.before == (1000.0 if row.kind == "bright" else 10.0)
    for row in report.ranges:
        assert (row.dynamic_before, row.dynamic_after) == pytest.approx((100.0, 1400 / 1.5))
        assert row.contrast_after > row.contrast_before


def test_block_means_by_brute_force_leave_out_blocks_with_a_bad_pixel() -> None:
    plane = np.arange(7 * 9, dtype=float).reshape(7, 9)
    counted = np.ones(plane.shape, bool)
    counted[4, 5] = False
    expected = [plane[y : y + 3, x : x + 3].mean() for y in (0, 3) for x in (0, 3, 6) if (y, x) != (3, 3)]
    np.testing.assert_allclose(block_means(plane, counted, 3), expected)


def test_a_dark_sky_at_zero_has_no_dynamic_range(seen: Image, psf: Psf) -> None:
    pixels = seen.pixels - np.percentile(seen.pixels, 10)
    report = measure_changes(make_image(pixels), pixels, psf)
    assert report.ranges[0].dynamic_before is None
    assert report.not_positive_before == report.not_positive_after > 0
    json.dumps(report.as_json(), allow_nan=False)


def test_masked_pixels_are_left_out(seen: Image, psf: Psf, result: Plane) -> None:
    pixels = seen.pixels.copy()
    pixels[100:110, 100:110] = np.nan
    report = measure_changes(
        make_image(pixels), np.where(np.isnan(pixels), np.nan, result), psf, edge_px=EDGE_PX
    )
    assert report.pixels == (SIZE_PX - 2 * EDGE_PX) ** 2 - 100
    assert not report.artefacts.suspected[100:110, 100:110].any()
    json.dumps(report.as_json(), allow_nan=False)


def test_images_that_cannot_be_compared_are_refused(seen: Image, psf: Psf) -> None:
    with pytest.raises(DataError, match="field-shape"):
        measure_changes(seen, seen.pixels[:-1], psf)
    with pytest.raises(DataError, match="no-signal"):
        measure_changes(seen, seen.pixels, psf, edge_px=SIZE_PX)


# --- artefacts ---


def test_worse_deconvolutions_rank_above_better_ones(seen: Image, psf: Psf, result: Plane) -> None:
    """Twenty steps with the true PSF are clean. Worse are noise fitted by 200 steps; a core twice too wide, which
    causes rings; and an inverse without regularisation."""
    for noise in (None, Noise(6.0, 2.0)):
        clean = measure_changes(seen, result, psf, noise=noise, edge_px=EDGE_PX)
        assert clean.artefacts.score < 0.2
    worse = richardson_lucy(seen, psf, steps=200, threads=2).pixels
    assert measure_changes(seen, worse, psf, edge_px=EDGE_PX).artefacts.score > 1
    wide = scattering_psf(512, 1.6)
    worse = richardson_lucy(seen, wide, steps=100, threads=2).pixels
    rings = measure_changes(seen, worse, wide, edge_px=EDGE_PX).artefacts
    assert rings.score > 1 and (rings.signs["ringing_pct"] or 0) > 0.5
    transfer = np.fft.rfft2(np.fft.ifftshift(crop_centred(psf.kernel, (SIZE_PX, SIZE_PX))))
    bound = np.where(np.abs(transfer) > 0.02, transfer, 0.02)
    inverse = np.fft.irfft2(np.fft.rfft2(seen.pixels) / bound, s=seen.pixels.shape)
    assert measure_changes(seen, inverse, psf, edge_px=EDGE_PX).artefacts.score > 100


def test_the_suspected_pixels_are_those_of_a_slow_search() -> None:
    """Holes, overshoots and new extremes by their definitions, with the filters of SciPy, on more than a block of
    rows."""
    rng = np.random.default_rng(1)
    before = rng.gamma(4.0, 100.0, (150, 70)).astype(np.float32)
    after = (before * rng.gamma(3.0, 0.4, before.shape)).astype(np.float32)
    after[::17, ::13], after[4::9, 4::9], after[6::19, 2::17] = 0, 20_000, -5_000
    after[5::9, 4::9], after[7::19, 2::17] = 15_000, -4_000  # beside the extremes, and none themselves
    after[4::9, 6::9], after[6::19, 4::17] = 18_000, -4_500  # two pixels from them: extremes themselves
    counted, sigma, peak_weight = rng.random(before.shape) > 0.1, 20.0, 0.4
    holes = (after < HOLE_SHARE * before) & (before > DETECTION_SIGMA * sigma)
    overshoots = after > (before + DETECTION_SIGMA * sigma) / peak_weight
    extremes = np.zeros(before.shape, bool)
    pair = Compared(single(before), single(after), counted, threads=2)
    noise_after = noise_levels(pair, pair.after, classes_of(Portions.of(before[counted]))).at(before)
    for sign, largest in ((1, maximum_filter), (-1, minimum_filter)):
        away = [sign * (plane - median_filter(plane, 5, mode="reflect")) for plane in (after, before)]
        peaks = after == largest(after, 3, mode="nearest")
        extremes |= peaks & (away[0] > EXTREME_SIGMA * noise_after) & (away[1] < sigma)
    found = find_artefacts(pair, peak_weight, sigma=lambda places: np.full(len(places[0]), sigma))
    for name, flags in (("holes", holes), ("overshoots", overshoots), ("new_extremes", extremes)):
        share = np.count_nonzero(flags & counted) / np.count_nonzero(counted)
        assert share > 0 and found.signs[f"{name}_ppm"] == pytest.approx(1e6 * share), name
    np.testing.assert_array_equal(found.suspected, (holes | overshoots | extremes) & counted)


def ringing(before: Plane, after: Plane, counted: Flags | None = None) -> tuple[float | None, int]:
    """The ringing of an image, in percent, and the number of its sources."""
    counted = np.ones(before.shape, bool) if counted is None else counted
    return ringing_pct(Compared(single(before), single(after), counted))


def test_rings_are_measured_in_percent_of_the_peak() -> None:
    before, after = np.full((200, 200), 10.0), np.full((200, 200), 10.0)
    y, x = np.mgrid[:200, :200]
    for centre in (40, 100, 160):
        r = np.hypot(y - centre, x - centre)
        before += 1000 * np.exp(-(r**2) / 8)
        after += 1500 * np.exp(-(r**2) / 2) + 150 * np.exp(-((r - 6) ** 2))
    level, sources = ringing(before, after)
    assert sources == 3
    assert level == pytest.approx(10.0, abs=1.5)
    assert ringing(before, before) == (0.0, 3)
    for distance_px, count in ((9, 3), (8, 2)):  # a source must have 8 px without a bad one
        counted = np.ones(before.shape, bool)
        counted[100 - distance_px, 100] = False
        assert ringing(before, after, counted)[1] == count
    assert ringing(np.ones((64, 64)), np.ones((64, 64)))[0] is None


def test_noise_is_estimated_from_the_pixels() -> None:
    expected = np.full((256, 256), 300.0) + np.linspace(0, 600, 256)
    noise = Noise(6.0, 2.0)
    pixels = noise.observe(expected, 1.4, np.random.default_rng(1))
    classes, plane = classes_of(Portions.of(expected.ravel())), single(pixels)
    levels = noise_levels(Compared(plane, plane, np.ones(pixels.shape, bool)), plane, classes)
    ratio = levels.at(expected) / np.sqrt(noise.variance(expected, 1.4))
    assert np.abs(ratio - 1).max() < 0.1
    weights = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])
    second = np.abs(convolve(pixels, weights, mode="reflect")).ravel() / 6
    slow = [1.4826 * np.median(second[classes.numbers == number]) for number in range(classes.centres.size)]
    np.testing.assert_allclose(levels.levels, slow, rtol=1e-6)  # in single precision


# --- pictures and the real image ---


def test_pages_are_drawn(seen: Image, psf: Psf, result: Plane, tmp_path: Path) -> None:
    """Also of an image with a bad pixel, and of one without light, which gives the same file twice."""
    result = result.copy()
    result[5, 5] = np.nan
    report = measure_changes(seen, result, psf, edge_px=EDGE_PX)
    changes_png(seen.pixels, result, report, tmp_path / "page.png", title="Simulated", unit="DN/s")
    content = (tmp_path / "page.png").read_bytes()
    assert content.startswith(b"\x89PNG") and len(content) > 100_000
    dark = np.full((64, 64), -1.0)
    dark[3, 3] = 200.0
    report = measure_changes(make_image(dark + 1), dark + 1, make_psf(delta(16)))
    for name in ("a.png", "b.png"):
        changes_png(dark, dark, report, tmp_path / name, title="Dark", unit="DN/s")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
