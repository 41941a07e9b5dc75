"""Files that are plainly no PSF are known before any job, without numerical libraries."""

from __future__ import annotations

import gzip
import subprocess
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits, read_summary
from psfcore.fits.psfs import read_psf
from psfcore.fits.stored_psf import check_is_psf
from psfcore.psf import REACH_GRID_PX
from tests.conftest import write_image, write_psf

LIMITS = FitsLimits(max_pixels=2**24)


def code_of(read: Callable[[], object]) -> str | None:
    """The code with which a file is refused; None if it is read."""
    try:
        read()
    except DataError as error:
        return error.code
    return None


def verdict(path: Path) -> str | None:
    """The code with which the check refuses a file; None if the file can be a PSF."""
    return code_of(lambda: check_is_psf(path, read_summary(path, LIMITS), LIMITS))


def kernel(ny: int = 33, nx: int = 40, **first: float) -> NDArray[np.float64]:
    """A Gaussian of sum 1; ``first`` may give another value of its first pixel."""
    y, x = np.indices((ny, nx))
    weights = np.exp(-((y - ny // 2) ** 2 + (x - nx // 2) ** 2) / 8.0)
    weights /= weights.sum()
    weights[0, 0] = first.get("value", weights[0, 0])
    return weights


WEIGHTS = [
    (kernel(), None),
    (3 * kernel(), "psf-sum"),
    (0.01 * kernel(), "psf-sum"),
    (np.roll(kernel(), 1, axis=1), "psf-not-centred"),
    (kernel(value=np.nan), "psf-nonfinite"),
    (kernel(value=-0.01), "psf-negative"),
]


def test_weights_are_judged_as_the_jobs_judge_them(tmp_path: Path) -> None:
    places = ["first", "second", "gzip"]
    for number, ((weights, code), stored, place) in enumerate(product(WEIGHTS, [">f4", ">f8"], places)):
        data = weights.astype(stored)
        hdus = [fits.PrimaryHDU(data)] if place != "second" else [fits.PrimaryHDU(), fits.ImageHDU(data)]
        path = tmp_path / f"{number}.fits"
        fits.HDUList(hdus).writeto(path)
        if place == "gzip":
            path.write_bytes(gzip.compress(path.read_bytes()))
        judged = verdict(path), code_of(lambda path=path: read_psf(path, LIMITS))
        assert judged == (code, code), (code, stored, place)


def test_stored_integers_are_scaled(tmp_path: Path) -> None:
    hdu = fits.PrimaryHDU(kernel(32, 32))
    hdu.scale("int16", bscale=2**-20, bzero=10485 * 2**-20)
    hdu.writeto(tmp_path / "p.fits")
    assert verdict(tmp_path / "p.fits") is None
    assert read_psf(tmp_path / "p.fits", LIMITS).total == pytest.approx(1, abs=1e-3)


def test_the_sum_is_that_within_the_reach(tmp_path: Path) -> None:
    wide = np.zeros((3, REACH_GRID_PX + 20), "f4")
    wide[1, wide.shape[1] // 2] = 0.9
    wide[:, :10] = 0.5  # beyond the reach
    fits.PrimaryHDU(wide).writeto(tmp_path / "wide.fits")
    assert verdict(tmp_path / "wide.fits") is None
    wide[1, 10] = 0.5  # the first pixel of the reach
    fits.PrimaryHDU(wide).writeto(tmp_path / "more.fits")
    assert verdict(tmp_path / "more.fits") == "psf-sum"


def test_images_and_products_are_no_psfs(tmp_path: Path) -> None:
    write_psf(tmp_path / "psf.fits")
    assert verdict(tmp_path / "psf.fits") is None
    write_image(tmp_path / "image.fits")
    assert verdict(tmp_path / "image.fits") == "psf-sum"
    weights = fits.getdata(tmp_path / "psf.fits")
    fits.PrimaryHDU(weights, fits.Header({"PSFID": "a"})).writeto(tmp_path / "product.fits")
    assert verdict(tmp_path / "product.fits") == "image-as-psf"
    packed = fits.CompImageHDU(fits.getdata(tmp_path / "image.fits"))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "packed.fits")
    assert verdict(tmp_path / "packed.fits") == "psf-sum"


def test_the_check_needs_no_numerics() -> None:
    code = "import sys, psfcore.fits.stored_psf; print('\\n'.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert {"numpy", "astropy"} & set(loaded.split()) == set()
