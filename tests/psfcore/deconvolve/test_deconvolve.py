from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.deconvolve.methods.richardson_lucy import richardson_lucy
from psfcore.errors import DataError
from psfcore.fits.images import read_image
from psfcore.image import MaskBit
from psfcore.psf import Psf, crop_centred
from psfcore.simulate.observe import observe
from psfcore.simulate.scene import solar_scene
from tests.psfcore.conftest import LIMITS, delta, gaussian, make_image, make_psf


def plain_richardson_lucy(
    observed: NDArray[np.float64], weight: NDArray[np.float64], psf: Psf, steps: int
) -> NDArray[np.float64]:
    """Eq. (1) in float64, one line per step: the reference for the fast version."""
    convolver = Convolver(psf.kernel, observed.shape, dtype=np.float64)
    y = np.maximum(observed, 0)
    x = np.maximum(y, 2.0**-23 * y.max())
    agreed = (1 - weight) / convolver.adjoint(np.ones_like(x))
    for _ in range(steps):
        x = x * convolver.adjoint(weight * y / convolver.apply(x) + agreed)
    return np.asarray(x)


@pytest.fixture(scope="module")
def psf_256(hri_psf: Psf) -> Psf:
    return make_psf(crop_centred(hri_psf.kernel, (256, 256)))


@pytest.fixture(scope="module")
def scene() -> NDArray[np.float64]:
    return solar_scene((192, 160), 4)


def look(scene: NDArray[np.float64], psf: Psf, *, noisy: bool = True) -> NDArray[np.float64]:
    gain, read = (6.0, 2.0) if noisy else (0.0, 0.0)
    return observe(scene, psf, exposure_s=1.4, photon_gain_dn=gain, read_noise_dn=read, seed=1)


def test_a_delta_changes_nothing(scene: NDArray[np.float64]) -> None:
    result = richardson_lucy(make_image(scene), make_psf(delta(64)), steps=20)
    np.testing.assert_allclose(result.pixels, scene, rtol=0, atol=2e-6 * scene.max())


def test_single_precision_follows_the_plain_version(scene: NDArray[np.float64], psf_256: Psf) -> None:
    observed = look(scene, psf_256)
    fast = richardson_lucy(make_image(observed), psf_256, steps=20, threads=2).pixels
    plain = plain_richardson_lucy(observed, np.ones_like(observed), psf_256, 20)
    assert np.abs(fast - plain).max() < 2e-5 * plain.max()


def test_masked_pixels_follow_the_plain_version(scene: NDArray[np.float64], psf_256: Psf) -> None:
    observed = look(scene, psf_256)
    mask = np.zeros(observed.shape, np.uint8)
    mask[50:55, 60:70] = MaskBit.SATURATED
    fast = richardson_lucy(make_image(observed, mask), psf_256, steps=20).pixels
    plain = plain_richardson_lucy(observed, (mask == 0).astype(float), psf_256, 20)
    assert np.abs(fast - plain).max() < 2e-5 * plain.max()


def test_flux_is_kept(scene: NDArray[np.float64], psf_256: Psf) -> None:
    observed = look(scene, psf_256)
    result = richardson_lucy(make_image(observed), psf_256, steps=20)
    assert result.pixels.sum() == pytest.approx(np.maximum(observed, 0).sum(), rel=1e-5)
    assert result.flux_out == pytest.approx(result.flux_in, rel=1e-5)
    assert result.steps_done == 20
    assert "20 steps" in result.stopped_because


def test_the_estimate_is_closer_to_the_scene_than_the_image(scene: NDArray[np.float64], psf_256: Psf) -> None:
    observed = look(scene, psf_256)
    result = richardson_lucy(make_image(observed), psf_256, steps=20)
    inside = (slice(16, -16), slice(16, -16))
    before = np.sqrt(np.mean((observed - scene)[inside] ** 2))
    after = np.sqrt(np.mean((result.pixels - scene)[inside] ** 2))
    assert after < 0.5 * before


def test_without_noise_more_steps_reduce_the_error(scene: NDArray[np.float64], psf_256: Psf) -> None:
    observed = look(scene, psf_256, noisy=False)
    inside = (slice(16, -16), slice(16, -16))
    errors = [
        np.abs(richardson_lucy(make_image(observed), psf_256, steps=n).pixels - scene)[inside].mean()
        for n in (1, 5, 20, 60)
    ]
    assert errors == sorted(errors, reverse=True)


