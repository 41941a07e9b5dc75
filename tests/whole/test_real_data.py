"""Real images over HTTP, and files that are none, with an eye on the server's memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from service.client.http import ServiceError
from tests.conftest import write_psf
from tests.whole import stack as stacks
from tests.whole.stack import Stack

HRI = "data/real/eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits"
FSI = "data/real/eui/solo_L2_eui-fsi174-image_20240109T200055237_V01.fits"
AIA = "data/real/aia/aia.lev1_euv_12s.2022-04-02T132423Z.304.image.fits"
AIA_GZ = "data/real/aia/AIA20110319_105400_0171.fits.gz"  # binned 4 x 4
SWAP = "data/real/other/swap_lv1_20110607_063329.fits.gz"
TRACE = "data/real/other/trace_19980519_222143_171.fits.gz"
XRT = "data/real/occultation/L1_XRT20120605_215839.9.fits"
JP2 = "data/real/eui/solo_L3_eui-hrieuv174-image_20220401T103005920_V01.jp2"


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    with stacks.embedded(tmp_path_factory.mktemp("stack")) as running:
        yield running


@pytest.mark.slow
def test_the_real_hri_image(stack: Stack, shared: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.fits"
    product = stack.client.deconvolve(shared / HRI, output)
    change = product["details"]
    assert abs(change["flux_change_pct"]) < 1
    assert change["bright_change_pct"] > 10
    assert change["dark_change_pct"] < -5
    sunpy_map = pytest.importorskip("sunpy.map").Map(output)[0]
    assert sunpy_map.detector == "HRI_EUV" and sunpy_map.data.shape == (2048, 2048)
    before = fits.getheader(shared / HRI, 1)
    for card in ("CRVAL1", "CRPIX2", "PC1_2", "CDELT1", "RSUN_ARC", "DATE-BEG", "XPOSURE"):
        assert sunpy_map.fits_header[card] == before[card]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "psf"), [(AIA, "aia_304"), (AIA_GZ, "aia_171")])
def test_real_aia_images_need_no_option(
    stack: Stack, shared: Path, tmp_path: Path, name: str, psf: str
) -> None:
    product = stack.client.deconvolve(shared / name, tmp_path / "out.fits")
    assert abs(product["details"]["flux_change_pct"]) < 1
    dark = product["details"]["dark_change_pct"]
    # The darkest pixels of the binned image sum to less than zero, so that their change has no percentage.
    assert dark is None if name == AIA_GZ else dark < 0
    assert product["details"]["bright_change_pct"] > 0
    assert fits.getheader(tmp_path / "out.fits")["PSFNAME"] == psf


@pytest.mark.parametrize("name", [FSI, SWAP, TRACE, XRT], ids=["FSI", "SWAP", "TRACE", "XRT"])
def test_images_of_other_telescopes_need_a_psf_of_theirs(
    stack: Stack, shared: Path, tmp_path: Path, psf_file: Path, name: str
) -> None:
    with pytest.raises(ServiceError, match="upload a PSF") as refused:
        stack.client.deconvolve(shared / name)
    assert refused.value.status == 409
    psf_id = stack.client.upload_psf(psf_file)["id"]
    product = stack.client.deconvolve(shared / name, tmp_path / "out.fits", psf_id=psf_id, steps=2)
    assert abs(product["details"]["flux_change_pct"]) < 1
    assert len(fits.getheader(tmp_path / "out.fits")) > 50


def test_a_psf_of_another_plate_scale_is_refused(stack: Stack, shared: Path, tmp_path: Path) -> None:
    write_psf(tmp_path / "psf.fits")
    for card, value in {"CDELT1": 3.0, "CDELT2": 3.0, "CUNIT1": "arcsec", "CUNIT2": "arcsec"}.items():
        fits.setval(tmp_path / "psf.fits", card, value=value)
    psf_id = stack.client.upload_psf(tmp_path / "psf.fits")["id"]
    with pytest.raises(ServiceError, match="arcsec") as failed:
        stack.client.deconvolve(shared / FSI, psf_id=psf_id)
    assert failed.value.code == "plate-scale-mismatch"


def test_a_jpeg_is_refused_at_once(stack: Stack, shared: Path) -> None:
    with pytest.raises(ServiceError, match="expected a FITS file") as refused:
        stack.client.upload_image(shared / JP2)
    assert refused.value.status == 415


def test_the_servers_memory_stays_within_the_size_limit(stack: Stack, tmp_path: Path) -> None:
    """A file of the size limit, one beyond it and one whose header claims 14 GB."""
    status = Path(f"/proc/{stack.server.pid}/status") if stack.server else Path("/none")
    if not status.exists():
        pytest.skip("no /proc on this machine")
    limit = 160 * 2**20
    (tmp_path / "huge").write_bytes(
        fits.Header({"SIMPLE": True, "BITPIX": -32, "NAXIS": 2, "NAXIS1": 60_000, "NAXIS2": 60_000})
        .tostring()
        .encode()
    )
    with (tmp_path / "beyond").open("wb") as file:
        file.write(b"SIMPLE  =")
        file.truncate(limit + 1)
    fits.PrimaryHDU(np.ones((4096, 4096), "f8")).writeto(tmp_path / "full.fits")

    before = peak_kib(status)
    for name in ("huge", "beyond"):
        with pytest.raises(ServiceError) as refused:
            stack.client.upload_image(tmp_path / name)
        assert refused.value.status in (413, 422)
    assert stack.client.upload_image(tmp_path / "full.fits")["header"]["shape"] == [4096, 4096]
    assert peak_kib(status) - before < limit / 1024 / 4, "streamed, so far below the limit"


def peak_kib(status: Path) -> int:
    """The largest resident size that the process ever had."""
    line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1])
