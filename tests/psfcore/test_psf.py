from __future__ import annotations

import itertools

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.image import Image
from psfcore.psf import crop_centred, crop_or_pad, cumulative_curve, encircled_energy, radial_profile
from psfcore.psf_sampling import check_compatible
from tests.psfcore.conftest import delta, gaussian, make_psf


def with_pixel(value: float) -> NDArray[np.float64]:
    kernel = delta(32)
    kernel[0, 0] = value
    return kernel


def test_a_wrong_psf_is_refused() -> None:
    for kernel, code, words in (
        (delta(32) * 3, "psf-sum", r"got 3\."),
        (delta(32) * 0.01, "psf-sum", "got 0.01"),
        (with_pixel(np.nan), "psf-nonfinite", "got 1"),
        (with_pixel(-1e-6), "psf-negative", "-1e-06"),
        (np.roll(delta(32), (-16, -16), (0, 1)), "psf-not-centred", "corner origin"),
        (np.roll(delta(32), 3, 0), "psf-not-centred", r"= \(16, 16\); got \(19, 16\)"),
        *((np.roll(gaussian(32, 1.5), s, (0, 1)), "psf-not-centred", "") for s in ((0, 1), (1, 0), (-1, -1))),
        (np.ones(9) / 9, "psf-not-2d", "two axes"),
    ):
        with pytest.raises(DataError, match=words) as caught:
            make_psf(kernel)
        assert caught.value.code == code
    shared = np.zeros((16, 16))
    shared[8, 8], shared[8, 9] = 0.4999, 0.5001
    assert make_psf(shared).total == pytest.approx(1.0), "a peak shared to a thousandth is centred"


def test_encircled_energy_counts_by_brute_force() -> None:
    kernel = np.random.default_rng(3).random((12, 15))
    y, x = np.mgrid[:12, :15]
    r2 = (y - 6) ** 2 + (x - 7) ** 2
    radii = np.array([0.0, 0.5, 1.0, np.sqrt(2), 1.9, np.sqrt(5), np.sqrt(13), 7.3, 50.0])
    expected = [kernel[r2 <= round(r * r, 9)].sum() for r in radii]
    np.testing.assert_allclose(encircled_energy(kernel, radii), expected, rtol=1e-12)


def test_cumulative_curve_of_a_delta_is_zero_and_includes_light_outside_the_array() -> None:
    np.testing.assert_allclose(cumulative_curve(delta(16), [0.0, 0.5, 5.0]), 0.0, atol=1e-12)
    np.testing.assert_allclose(cumulative_curve(0.8 * delta(16), [0.5, 99.0]), 20.0)


def test_gaussian_encloses_what_its_formula_says() -> None:
    radius = np.array([5.0, 10.0, 20.0])
    formula = 1 - np.exp(-(radius**2) / (2 * 8.0**2))
    np.testing.assert_allclose(encircled_energy(gaussian(129, 8.0), radius), formula, atol=0.005)


def test_radial_profile_of_a_function_of_radius_follows_it() -> None:
    radius, weight = radial_profile(gaussian(65, 6.0))
    np.testing.assert_allclose(weight[:20] / weight[0], np.exp(-(radius[:20] ** 2) / 72), rtol=0.05)


def test_cropping_keeps_the_centre_and_does_not_renormalise() -> None:
    for size, new in itertools.product((16, 17), (8, 9)):
        kernel = gaussian(size, 5.0)
        part = crop_centred(kernel, (new, new))
        assert part[new // 2, new // 2] == kernel[size // 2, size // 2]
        assert part.sum() < 1


def test_plate_scales_must_agree_to_a_percent_where_known() -> None:
    psf = make_psf(delta(16), plate_scale_arcsec=0.492)
    for cdelt, cunit, agree in (
        (0.492, "arcsec", True),
        (-0.492, "arcsec", True),
        (0.492 / 3600, "deg", True),
        (0.4935, "arcsec", True),
        (4.44, "arcsec", False),
        (0.492 * 1.02, None, False),
        (None, None, True),
        (0.0, "arcsec", True),
        (7.0, "furlong", True),
    ):
        cards = {
            f"{key}{axis}": value for key, value in (("CDELT", cdelt), ("CUNIT", cunit)) for axis in (1, 2)
        }
        header = fits.Header({key: value for key, value in cards.items() if value is not None})
        image = Image(np.ones((16, 16)), np.zeros((16, 16), np.uint8), header, None, None)
        if agree:
            check_compatible(image, psf)
        else:
            with pytest.raises(DataError, match=r"plate-scale-mismatch.*0\.492"):
                check_compatible(image, psf)


def test_a_kernel_is_cut_or_padded_about_its_centre() -> None:
    kernel = np.arange(31 * 31, dtype=np.float64).reshape(31, 31)
    for size in (31, 64, 65, 20):
        out, least = crop_or_pad(kernel, size), min(size, 31)
        assert out.shape == (size, size)
        assert out[size // 2, size // 2] == kernel[15, 15]
        np.testing.assert_array_equal(crop_centred(out, (least, least)), crop_centred(kernel, (least, least)))
        assert size <= 31 or out.sum() == kernel.sum()
    assert crop_or_pad(kernel[:, :20], 40)[20, 20] == kernel[15, 10]
