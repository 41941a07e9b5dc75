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
@pytest.mark.parametrize(
    ("name", "instrument", "kept"),
    [
        ("eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits", "hri_euv", 0.01),
        ("aia/aia_171_cutout_20130310.fits", "aia_171", 0.03),
    ],
)
def test_an_image_of_a_known_telescope_needs_no_option(
    shared: Path, name: str, instrument: str, kept: float
) -> None:
    """kept: relative change of the sum of all pixels; a cut-out exchanges light with the Sun beyond its edges."""
    image = sunpy.map.Map(real(shared, name))
    sharp = heliopsf.deconvolve(image)
    assert type(sharp) is type(image) and sharp.meta["psfname"] == instrument
    assert sharp.wcs.wcs.compare(image.wcs.wcs)
    assert sharp.data.sum() == pytest.approx(image.data.sum(), rel=kept)
    assert np.percentile(sharp.data, 99) > np.percentile(image.data, 99)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "telescope", "step"),
    [
        ("occultation/L1_XRT20120605_215839.9.fits", "Hinode/XRT", "PSF560.fits"),
        ("occultation/AIA1600_venus_20120606_040731_UTC.0041.fits", "SDO/AIA", "Venus of 2012"),
    ],
)
def test_an_image_of_a_telescope_without_a_file_is_refused_with_a_way_out(
    shared: Path, name: str, telescope: str, step: str
) -> None:
    with pytest.raises(heliopsf.DataError, match="no-psf-for-instrument") as caught:
        heliopsf.deconvolve(sunpy.map.Map(real(shared, name)))
    assert caught.value.fields["image"] == telescope
    assert step in caught.value.message and "psf in Python" in caught.value.message


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "name",
    [
        "occultation/L1_XRT20120605_215839.9.fits",
        "other/trace_19980519_222143_171.fits.gz",
        pytest.param("other/swap_lv1_20110607_063329.fits.gz", marks=pytest.mark.slow),
        pytest.param("eui/solo_L2_eui-fsi174-image_20240109T200055237_V01.fits", marks=pytest.mark.slow),
    ],
)
def test_an_image_goes_in_and_out_with_a_given_psf(shared: Path, name: str) -> None:
    image = sunpy.map.Map(real(shared, name))
    weights = np.zeros((65, 65))
    weights[31:34, 31:34] = 0.02
    weights[32, 32] = 1 - 8 * 0.02
    sharp = heliopsf.deconvolve(image, weights, iterations=3)
    assert type(sharp) is type(image) and sharp.data.shape == image.data.shape
    assert sharp.wcs.wcs.compare(image.wcs.wcs) and sharp.meta["dcnviter"] == 3
    with pytest.raises(heliopsf.DataError, match="already-deconvolved"):
        heliopsf.deconvolve(sharp, weights)
