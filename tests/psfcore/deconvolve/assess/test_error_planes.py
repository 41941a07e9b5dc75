"""Error planes: their width by many images, the noise of the camera, and the uncertainty of the PSF."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.deconvolve.assess.error_planes import (
    ErrorPlanes,
    error_planes,
    expected_image,
    mean_of_root,
    sigma_points,
    spread_of_results,
)
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.work import Options, Work
from psfcore.errors import DataError
from psfcore.image import Image, MaskBit
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.simulate.scene import observe, solar_scene
from tests.psfcore.conftest import delta, make_image, make_psf
from tests.psfcore.deconvolve.scattering import richardson_lucy, scattering_psf

SIZE_PX, EDGE_PX = 112, 12
EXPOSURE_S = 1.4
NOISE = Noise(photon_gain_dn=6.0, read_noise_dn=2.0)
Plane = NDArray[np.float64]


@pytest.fixture(scope="module")
def psf() -> Psf:
    return scattering_psf()


@cache
def scene() -> Plane:
    """A part of a simulated scene."""
    return 1.4 * solar_scene((448, 448), 3)[56 : 56 + SIZE_PX, 56 : 56 + SIZE_PX]


def cut(light: float) -> Plane:
    """The same part at `light` times the usual brightness."""
    return light * scene()


def see(scene: Plane, psf: Psf, seed: int | None) -> Image:
    gain, read = (0.0, 0.0) if seed is None else (NOISE.photon_gain_dn, NOISE.read_noise_dn)
    pixels = observe(
        scene, psf, exposure_s=EXPOSURE_S, photon_gain_dn=gain, read_noise_dn=read, seed=seed or 0
    )
    return Image(pixels, np.zeros(pixels.shape, np.uint8), make_image(pixels).header, "DN/s", EXPOSURE_S)


def twenty_steps(psf: Psf) -> Callable[[Image], Plane]:
    return lambda image: richardson_lucy(image, psf, steps=20).pixels


def planes_of(image: Image, psf: Psf, run: Callable[[Image], Plane], **more: Any) -> ErrorPlanes:
    conditions = Conditions(noise=NOISE, threads=more.pop("threads", 1), progress=more.pop("progress", None))
    return error_planes(image, psf, run, conditions, **{"estimate": run(image), "draws": 8} | more)


def pulls(scene: Plane, psf: Psf, images: int, draws: int) -> tuple[Plane, Plane]:
    """(result - result without noise) / error, [image, y, x] away from edges; and the error."""
    run = twenty_steps(psf)
    truth = run(see(scene, psf, None))
    inner = np.s_[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX]
    found = []
    for seed in range(1, images + 1):
        image = see(scene, psf, seed)
        pixels = run(image)
        planes = planes_of(image, psf, run, estimate=pixels, draws=draws, seed=seed)
        found.append(((pixels - truth) / planes.error)[inner])
    return np.array(found), truth[inner]


@pytest.mark.parametrize(("light", "images"), [(0.5, 12), pytest.param(0.05, 40, marks=pytest.mark.slow)])
def test_pulls_have_width_one(psf: Psf, light: float, images: int) -> None:
    """At 50 to 650 photons per pixel, and at about a dozen."""
    z, truth = pulls(cut(light), psf, images, draws=8)
    faint, bright = np.percentile(truth, [10, 90])
    widths = {
        "all": z.std(),
        "faintest tenth": z[:, truth <= faint].std(),
        "brightest tenth": z[:, truth >= bright].std(),
        "robust": np.diff(np.percentile(z, [15.87, 84.13]))[0] / 2,
    }
    assert all(0.9 <= width <= 1.1 for width in widths.values()), widths
    assert abs(z.mean()) < 0.1


def test_a_delta_gives_back_the_noise_of_the_camera() -> None:
    psf = make_psf(delta(32))
    image = see(np.full((128, 128), 300.0), psf, 4)
    planes = planes_of(image, psf, lambda seen: seen.pixels, draws=12)
    expected = np.sqrt(6.0 * 300 * EXPOSURE_S + 4.0) / EXPOSURE_S
    assert planes.amplification == pytest.approx(1.0, abs=0.03)
    assert np.median(planes.error) == pytest.approx(expected, rel=0.03)
    # A Gaussian of 2 px averages 4 pi 2^2 = 50 pixels of white noise, each with K degrees of freedom.
    assert planes.degrees_of_freedom == pytest.approx(12 * 50, rel=0.2)


def test_the_same_seed_gives_the_same_plane_and_masked_pixels_have_none(psf: Psf) -> None:
    image = see(cut(0.5), psf, 1)
    pixels, mask = image.pixels.copy(), image.mask.copy()
    pixels[40, 50], mask[40, 50] = np.nan, MaskBit.NONFINITE
    mask[60, 60] = MaskBit.SATURATED
    damaged = Image(pixels, mask, image.header, image.unit, image.exposure_s)
    run = twenty_steps(psf)
    first, second = (planes_of(damaged, psf, run, draws=3, threads=t) for t in (1, 2))
    np.testing.assert_array_equal(first.error, second.error)
    np.testing.assert_array_equal(np.isnan(first.error), mask != 0)
    whole = planes_of(image, psf, run, draws=3)
    far = np.hypot(*(np.indices(mask.shape) - np.array([50, 55])[:, None, None])) > 25
    assert np.median(first.error[far] / whole.error[far]) == pytest.approx(1.0, abs=0.01)


def test_the_model_is_as_bright_as_the_observation_near_the_edges(psf: Psf) -> None:
    image = see(cut(0.5), psf, None)
    model = expected_image(image, twenty_steps(psf)(image), psf)
    off = np.abs(model / image.pixels - 1)
    assert off[8:-8, 8:-8].max() < 0.05
    assert off[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX].max() < 0.02


def test_progress_is_reported_and_may_stop_the_work(psf: Psf) -> None:
    image = see(cut(0.5), psf, 1)
    told: list[tuple[int, int]] = []
    planes_of(image, psf, lambda seen: seen.pixels, draws=2, progress=lambda *at: told.append(at))
    assert told == [(1, 3), (2, 3), (3, 3)]

    def stop(done: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        planes_of(image, psf, lambda seen: seen.pixels, progress=stop)


def test_what_has_no_error_plane_is_refused() -> None:
    psf = make_psf(delta(16))
    pixels = np.ones((32, 32))
    with pytest.raises(DataError, match="bad-draws"):
        planes_of(make_image(pixels), psf, lambda seen: seen.pixels, draws=1)
    image = Image(pixels, np.zeros((32, 32), np.uint8), make_image(pixels).header, "DN/s", None)
    with pytest.raises(DataError, match="no-exposure"):
        planes_of(image, psf, lambda seen: seen.pixels)
    for pair in ((0.0, 0.0), (-1.0, 2.0), (np.nan, 1.0), (1.0, np.inf)):
        with pytest.raises(DataError, match="bad-noise"):
            Noise(*pair)
    for wrong in (np.array([[1.0, 0.5], [0.2, 1.0]]), np.diag([1.0, -1.0]), np.eye(3)):
        with pytest.raises(DataError, match="bad-covariance"):
            sigma_points(np.zeros(2), wrong)


def test_simulated_noise_has_the_variance_of_the_formula() -> None:
    expected = np.full((300, 300), 12 * 6 / 1.4)  # a dozen photons
    drawn = NOISE.observe(expected, 1.4, np.random.default_rng(2))
    assert drawn.mean() == pytest.approx(expected[0, 0], rel=0.01)
    assert drawn.var() == pytest.approx(NOISE.variance(expected, 1.4)[0, 0], rel=0.02)
    assert drawn.var() == pytest.approx((6 * 72 + 4) / 1.4**2, rel=0.02)


# --- the PSF's own uncertainty ---


def test_sigma_points_have_the_given_mean_and_covariance() -> None:
    root = np.array([[1.0, 0, 0], [0.4, 0.3, 0], [-2.0, 0.1, 0.7]])
    mean, covariance = np.array([6.15, 2.53, 0.41]), root @ root.T
    points = sigma_points(mean, covariance)
    assert points.shape == (6, 3)
    np.testing.assert_allclose(points.mean(0), mean, rtol=1e-12)
    np.testing.assert_allclose(np.cov(points.T, bias=True), covariance, rtol=1e-12)


def test_the_scatter_of_sigma_is_corrected_by_the_mean_of_its_root() -> None:
    drawn = np.random.default_rng(3).chisquare(3, 400_000)
    assert mean_of_root(3) == pytest.approx(np.sqrt(drawn / 3).mean(), rel=2e-3)
    assert mean_of_root(1e6) == pytest.approx(1.0, abs=1e-6)


def test_the_error_of_the_psf_is_the_spread_of_its_results(psf: Psf) -> None:
    """It has no value where the other error has none."""
    pixels = np.where(np.eye(32) > 0, np.nan, 100.0 + np.arange(32.0))
    psfs = [make_psf(total * delta(16)) for total in (0.9, 0.95, 1.0)]
    options = Options(method="linear", error_draws=2, noise=NOISE, parameters={"steps": 2})
    work = Work(make_image(pixels), psfs[-1], options)
    planes = work.errors(work.run(), possible_psfs=lambda: psfs)
    stack = [work.run(psf=one).pixels.astype(float) for one in psfs]
    np.testing.assert_allclose(planes.psf_error, np.std(stack, axis=0), rtol=1e-9)
    np.testing.assert_array_equal(np.isnan(planes.psf_error), np.isnan(pixels))
    assert work.errors(work.run()).psf_error is None
    with pytest.raises(DataError, match="bad-draws"):
        spread_of_results(psfs[:1], lambda psf: pixels)