def test_nan_stays_in_place(scene: NDArray[np.float64], psf_256: Psf) -> None:
    observed = look(scene, psf_256)
    holed = observed.copy()
    holed[80:83, 70:72] = np.nan
    holed[10, 20] = np.inf
    result = richardson_lucy(make_image(holed), psf_256, steps=20)
    np.testing.assert_array_equal(np.isnan(result.pixels), ~np.isfinite(holed))
    whole = richardson_lucy(make_image(observed), psf_256, steps=20)
    far = np.ones(scene.shape, bool)
    far[70:93, 60:82] = far[:20, 10:30] = False
    assert np.abs(result.pixels - whole.pixels)[far].max() < 0.01 * whole.pixels.max()


def test_a_saturated_core_is_estimated_from_its_surroundings(psf_256: Psf) -> None:
    scene = np.full((128, 128), 100.0)
    scene[63:66, 63:66] = 40000.0
    observed = look(scene, psf_256, noisy=False)
    level = 15000.0
    mask = np.where(observed >= level, int(MaskBit.SATURATED), 0).astype(np.uint8)
    assert mask.any()
    clipped = make_image(np.minimum(observed, level), mask)
    # A masked core must not fade while the rest converges. In the end its diffracted light determines its size.
    early, late = (richardson_lucy(clipped, psf_256, steps=n).pixels[63:66, 63:66].sum() for n in (5, 300))
    assert early > 0.95 * 9 * level
    assert late == pytest.approx(9 * 40000.0, rel=0.1)


def test_negative_pixels_count_as_dark_and_are_counted(psf_256: Psf) -> None:
    pixels = np.full((64, 64), 10.0)
    pixels[5, 5:9] = -3.0
    result = richardson_lucy(make_image(pixels), psf_256, steps=5)
    assert result.negative_pixels == 4
    assert (result.pixels >= 0).all()
    assert result.flux_in == pytest.approx(10.0 * (64 * 64 - 4))


def test_progress_reports_steps_and_its_exceptions_pass_through() -> None:
    class Cancelled(Exception):
        pass

    told: list[tuple[int, int]] = []

    def progress(step: int, steps: int) -> None:
        told.append((step, steps))
        if step == 3:
            raise Cancelled

    with pytest.raises(Cancelled):
        richardson_lucy(
            make_image(np.ones((32, 32))), make_psf(gaussian(16, 2.0)), steps=9, progress=progress
        )
    assert told == [(1, 9), (2, 9), (3, 9)]


@pytest.mark.parametrize(
    ("pixels", "steps", "code"), [(np.ones((32, 32)), 0, "bad-steps"), (np.zeros((32, 32)), 5, "no-signal")]
)
def test_refusals(pixels: NDArray[np.float64], steps: int, code: str) -> None:
    with pytest.raises(DataError) as caught:
        richardson_lucy(make_image(pixels), make_psf(delta(16)), steps=steps)
    assert caught.value.code == code


@settings(max_examples=40, deadline=None)
@given(
    st.integers(16, 40),
    st.integers(16, 40),
    st.integers(1, 50),
    st.floats(0, 0.9),
    st.floats(1e-6, 1e9),
    st.integers(0, 2**32 - 1),
)
def test_any_shape_mask_and_scale_gives_finite_light(
    ny: int, nx: int, kernel_size: int, masked: float, scale: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    pixels = rng.normal(1.0, 1.0, (ny, nx)) * scale
    pixels[0, 0] = scale
    holes = rng.random((ny, nx)) < masked
    holes[0, 0] = False
    pixels[holes] = np.nan
    result = richardson_lucy(make_image(pixels), make_psf(gaussian(kernel_size, 1.5)), steps=4)
    np.testing.assert_array_equal(np.isnan(result.pixels), holes)
    assert (result.pixels[~holes] >= 0).all()
    assert np.isfinite(result.pixels[~holes]).all()
    if not holes.any():
        assert result.flux_out == pytest.approx(result.flux_in, rel=1e-4)


def test_on_a_real_image_bright_rises_and_dark_falls(real, hri_psf: Psf) -> None:  # type: ignore[no-untyped-def]
    """The paper: bright features rise by up to 40 %, dark regions fall by up to 85 %. The test uses means of 8 x 8 px,
    so that pixel noise does not count as structure."""
    image = read_image(real("eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits"), LIMITS)
    result = richardson_lucy(image, hri_psf, steps=20, threads=2)
    assert result.flux_out == pytest.approx(result.flux_in, rel=1e-5)
    before, after = (
        plane.reshape(256, 8, 256, 8).mean(axis=(1, 3)) for plane in (image.pixels, result.pixels)
    )
    change_pct = 100 * (after / before - 1)
    bright = change_pct[before > np.percentile(before, 99)]
    dark = change_pct[before < np.percentile(before, 20)]
    assert np.median(bright) > 10
    assert 25 < np.percentile(bright, 99) < 60
    assert np.median(dark) < -5
    assert -95 < np.percentile(dark, 0.1) < -40
