"""The summary of an image's header: values, missing values, and real files."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import known_instrument, read_summary, wavelength_angstrom
from tests.psfcore.fits.raw_files import block, image_cards

SMALL = FitsLimits(max_pixels=4096 * 4096, max_header_bytes=64 * 1024, max_hdus=8)

# The tests contain damaged cards, and astropy warns of many of them.
pytestmark = pytest.mark.filterwarnings("ignore::astropy.utils.exceptions.AstropyUserWarning")


@pytest.mark.parametrize("name", ["two.fits", "two.fits.gz"])
def test_the_first_image_is_used_and_its_cards_are_read(tmp_path: Path, name: str) -> None:
    header = fits.Header()
    header.update(TELESCOP="SOLO/EUI/HRI_EUV", INSTRUME="EUI", DETECTOR="HRI_EUV", WAVELNTH=174, XPOSURE=1.4)
    header.update(BUNIT="DN/s", CDELT1=0.492, CDELT2=0.492, GAINCOMB="combined", PXBEG1=641, PXEND1=700)
    header.update(PXBEG2=577, PXEND2=600)
    header["DATE-BEG"] = "2022-04-01T10:30:05.920"
    rows = fits.BinTableHDU.from_columns([fits.Column("A", "D", array=np.arange(500.0))])
    images = fits.ImageHDU(np.ones((24, 60), ">i2"), header), fits.ImageHDU(np.ones((99, 99)))
    fits.HDUList([fits.PrimaryHDU(), rows, *images]).writeto(tmp_path / name)
    summary = read_summary(tmp_path / name, SMALL)
    assert (summary.hdu, summary.shape, summary.bitpix, summary.codec) == (2, (24, 60), 16, None)
    assert summary.gzipped is name.endswith(".gz")
    assert (summary.instrument, summary.detector, summary.wavelnth) == ("hri_euv", "HRI_EUV", 174.0)
    assert (summary.exposure_s, summary.unit, summary.gain_mode) == (1.4, "DN/s", "combined")
    assert (summary.pxbeg, summary.pxend) == ((641, 577), (700, 600))
    assert summary.date_obs == "2022-04-01T10:30:05.920"
    assert json.loads(json.dumps(dataclasses.asdict(summary), allow_nan=False))["shape"] == [24, 60]


def test_unusable_descriptive_cards_count_as_missing(tmp_path: Path) -> None:
    odd = ["CDELT1  = 1E999", "XPOSURE = -1.0", "WAVELNTH= 'long'", "BUNIT   = ''", "DETECTOR= 12"]
    path = tmp_path / "odd.fits"
    path.write_bytes(block(*image_cards(32, 16, 16, *odd, "DATE-OBS= 1 2 3"), data=bytes(1024)))
    summary = read_summary(path, SMALL)
    assert (summary.cdelt1, summary.exposure_s, summary.wavelnth, summary.unit) == (None, None, None, None)
    assert (summary.detector, summary.date_obs, summary.instrument) == (None, None, None)
    # The card of XRT and TRACE for the date.
    cards = image_cards(32, 16, 16, "DATE_OBS= '2012-06-05T22:00:00.123'")
    path.write_bytes(block(*cards, data=bytes(1024)))
    assert read_summary(path, SMALL).date_obs == "2012-06-05T22:00:00.123"


REAL = [
    ("eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits", (2048, 2048), "GZIP_2", "hri_euv"),
    ("eui/solo_L2_eui-fsi174-image_20240109T200055237_V01.fits", (3072, 3040), "RICE_1", None),
    ("aia/AIA20110319_105400_0171.fits.gz", (1024, 1024), None, "aia_171"),
    ("aia/aia.lev1_euv_12s.2022-04-02T132423Z.304.image.fits", (400, 450), "RICE_1", "aia_304"),
    ("aia/derived_aia193_coronalhole_20161123_map.fits.gz", (667, 667), None, "aia_193"),
    ("occultation/AIA1600_venus_20120606_040731_UTC.0041.fits", (480, 854), "RICE_1", None),
    ("other/swap_lv1_20110607_063329.fits.gz", (1024, 1024), None, None),
    ("other/trace_19980519_222143_171.fits.gz", (1024, 1024), None, "trace_171"),
    ("occultation/L1_XRT20120605_215839.9.fits", (384, 384), None, None),
]


def test_real_headers(real: Callable[[str], Path]) -> None:
    for name, shape, codec, instrument in REAL:
        summary = read_summary(real(name), SMALL)
        assert (summary.shape, summary.codec, summary.instrument) == (shape, codec, instrument), name
        assert summary.gzipped is name.endswith(".gz"), name


SUNPY = [
    ("aia_171_level1.fits", "aia_171", 171.0),
    ("swap_lv1_20140606_000113.header", None, 174.0),
    ("euvi_20090615_000900_n4euA_s.header", "euvi_171_a", 171.0),
    ("solo_L1_eui-fsi304-image_20201021T145510206_V03.header", None, 304.0),
    ("tsi20010130_025823_a2.header", "trace_171", 171.0),
    ("HinodeXRT.header", None, None),
]


def test_headers_of_sunpy_are_recognised() -> None:
    """Its test files; sunpy itself is not imported, which is slow."""
    sunpy = importlib.util.find_spec("sunpy")
    if sunpy is None or sunpy.origin is None:
        pytest.skip("sunpy is not installed")
    for name, instrument, angstrom in SUNPY:
        path = Path(sunpy.origin).parent / "data" / "test" / name
        header = fits.getheader(path) if path.suffix == ".fits" else fits.Header.fromtextfile(path)
        assert (known_instrument(header), wavelength_angstrom(header)) == (instrument, angstrom), name


def test_wavelengths_in_their_units() -> None:
    for cards, angstrom in (
        ({"WAVELNTH": 171}, 171.0),
        ({"WAVELNTH": 17.1, "WAVEUNIT": "nm"}, 171.0),
        ({"WAVELNTH": 171, "WAVEUNIT": -10}, 171.0),
        ({"WAVELNTH": 171, "WAVEUNIT": None}, 171.0),
        ({"WAVELNTH": 1710, "WAVEUNIT": "0.01 nm"}, None),
        ({"TELESCOP": "TRACE", "WAVE_LEN": "171"}, 171.0),
        ({"TELESCOP": "TRACE", "WAVE_LEN": "WL"}, None),
        ({"WAVELNTH": 0}, None),
        ({}, None),
    ):
        assert wavelength_angstrom(fits.Header(cards)) == pytest.approx(angstrom), cards
