"""What a new user does with a real service: the curl lines of the documentation, Control-C, and commands over HTTP.
Real images over HTTP."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from astropy.io import fits

from tests.conftest import REPOSITORY, write_image, write_psf
from tests.whole.stack import Stack


def test_the_service_says_what_to_open_in_a_browser(open_stack: Stack) -> None:
    assert open_stack.said().splitlines()[1] == f"Open {open_stack.client.server} in a browser."


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is missing")
def test_the_curl_lines_of_the_documentation_work(open_stack: Stack, tmp_path: Path) -> None:
    [lines] = re.findall(r"```sh\n(.+?)```", (REPOSITORY / "docs" / "http.md").read_text("utf-8"), flags=re.S)
    assert lines.count("curl ") == 6 and lines.startswith("S=http://127.0.0.1:8765 ")
    write_psf(tmp_path / "psf.fits", size=256)
    described = {"instrument": "hri_euv", "channel": "174", "kind": "total"}
    psf = open_stack.client.upload_psf(tmp_path / "psf.fits", **described)
    times = {"valid_from": "2020-01-01", "valid_to": "2021-01-01"}  # not those of other tests' images
    open_stack.client.certify_psf(psf["id"], "1.0.0", **times)
    open_stack.client.psf_curve(psf["id"])  # makes the tables, which a built PSF has from the start
    write_image(
        tmp_path / "IMAGE.fits", DETECTOR="HRI_EUV", TELESCOP="SOLO/EUI/HRI_EUV", WAVELNTH=174.0,
        **{"DATE-BEG": "2020-05-05"},
    )  # fmt: skip
    script = lines.replace("http://127.0.0.1:8765", open_stack.client.server)
    done = subprocess.run(
        ["bash", "-eu", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["radii_px"] == [1, 10, 100] and answer["shape"] == [256, 256]
    assert fits.getval(tmp_path / "OUT.fits", "PSFID") == psf["id"]
    assert "event: end" in (tmp_path / "events.txt").read_text()


@pytest.mark.slow
def test_the_command_line_over_http_and_local_agree(
    open_stack: Stack, tmp_path: Path, psf_file: Path
) -> None:
    write_image(tmp_path / "image.fits", seed=7)
    command = [sys.executable, "-m", "service.cli", "deconvolve", str(tmp_path / "image.fits")]
    ways = {"remote": ["--server", open_stack.client.server], "local": ["--local"]}
    for name, way in ways.items():
        output = ["--psf", str(psf_file), "-o", str(tmp_path / f"{name}.fits")]
        subprocess.run([*command, *output, *way], check=True)
    assert (tmp_path / "remote.fits").read_bytes() == (tmp_path / "local.fits").read_bytes()


# --- real images -----------------------------------------------------------------------------------------


HRI = "data/real/eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits"
AIA = "data/real/aia/aia.lev1_euv_12s.2022-04-02T132423Z.304.image.fits"
AIA_GZ = "data/real/aia/AIA20110319_105400_0171.fits.gz"  # binned 4 x 4
TRACE = "data/real/other/trace_19980519_222143_171.fits.gz"


@pytest.mark.slow
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


@pytest.mark.slow
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
