"""Real images over HTTP."""

from __future__ import annotations

from pathlib import Path

import pytest
from astropy.io import fits

from tests.whole.stack import Stack

pytestmark = pytest.mark.slow
HRI = "data/real/eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits"
AIA = "data/real/aia/aia.lev1_euv_12s.2022-04-02T132423Z.304.image.fits"
AIA_GZ = "data/real/aia/AIA20110319_105400_0171.fits.gz"  # binned 4 x 4
TRACE = "data/real/other/trace_19980519_222143_171.fits.gz"


def test_the_real_hri_image(open_stack: Stack, shared: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.fits"
    product = open_stack.client.deconvolve(shared / HRI, output)
    change = product["details"]
    assert abs(change["flux_change_pct"]) < 1
    assert change["bright_change_pct"] > 10
    assert change["dark_change_pct"] < -5
    sunpy_map = pytest.importorskip("sunpy.map").Map(output)[0]
    assert sunpy_map.detector == "HRI_EUV" and sunpy_map.data.shape == (2048, 2048)
    before = fits.getheader(shared / HRI, 1)
    for card in ("CRVAL1", "CRPIX2", "PC1_2", "CDELT1", "RSUN_ARC", "DATE-BEG", "XPOSURE"):
        assert sunpy_map.fits_header[card] == before[card]


@pytest.mark.parametrize(("name", "psf"), [(AIA, "aia_304"), (AIA_GZ, "aia_171"), (TRACE, "trace_171")])
def test_real_images_need_no_option(
    open_stack: Stack, shared: Path, tmp_path: Path, name: str, psf: str
) -> None:
    product = open_stack.client.deconvolve(shared / name, tmp_path / "out.fits")
    assert abs(product["details"]["flux_change_pct"]) < 1
    dark = product["details"]["dark_change_pct"]
    # The darkest pixels of the binned image sum to less than zero, so that their change has no percentage.
    assert dark is None if name == AIA_GZ else dark < 0
    assert product["details"]["bright_change_pct"] > 0
    assert fits.getheader(tmp_path / "out.fits")["PSFNAME"] == psf
