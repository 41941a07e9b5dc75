"""The stray light of a flare along an arm distinguishes the total PSF from diffraction alone."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from astropy.io import fits

from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.flare import arm_profile as arm_profile_module
from psfcore.flare.arm_profile import (
    BOX_PX,
    FlareComparison,
    arm_profile,
    compare_on_flare,
    fit_flare,
    flare_centre,
)
from psfcore.flare.judge import judge_on_flare
from psfcore.flare.plots import flare_png
from psfcore.image import Image
from psfcore.psf import Psf
from tests.psfcore.conftest import make_psf
from tests.simulated_flare import (
    CENTRE,
    NOISE,
    SATURATION,
    SIZE,
    Plane,
    flare_light,
    flare_psf,
    observed,
    pair,
    quiet_sun,
)

EVERYWHERE = np.ones((SIZE, SIZE), dtype=bool)


def compared(seed: int, arm_deg: float = 0.0, c: float = 2.53) -> FlareComparison:
    flaring, before = pair(seed)
    variance = NOISE.variance(flaring, 1.0) + NOISE.variance(before, 1.0)
    return compare_on_flare(
        flaring - before, flaring < SATURATION, flare_psf(c), CENTRE, arm_deg, variance=variance
    )


def test_the_total_psf_alone_fits_within_noise() -> None:
    """Along both arms."""
    found = [compared(seed, 90.0 * (seed % 2)) for seed in range(6)]
    # About ten of the seventy degrees of freedom go into the box.
    assert 0.6 < np.mean([one.total.chi2_per_distance for one in found]) < 1.15
    assert 0.8 < np.mean([one.total.reduced_chi2 for one in found]) < 1.25
    # Over 90 flares this share is 0.965 +- 0.024; one in thirty is below 0.9. Another processor may round a
    # logarithm differently, which changes the Poisson noise and hence these six flares.
    assert np.mean([one.explained for one in found]) > 0.92
    for one in found:
        assert one.diffraction is not None and one.chi2_factor is not None and one.rms_factor is not None
        assert one.total.rms_pct < 5 and one.rms_factor > 1.7 and one.chi2_factor > 7
        assert (one.diffraction.chi2_per_distance or 0) > 7
        assert one.total.matched == pytest.approx(1, abs=1e-4) == one.diffraction.matched
        assert one.total.matched_noise_pct is not None and 0.2 < one.total.matched_noise_pct < 3
        assert one.total.box.sum() == pytest.approx(flare_light(0).sum(), rel=0.1)
        assert (one.total.box >= 0).all()
        assert one.explained > 0.8
    # The exponent is wrong by 0.4; the scattered light is the same in total.
    right, wrong = (
        np.mean([compared(s, c=c).total.chi2_per_distance for s in range(3)]) for c in (2.53, 2.1)
    )
    assert wrong > 3 * right


@pytest.mark.slow
def test_diffraction_alone_is_ten_times_worse_for_hri_euv(hri_psf: Psf) -> None:
    """With the PSF of the instrument itself, whose orders fall off faster than its scatter."""
    through = Convolver(hri_psf.kernel, (SIZE, SIZE), dtype=np.float64)
    chi2, factors = [], []
    for seed in range(6):
        flaring = NOISE.observe(
            through.apply(quiet_sun() + flare_light(seed)), 1.4, np.random.default_rng(seed)
        )
        before = NOISE.observe(through.apply(quiet_sun()), 1.4, np.random.default_rng(100 + seed))
        variance = NOISE.variance(flaring, 1.4) + NOISE.variance(before, 1.4)
        found = compare_on_flare(
            flaring - before, flaring < SATURATION, hri_psf, CENTRE, 0.0, variance=variance
        )
        chi2.append(found.total.chi2_per_distance)
        factors.append((found.rms_factor, found.chi2_factor))
    assert 0.6 < np.mean(chi2) < 1.2 and max(chi2) < 1.6, chi2
    assert np.median([rms for rms, _ in factors]) > 8, factors
    assert np.median([chi2 for _, chi2 in factors]) > 100, factors


def test_without_noise_the_light_of_the_flare_is_recovered() -> None:
    light = observed(flare_light(3), None)
    profile = arm_profile(light, EVERYWHERE, CENTRE, 0.0)
    fit = fit_flare(profile, flare_psf().kernel)
    assert fit.rms_pct < 0.05 and fit.chi2_per_distance is None
    assert fit.simulated == pytest.approx(profile.observed, rel=5e-3)
    truth = flare_light(3)[CENTRE[1] - 3 : CENTRE[1] + 4, CENTRE[0] - 3 : CENTRE[0] + 4]
    assert fit.box.sum() == pytest.approx(truth.sum(), rel=0.01)
    # The strip resolves the light along the arm only, not across it.
    assert fit.box.sum(axis=0) / truth.sum() == pytest.approx(truth.sum(axis=0) / truth.sum(), abs=0.1)


def test_a_box_of_one_pixel_is_the_kernel_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eq. (1) by convolution, on a strip at an odd angle."""
    one = np.zeros((SIZE, SIZE))
    one[CENTRE[1], CENTRE[0]] = 1e6
    light = observed(one, None)
    profile = arm_profile(light, EVERYWHERE, CENTRE, 33.0, distances_px=(8, 75))
    monkeypatch.setattr(arm_profile_module, "BOX_PX", 1)
    fit = fit_flare(profile, flare_psf().kernel)
    assert fit.box == pytest.approx(np.array([[1e6]]), rel=1e-6)
    assert fit.simulated == pytest.approx(profile.observed, rel=1e-6)


