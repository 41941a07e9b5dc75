"""Files that are plainly no PSF are known before any job, without numerical libraries."""

from __future__ import annotations

import gzip
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits, read_summary
from psfcore.fits.psfs import read_psf
from psfcore.fits.weights import check_is_psf
from psfcore.weight_rules import REACH_GRID_PX
from tests.conftest import write_image, write_psf

Kernel = NDArray[np.float64]
LIMITS = FitsLimits(max_pixels=2**24)


def told(path: Path) -> str | None:
    """The code with which a file is refused; None if it can be a PSF."""
    try:
        check_is_psf(path, read_summary(path, LIMITS), LIMITS)
    except DataError as error:
        return error.code
    return None


def kernel(ny: int = 33, nx: int = 40) -> Kernel:
    y, x = np.indices((ny, nx))
    weights = np.exp(-((y - ny // 2) ** 2 + (x - nx // 2) ** 2) / 8.0)
    return np.asarray(weights / weights.sum())


def off_centre(weights: Kernel) -> Kernel:
    return np.roll(weights, 1, axis=1)


def with_nan(weights: Kernel) -> Kernel:
    weights[0, 0] = np.nan
    return weights


def below_zero(weights: Kernel) -> Kernel:
    weights[0, 0] = -0.01
    return weights


def same(weights: Kernel) -> Kernel:
    return weights


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (same, None),
        (lambda w: w * 3, "psf-sum"),
        (lambda w: w * 0.01, "psf-sum"),
        (off_centre, "psf-not-centred"),
        (with_nan, "psf-nonfinite"),
        (below_zero, "psf-negative"),
    ],
)
@pytest.mark.parametrize("stored", [">f4", ">f8"])
@pytest.mark.parametrize("place", ["first", "second", "gzip"])
def test_weights_are_judged_as_the_jobs_judge_them(
    tmp_path: Path, change: Callable[[Kernel], Kernel], code: str | None, stored: str, place: str
) -> None:
    data = change(kernel()).astype(stored)
    path = tmp_path / ("p.fits.gz" if place == "gzip" else "p.fits")
    hdus = [fits.PrimaryHDU(data)] if place != "second" else [fits.PrimaryHDU(), fits.ImageHDU(data)]
    fits.HDUList(hdus).writeto(tmp_path / "plain.fits")
    content = (tmp_path / "plain.fits").read_bytes()
    path.write_bytes(gzip.compress(content) if place == "gzip" else content)
    assert told(path) == code
    if code is None:
        read_psf(path, LIMITS)
    else:
        with pytest.raises(DataError) as caught:
            read_psf(path, LIMITS)
        assert caught.value.code == code


def test_stored_integers_are_scaled(tmp_path: Path) -> None:
    hdu = fits.PrimaryHDU(kernel(32, 32))
    hdu.scale("int16", bscale=2**-20, bzero=10485 * 2**-20)
    hdu.writeto(tmp_path / "p.fits")
    assert told(tmp_path / "p.fits") is None
    assert read_psf(tmp_path / "p.fits", LIMITS).total == pytest.approx(1, abs=1e-3)


def test_the_sum_is_that_within_the_reach(tmp_path: Path) -> None:
    wide = np.zeros((3, REACH_GRID_PX + 20), "f4")
    wide[1, wide.shape[1] // 2] = 0.9
    wide[:, :10] = 0.5  # beyond the reach
    fits.PrimaryHDU(wide).writeto(tmp_path / "wide.fits")
    assert told(tmp_path / "wide.fits") is None
    wide[1, 10] = 0.5  # the first pixel of the reach
    fits.PrimaryHDU(wide).writeto(tmp_path / "more.fits")
    assert told(tmp_path / "more.fits") == "psf-sum"


def test_images_and_products_are_no_psfs(tmp_path: Path) -> None:
    write_psf(tmp_path / "psf.fits")
    assert told(tmp_path / "psf.fits") is None
    write_image(tmp_path / "image.fits")
    assert told(tmp_path / "image.fits") == "psf-sum"
    weights = fits.getdata(tmp_path / "psf.fits")
    fits.PrimaryHDU(weights, fits.Header({"PSFID": "a"})).writeto(tmp_path / "product.fits")
    assert told(tmp_path / "product.fits") == "image-as-psf"
    for name, cards, code in (
        ("seen", {"XPOSURE": 2.0}, "image-as-psf"),
        ("own", {"XPOSURE": 2.0, "PSFSUM": 1.0}, None),
        ("bare", {}, None),
    ):
        packed = fits.CompImageHDU(fits.getdata(tmp_path / "image.fits"), fits.Header(cards))
        fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / f"{name}.fits")
        assert told(tmp_path / f"{name}.fits") == code, name


def test_the_check_needs_no_numerics() -> None:
    code = "import sys, psfcore.fits.weights; print('\\n'.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert {"numpy", "astropy"} & set(loaded.split()) == set()
