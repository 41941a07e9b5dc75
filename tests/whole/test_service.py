"""What a person does with a running service: an image in and a product out."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from astropy.io import fits

from tests.conftest import write_image
from tests.whole.stack import EMBEDDED_FIRST, Stack, running


@pytest.fixture(scope="module", params=EMBEDDED_FIRST)
def stack(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """The shared service, whose products may be of other tests too; or one on Redis and PostgreSQL."""
    if request.param == "embedded":
        yield request.getfixturevalue("open_stack")
    else:
        with running(request.param, tmp_path_factory.mktemp("stack")) as stack:
            yield stack


def test_an_image_in_and_a_product_out(stack: Stack, tmp_path: Path, psf_file: Path) -> None:
    write_image(tmp_path / "image.fits", OBSERVER="in and out")
    psf_id = stack.client.upload_psf(psf_file)["id"]
    output, picture = tmp_path / "out.fits", tmp_path / "out.png"
    product = stack.client.deconvolve(tmp_path / "image.fits", output, psf_id=psf_id, preview=picture)
    with fits.open(output, checksum=True) as hdus:
        assert hdus[0].header["PSFID"] == psf_id
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = stack.client.deconvolve(tmp_path / "image.fits", psf_id=psf_id)
    assert again == product
    assert [one["id"] for one in stack.client.products()].count(product["id"]) == 1


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
