"""PSFs: their checks, curves and arrays, and the PSF for binned pixels."""

from __future__ import annotations

import itertools
import pickle
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.errors import DataError, HeaderError
from psfcore.image import Image, MaskBit
from psfcore.psf import Psf, crop_centred, crop_or_pad, cumulative_curve, encircled_energy, radial_profile
from psfcore.psf_sampling import check_compatible, psf_for_image, rebinned, rebinned_kernel
from psfcore.scatter.power_law import scatter_kernel
from tests.psfcore.conftest import delta, gaussian, make_psf


def with_pixel(value: float) -> NDArray[np.float64]:
    kernel = delta(32)
    kernel[0, 0] = value
    return kernel


def test_a_wrong_psf_is_refused() -> None:
    for kernel, code, words in (
        (delta(32) * 3, "psf-sum", r"got 3:"),
        (delta(32) * 0.01, "psf-sum", "got 0.01"),
        (with_pixel(np.nan), "psf-nonfinite", "got 1"),
        (with_pixel(-1e-6), "psf-negative", "-1e-06"),
        (np.roll(delta(32), (-16, -16), (0, 1)), "psf-not-centred", "corner origin"),
        (np.roll(delta(32), 3, 0), "psf-not-centred", r"= \(16, 16\); got \(19, 16\)"),
        *(
            (np.roll(gaussian(32, 1.5), s, (0, 1)), "psf-not-centred", "got")
            for s in ((0, 1), (1, 0), (-1, -1))
        ),
        (0.5 * (delta(32) + np.roll(delta(32), 1, 1)), "psf-off-centre", "got it at x"),
        (np.ones(9) / 9, "psf-not-2d", "two axes"),
        (np.ones((1, 1)), "psf-too-small", "3 px per side"),
        (np.ones((1, 64)) / 64, "psf-too-small", r"\(1, 64\)"),
    ):
        with pytest.raises(DataError, match=words) as caught:
            make_psf(kernel)
        assert caught.value.code == code


def test_encircled_energy_curve_and_profile_by_brute_force_and_formula() -> None:
    kernel = np.random.default_rng(3).random((12, 15))
    y, x = np.mgrid[:12, :15]
    r2 = (y - 6) ** 2 + (x - 7) ** 2
    radii = np.array([0.0, 0.5, 1.0, np.sqrt(2), 1.9, np.sqrt(5), np.sqrt(13), 7.3, 50.0])
    expected = [kernel[r2 <= round(r * r, 9)].sum() for r in radii]
    np.testing.assert_allclose(encircled_energy(kernel, radii), expected, rtol=1e-12)
    np.testing.assert_allclose(cumulative_curve(delta(16), [0.0, 0.5, 5.0]), 0.0, atol=1e-12)
    np.testing.assert_allclose(cumulative_curve(0.8 * delta(16), [0.5, 99.0]), 20.0)
    radius, weight = radial_profile(gaussian(65, 6.0))
    np.testing.assert_allclose(weight[:20] / weight[0], np.exp(-(radius[:20] ** 2) / 72), rtol=0.05)


