"""The summary of an image's header: values, missing values, and real files."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.fits.header import FitsLimits, read_summary
from tests.psfcore.fits.raw_files import block, image_cards

SMALL = FitsLimits(max_pixels=4096 * 4096, max_header_bytes=64 * 1024, max_hdus=8)

# The tests contain damaged cards, and astropy warns of many of them.
pytestmark = pytest.mark.filterwarnings("ignore::astropy.utils.exceptions.AstropyUserWarning")


@pytest.mark.parametrize("packed", [False, True])
def test_the_first_image_is_used_and_its_cards_are_read(tmp_path: Path, packed: bool) -> None:
    header = fits.Header()
    header.update(TELESCOP="SOLO/EUI/HRI_EUV", INSTRUME="EUI", DETECTOR="HRI_EUV", WAVELNTH=174, XPOSURE=1.4)
    header.update(BUNIT="DN/s", CDELT1=0.492, CDELT2=0.492, GAINCOMB="combined", PXBEG1=641, PXEND1=700)
    header.update(PXBEG2=577, PXEND2=600)
    header["DATE-BEG"] = "2022-04-01T10:30:05.920"
    rows = fits.BinTableHDU.from_columns([fits.Column("A", "D", array=np.arange(500.0))])
    hdus = [
        fits.PrimaryHDU(),
        rows,
        fits.ImageHDU(np.ones((24, 60), ">i2"), header),
        fits.ImageHDU(np.ones((99, 99))),
    ]
    path = tmp_path / ("two.fits.gz" if packed else "two.fits")
    fits.HDUList(hdus).writeto(path)
    summary = read_summary(path, SMALL)
    assert (summary.hdu, summary.shape, summary.bitpix, summary.codec) == (2, (24, 60), 16, None)
    assert summary.gzipped is packed
    assert (summary.instrument, summary.detector, summary.wavelnth) == ("hri_euv", "HRI_EUV", 174.0)
    assert (summary.exposure_s, summary.unit, summary.gain_mode) == (1.4, "DN/s", "combined")
    assert (summary.pxbeg, summary.pxend) == ((641, 577), (700, 600))
    assert summary.date_obs == "2022-04-01T10:30:05.920"
    assert json.loads(json.dumps(dataclasses.asdict(summary), allow_nan=False))["shape"] == [24, 60]


def test_unusable_descriptive_cards_count_as_missing(tmp_path: Path) -> None:
    odd = [
        "CDELT1  = 1E999",
        "XPOSURE = -1.0",
        "WAVELNTH= 'long'",
        "BUNIT   = ''",
        "DETECTOR= 12",
        "DATE-OBS= 1 2 3",
    ]
    path = tmp_path / "odd.fits"
    path.write_bytes(block(*image_cards(32, 16, 16, *odd), data=bytes(1024)))
    summary = read_summary(path, SMALL)
    assert (summary.cdelt1, summary.exposure_s, summary.wavelnth, summary.unit) == (None, None, None, None)
    assert (summary.detector, summary.date_obs, summary.instrument) == (None, None, None)


def test_the_header_reader_imports_no_numerical_library() -> None:
    code = "import sys, psfcore.fits.header; print([m for m in ('scipy', 'numba', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("name", "shape", "codec", "instrument"),
    [
        ("eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits", (2048, 2048), "GZIP_2", "hri_euv"),
        ("eui/solo_L2_eui-fsi174-image_20240109T200055237_V01.fits", (3072, 3040), "RICE_1", None),
        ("aia/aia_171_cutout_20130310.fits", (705, 769), "RICE_1", None),
        ("aia/AIA20110319_105400_0171.fits.gz", (1024, 1024), None, None),
        ("occultation/L1_XRT20120605_215839.9.fits", (384, 384), None, None),
    ],
)
def test_real_headers(
    real: Callable[[str], Path], name: str, shape: tuple[int, int], codec: str | None, instrument: str | None
) -> None:
    summary = read_summary(real(name), SMALL)
    assert (summary.shape, summary.codec, summary.instrument) == (shape, codec, instrument)
    assert summary.gzipped is name.endswith(".gz")
