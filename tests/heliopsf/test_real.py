"""The three lines on files of real telescopes: a Map with the right coordinates, or the error that says what to do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import sunpy.map

import heliopsf


def real(shared: Path, name: str) -> Path:
    path = shared / "data" / "real" / name
    if not path.is_file():
        pytest.skip(f"real data are not here: no file {path}")
    return path


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_an_image_of_hri_euv_needs_no_option(shared: Path) -> None:
    image = sunpy.map.Map(real(shared, "eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits"))
    sharp = heliopsf.deconvolve(image)
    assert type(sharp) is type(image) and sharp.meta["psfname"] == "hri_euv"
    assert sharp.wcs.wcs.compare(image.wcs.wcs)
    assert sharp.data.sum() == pytest.approx(image.data.sum(), rel=0.01)
    assert np.percentile(sharp.data, 99) > np.percentile(image.data, 99)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "name", ["occultation/L1_XRT20120605_215839.9.fits", "other/trace_19980519_222143_171.fits.gz"]
)
def test_an_image_goes_in_and_out_with_a_given_psf(shared: Path, name: str) -> None:
    image = sunpy.map.Map(real(shared, name))
    weights = np.zeros((65, 65))
    weights[32, 32], weights[31:34, 31:34] = 0.0, 0.02
    weights[32, 32] = 1 - weights.sum() + weights[32, 32]
    sharp = heliopsf.deconvolve(image, weights, iterations=3)
    assert type(sharp) is type(image) and sharp.data.shape == image.data.shape
    assert sharp.wcs.wcs.compare(image.wcs.wcs) and sharp.meta["dcnviter"] == 3
    with pytest.raises(heliopsf.DataError) as caught:
        heliopsf.deconvolve(sharp, weights)
    assert caught.value.code == "already-deconvolved"