def test_plate_scales_must_agree_to_a_percent_where_known() -> None:
    psf = make_psf(delta(16), plate_scale_arcsec=0.492)
    for cdelt, cunit, agree in (
        (0.492, "arcsec", True),
        (-0.492, "ARCSEC", True),
        (0.492 / 3600, "deg", True),
        (0.4935, "arcsec", True),
        (4.44, "arcsec", False),
        (0.492 * 1.02, None, False),
        (None, None, True),
        (0.0, "arcsec", True),
        (7.0, "furlong", True),
        ("0.492", "arcsec", True),  # a number written as a text is a number
        ("7.0", "arcsec", False),
        ("about 7", "arcsec", True),
        (True, "arcsec", True),
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


# --- binned pixels ---------------------------------------------------------------------------------------


Plane = NDArray[np.float64]
FACTORS = [2, 3, 4, 5]


def lopsided(shape: tuple[int, int]) -> Plane:
    """An asymmetric kernel with its peak at the centre."""
    kernel = np.random.default_rng(shape[0]).random(shape) ** 4
    y, x = (np.arange(n) - n // 2 for n in shape)
    kernel *= np.exp(-0.2 * np.abs(y[:, None] + 0.5) - 0.3 * np.abs(x[None, :] - 0.3))
    kernel[shape[0] // 2, shape[1] // 2] = 2 * kernel.max()
    return kernel / kernel.sum()


def wings(size: int) -> Psf:
    scatter = crop_centred(scatter_kernel(6.15, 2.53, 0.411, 2048), (size, size))
    kernel = np.maximum(linear_convolve(scatter, gaussian(31, 0.8), (size, size)), 0)
    return make_psf(kernel, plate_scale_arcsec=0.492, components={"SCATTER": scatter})


def binned(plane: Plane, factor: int) -> Plane:
    ny, nx = plane.shape[0] // factor, plane.shape[1] // factor
    return plane.reshape(ny, factor, nx, factor).mean(axis=(1, 3))


def see(scene: Plane, kernel: Plane) -> Plane:
    return Convolver(kernel, scene.shape, dtype=np.float64).apply(scene)


def test_rebinning_is_exact_where_the_scene_is_constant_within_binned_pixels() -> None:
    """Compare with a convolution at full resolution that is then binned; even, odd and oblong kernels and fields."""
    for factor, shape in itertools.product(FACTORS, ((24, 24), (25, 25), (24, 31), (33, 20))):
        scene, kernel = np.random.default_rng(factor).random((13, 18)), lopsided(shape)
        expected = binned(see(np.kron(scene, np.ones((factor, factor))), kernel), factor)
        np.testing.assert_allclose(see(scene, rebinned_kernel(kernel, factor)), expected, rtol=0, atol=1e-12)


def test_energy_and_centre_are_kept_and_light_beyond_the_reach_is_left_out() -> None:
    psf = wings(256)
    for factor in FACTORS:
        coarse = rebinned(psf, factor)
        assert coarse.total == pytest.approx(psf.total, rel=1e-12)
        assert coarse.components["SCATTER"].sum() == pytest.approx(psf.components["SCATTER"].sum(), rel=1e-12)
        kernel, (cy, cx) = coarse.kernel, (n // 2 for n in coarse.kernel.shape)
        inner = kernel[cy - 10 : cy + 11, cx - 10 : cx + 11]
        np.testing.assert_allclose(inner, inner[::-1, ::-1], rtol=1e-9)  # no shift by half a pixel
        assert kernel.argmax() == cy * kernel.shape[1] + cx
        assert coarse.plate_scale_arcsec == pytest.approx(0.492 * factor)
        assert coarse.version.endswith(f"+bin{factor}") and coarse.provenance["binning"] == factor
        one = rebinned_kernel(delta(32), factor)
        assert one[one.shape[0] // 2, one.shape[1] // 2] == 1.0 and one.sum() == 1.0
    for wrong in (-1, 0, 17, 100):
        with pytest.raises(DataError, match="bad-binning"):
            rebinned(make_psf(delta(32)), wrong)
    kernel = np.zeros((2100, 2100))
    kernel[1050, 1050] = 0.999
    kernel[3, 1050] = 0.2  # farther than 1024 px
    assert rebinned_kernel(kernel, 2).sum() == pytest.approx(0.999)


# --- for an image ---


def header(step_1: float | None, step_2: float | None = None, unit: str | None = "arcsec") -> Header:
    steps = {"CDELT1": step_1, "CDELT2": step_1 if step_2 is None else step_2}
    cards = steps | {"CUNIT1": unit, "CUNIT2": unit}
    return Header({key: value for key, value in cards.items() if value is not None})


def test_the_psf_is_rebinned_to_the_pixels_of_the_image_of_its_telescope() -> None:
    psf = wings(128)
    for of_image, factor in (
        (header(0.492), 1),
        (header(0.4935, -0.492), 1),
        (header(None), 1),
        (header(0.984), 2),
        (header(-0.984, 0.984), 2),
        (header(3 * 0.492 / 3600, unit="deg"), 3),
        (header(4 * 0.492 / 60, unit="arcmin"), 4),
        (header(0.984, unit=None), 2),
        (header(7.0, unit="furlong"), 1),
    ):
        found = psf_for_image(psf, of_image)
        assert found.provenance.get("binning", 1) == factor
        assert (found is psf) == (factor == 1)
    no_multiple = (header(0.7), header(0.984, 0.492), header(0.246), header(2.3), header(0.492 * 2.05))
    for of_image in no_multiple:
        with pytest.raises(DataError, match=r"plate-scale-mismatch.*0\.492"):
            psf_for_image(psf, of_image)
    anywhere = make_psf(delta(32))
    assert psf_for_image(anywhere, header(3.3)) is anywhere, "a PSF without plate scale"
    # An FSI pixel equals nine HRI_EUV pixels to 0.3 %.
    psf = replace(wings(128), instrument="hri_euv")
    own, other = header(0.984), header(4.44012445)
    own["DETECTOR"], other["DETECTOR"] = "HRI_EUV", "FSI"
    assert psf_for_image(psf, own).provenance["binning"] == 2
    with pytest.raises(DataError, match="or binned images of its instrument") as caught:
        psf_for_image(psf, other)
    assert caught.value.code == "plate-scale-mismatch"


# --- images ---


def test_a_wrong_image_is_refused_and_any_bit_makes_a_pixel_invalid() -> None:
    for pixels, mask_shape, code in (
        (np.ones(400), (400,), "not-2d"),
        (np.ones((15, 200)), (15, 200), "too-small"),
        (np.ones((20, 20)), (20, 21), "mask-shape"),
        (np.full((20, 20), np.nan), (20, 20), "unmasked-nonfinite"),
    ):
        with pytest.raises(DataError, match=code):
            Image(pixels, np.zeros(mask_shape, np.uint8), fits.Header(), None, None)
    mask = np.zeros((16, 16), np.uint8)
    mask[0, 0], mask[1, 1] = MaskBit.NONFINITE, MaskBit.SATURATED
    image = Image(np.ones((16, 16)), mask, fits.Header(), None, None)
    assert not image.valid[0, 0]
    assert not image.valid[1, 1]
    assert image.valid.sum() == 254


def test_errors_can_be_pickled() -> None:
    error = pickle.loads(pickle.dumps(HeaderError("not-fits", "expected FITS; got soup")))
    assert isinstance(error, HeaderError)
    assert (error.code, error.message) == ("not-fits", "expected FITS; got soup")
