from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.errors import DataError
from psfcore.fits.header import plate_scale_arcsec
from psfcore.psf import Psf, crop_centred
from psfcore.psf_sampling import psf_for_image, rebinned, rebinned_kernel
from psfcore.scatter.power_law import scatter_kernel
from tests.psfcore.conftest import delta, gaussian, make_psf

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


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("shape", [(24, 24), (25, 25), (24, 31), (33, 20)])
def test_rebinning_is_exact_where_the_scene_is_constant_within_binned_pixels(
    factor: int, shape: tuple[int, int]
) -> None:
    """Compare with a convolution at full resolution that is then binned; even, odd and oblong kernels and fields."""
    scene = np.random.default_rng(factor).random((13, 18))
    fine = np.kron(scene, np.ones((factor, factor)))
    kernel = lopsided(shape)
    expected = binned(see(fine, kernel), factor)
    np.testing.assert_allclose(see(scene, rebinned_kernel(kernel, factor)), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("factor", FACTORS)
def test_rebinning_holds_on_a_smooth_scene(factor: int) -> None:
    """For structures of 6 binned pixels (sigma) on a sky, both ways agree to half a percent."""
    y, x = np.mgrid[: 48 * factor, : 60 * factor] / factor
    scene = 20 + 300 * np.exp(-((y - 20.3) ** 2 + (x - 31.6) ** 2) / (2 * 6.0**2))
    kernel = wings(256).kernel
    expected = binned(see(scene, kernel), factor)
    found = see(binned(scene, factor), rebinned_kernel(kernel, factor))
    assert np.abs(found / expected - 1).max() < 0.005


@pytest.mark.parametrize("factor", FACTORS)
def test_energy_and_centre_are_kept_and_a_delta_stays_a_delta(factor: int) -> None:
    psf = wings(256)
    coarse = rebinned(psf, factor)
    assert coarse.total == pytest.approx(psf.total, rel=1e-12)
    assert coarse.components["SCATTER"].sum() == pytest.approx(psf.components["SCATTER"].sum(), rel=1e-12)
    kernel, (cy, cx) = coarse.kernel, (n // 2 for n in coarse.kernel.shape)
    inner = np.s_[cy - 10 : cy + 11, cx - 10 : cx + 11]
    np.testing.assert_allclose(
        kernel[inner], kernel[inner][::-1, ::-1], rtol=1e-9
    )  # no shift by half a pixel
    assert kernel.argmax() == cy * kernel.shape[1] + cx
    assert coarse.plate_scale_arcsec == pytest.approx(0.492 * factor)
    assert coarse.version.endswith(f"+bin{factor}") and coarse.provenance["binning"] == factor
    one = rebinned_kernel(delta(32), factor)
    assert one[one.shape[0] // 2, one.shape[1] // 2] == 1.0 and one.sum() == 1.0


def test_light_beyond_the_full_reach_is_left_out_before_binning() -> None:
    kernel = np.zeros((2100, 2100))
    kernel[1050, 1050] = 0.999
    kernel[3, 1050] = 0.2  # farther than 1024 px
    assert rebinned_kernel(kernel, 2).sum() == pytest.approx(0.999)


@pytest.mark.parametrize("factor", [-1, 0, 17, 100])
def test_a_wrong_factor_is_refused(factor: int) -> None:
    with pytest.raises(DataError) as caught:
        rebinned(make_psf(delta(32)), factor)
    assert caught.value.code == "bad-binning"


# --- for an image ---


def header(step_1: float | None, step_2: float | None = None, unit: str | None = "arcsec") -> Header:
    made = Header()
    for axis, step in ((1, step_1), (2, step_1 if step_2 is None else step_2)):
        if step is not None:
            made[f"CDELT{axis}"] = step
        if unit is not None:
            made[f"CUNIT{axis}"] = unit
    return made


@pytest.mark.parametrize(
    ("made", "factor"),
    [
        (header(0.492), 1),
        (header(0.4935, -0.492), 1),
        (header(None), 1),
        (header(0.984), 2),
        (header(-0.984, 0.984), 2),
        (header(3 * 0.492 / 3600, unit="deg"), 3),
        (header(4 * 0.492 / 60, unit="arcmin"), 4),
        (header(0.984, unit=None), 2),
        (header(7.0, unit="furlong"), 1),
    ],
)
def test_the_psf_is_rebinned_to_the_pixels_of_the_image(made: Header, factor: int) -> None:
    psf = wings(128)
    found = psf_for_image(psf, made)
    assert found.provenance.get("binning", 1) == factor
    assert (found is psf) == (factor == 1)


@pytest.mark.parametrize(
    "made", [header(0.7), header(0.984, 0.492), header(0.246), header(2.3), header(0.492 * 2.05)]
)
def test_a_plate_scale_that_is_no_multiple_is_a_mismatch(made: Header) -> None:
    with pytest.raises(DataError, match=r"0\.492") as caught:
        psf_for_image(wings(128), made)
    assert caught.value.code == "plate-scale-mismatch"


def test_pixels_of_another_telescope_are_not_binned_pixels() -> None:
    """An FSI pixel equals nine HRI_EUV pixels to 0.3 %."""
    psf = replace(wings(128), instrument="hri_euv")
    own, other = header(0.984), header(4.44012445)
    own["DETECTOR"], other["DETECTOR"] = "HRI_EUV", "FSI"
    assert psf_for_image(psf, own).provenance["binning"] == 2
    with pytest.raises(DataError, match="or binned images of its instrument") as caught:
        psf_for_image(psf, other)
    assert caught.value.code == "plate-scale-mismatch"


def test_a_psf_without_plate_scale_fits_any_image() -> None:
    psf = make_psf(delta(32))
    assert psf_for_image(psf, header(3.3)) is psf


def test_a_window_has_the_same_psf_except_near_its_edge() -> None:
    """Only differences of positions matter, not where the window starts on the detector."""
    scene = np.random.default_rng(5).random((120, 150))
    kernel = lopsided((21, 27))
    whole, window = see(scene, kernel), see(scene[30:95, 41:140], kernel)
    np.testing.assert_allclose(window[13:-13, 14:-14], whole[43:82, 55:126], rtol=1e-12)


@pytest.mark.parametrize(
    ("step", "unit", "arcsec"),
    [
        (0.5, "arcsec", 0.5),
        (-0.5, "ARCSEC", 0.5),
        (0.5, None, 0.5),
        (1 / 3600, "deg", 1.0),
        (2.0, "arcmin", 120.0),
        (0.0, "arcsec", None),
        (0.5, "um", None),
        (None, "arcsec", None),
        ("0.5", "arcsec", None),
        (True, "arcsec", None),
    ],
)
def test_plate_scale(step: float | None, unit: str | None, arcsec: float | None) -> None:
    made = Header()
    if step is not None:
        made["CDELT2"] = step
    if unit is not None:
        made["CUNIT2"] = unit
    assert plate_scale_arcsec(made, 2) == (None if arcsec is None else pytest.approx(arcsec))
    assert plate_scale_arcsec(made, 1) is None


@pytest.mark.parametrize("shift", [(0, 1), (1, 0), (-1, -1)])
def test_a_peak_beside_the_centre_is_refused(shift: tuple[int, int]) -> None:
    with pytest.raises(DataError) as caught:
        make_psf(np.roll(gaussian(32, 1.5), shift, (0, 1)))
    assert caught.value.code == "psf-not-centred"


def test_a_peak_shared_to_a_thousandth_is_centred() -> None:
    kernel = np.zeros((16, 16))
    kernel[8, 8], kernel[8, 9] = 0.4999, 0.5001
    assert make_psf(kernel).total == pytest.approx(1.0)
