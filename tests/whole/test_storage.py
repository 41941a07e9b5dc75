"""The service with its files in S3: in, out, by a worker of its own, and from a server that has no copy yet."""

from __future__ import annotations

import shutil
from pathlib import Path

import httpx
import pytest
from astropy.io import fits

from tests.conftest import write_image
from tests.s3 import s3_bucket
from tests.whole import stack as stacks


@pytest.mark.slow  # tests/workers/files runs store and collection on S3
def test_files_are_kept_in_s3_and_found_there_again(
    tmp_path: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_image(tmp_path / "image.fits")
    with s3_bucket(monkeypatch) as (url, server):
        monkeypatch.setenv("HELIOPSF_STORE_URL", url)
        with stacks.embedded(tmp_path) as stack:
            assert httpx.get(f"{stack.client.server}/readyz").json()["parts"]["object store"] == "ok"
            psf_id = stack.client.upload_psf(psf_file)["id"]
            product = stack.client.deconvolve(tmp_path / "image.fits", tmp_path / "out.fits", psf_id=psf_id)
            with fits.open(tmp_path / "out.fits", checksum=True) as hdus:
                assert hdus[0].header["PSFID"] == psf_id
            assert not (stack.data / "blobs").exists()
            shutil.rmtree(stack.data / "copies")  # as on another machine
            (stack.data / "copies").mkdir()
            stack.client.download(product["file"], tmp_path / "again.fits")
            assert (tmp_path / "again.fits").read_bytes() == (tmp_path / "out.fits").read_bytes()
            server.stop()
            shutil.rmtree(stack.data / "copies")
            (stack.data / "copies").mkdir()
            away = httpx.get(f"{stack.client.server}{product['file']}", timeout=60)
            assert (away.status_code, away.json()["type"]) == (503, "urn:heliopsf:storage-away")
            assert httpx.get(f"{stack.client.server}/readyz", timeout=60).status_code == 503