def test_the_strip_is_as_wide_as_the_box_and_skips_unusable_distances() -> None:
    usable = EVERYWHERE.copy()
    usable[:, CENTRE[0] + 20] = False
    usable[CENTRE[1], CENTRE[0] + 30] = False
    index = np.arange(SIZE, dtype=float) * np.ones((SIZE, 1))
    for angle in (0.0, 0.003, -0.003):  # a small tilt of the arm must not make the strip asymmetric
        profile = arm_profile(index, usable, CENTRE, angle)
        assert 20 not in profile.distance_px and 30 in profile.distance_px and 21 in profile.distance_px
        assert np.bincount(profile.member)[:5].tolist() == [BOX_PX] * 5
        assert profile.observed == pytest.approx(CENTRE[0] + profile.distance_px)


def test_the_centre_is_the_patch_that_became_unusable() -> None:
    flaring, before = pair(0)
    flaring[10:40, 10:40] = before[10:40, 10:40] = SATURATION
    lost = flaring < SATURATION, before < SATURATION
    assert flare_centre(flaring - before, *lost) == CENTRE
    spot = np.zeros((SIZE, SIZE))
    spot[50, 60] = 1.0
    assert flare_centre(spot, EVERYWHERE, EVERYWHERE) == (60, 50)
    with pytest.raises(DataError, match="flare-no-light"):
        flare_centre(0 * spot, EVERYWHERE, EVERYWHERE)


def test_changes_that_are_not_stray_light_lower_the_explained_share() -> None:
    flaring, before = pair(0)
    y, x = np.indices((SIZE, SIZE))
    elsewhere = 3e4 * np.exp(-((x - 60) ** 2 + (y - 60) ** 2) / 200)
    usable, plain = flaring < SATURATION, make_psf(flare_psf().kernel)
    alone = compare_on_flare(flaring - before, usable, plain, CENTRE, 0.0)
    beside = compare_on_flare(flaring - before + elsewhere, usable, flare_psf(), CENTRE, 0.0)
    assert alone.explained > 0.9 and beside.explained < 0.3
    # A PSF without components is compared without diffraction.
    assert alone.diffraction is None and alone.rms_factor is None and alone.chi2_factor is None


def test_flares_that_cannot_be_compared_are_refused() -> None:
    flaring, before = pair(0)
    light, usable = flaring - before, flaring < SATURATION
    cases = [
        ("flare-bad-centre", light, {"centre_xy": (SIZE, 3)}),
        ("flare-short-arm", light, {"centre_xy": (SIZE - 15, 90)}),
        ("flare-no-light", light, {"centre_xy": CENTRE, "distances_px": (10.0, 50.0)}),
        ("flare-no-light", -light, {"centre_xy": CENTRE}),
    ]
    for code, plane, where in cases:
        with pytest.raises(DataError, match=r"expected .*; got") as caught:
            compare_on_flare(plane, usable, flare_psf(), arm_deg=0.0, **where)  # type: ignore[arg-type]
        assert caught.value.code == code


def test_images_are_compared_in_the_unit_of_their_headers() -> None:
    planes = pair(0)
    for unit, exposure_s, divisor, label in (
        ("DN", 2.0, 2.0, "DN/s"),
        ("DN/s", 2.0, 1.0, "DN/s"),
        (None, 2.0, 2.0, "unit unknown, per s"),
        ("DN", None, 1.0, "DN, exposure unknown"),
        (None, None, 1.0, "unit unknown"),
    ):
        images = [image(plane, unit, exposure_s) for plane in planes]
        found = judge_on_flare(*images, flare_psf(), centre_xy=CENTRE, arm_deg=0.0)
        assert found.unit == label
        np.testing.assert_allclose(found.difference, (planes[0] - planes[1]) / divisor)
    flaring = image(planes[0], "DN", 2.0)
    for code, other in (
        ("flare-units", image(planes[1], "DN", None)),
        ("flare-shapes", image(planes[1][:, 1:], "DN", 2.0)),
    ):
        with pytest.raises(DataError, match=code):
            judge_on_flare(flaring, other, flare_psf(), centre_xy=CENTRE, arm_deg=0.0)


def image(pixels: Plane, unit: str | None, exposure_s: float | None) -> Image:
    return Image(pixels, np.zeros(pixels.shape, np.uint8), fits.Header(), unit, exposure_s)


def test_the_comparison_is_plotted(tmp_path: Path) -> None:
    flaring, before = pair(0)
    usable = flaring < SATURATION
    for noise in (None, NOISE.variance(flaring, 1.0)):
        found = compare_on_flare(flaring - before, usable, flare_psf(), CENTRE, 0.0, variance=noise)
        flare_png(flaring - before, usable, found, tmp_path / "flare.png", unit="DN")
        assert matplotlib.image.imread(tmp_path / "flare.png").std() > 0.05
