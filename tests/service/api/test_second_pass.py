"""A product or a PSF that is sent as an image is refused, unless the request allows it."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner
from fastapi.testclient import TestClient
from httpx import Response
from sqlalchemy import update

from psfcore.fits.psfs import write_psf
from service.cli.main import main
from tests.psfcore.conftest import make_psf
from tests.service.conftest import execute, job_after, refusal, result_of, upload, work_through_bulks
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow
from workers.settings import Settings

FEW = {"method": {"name": "richardson-lucy", "steps": 1}}


def ask(api: TestClient, image_id: str, psf_id: str, **more: Any) -> Response:
    parameters = {"image_id": image_id, "psf_id": psf_id, **FEW, **more}
    return api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters})


@pytest.fixture
def psf_id(api: TestClient, psf_file: Path) -> str:
    return upload(api, psf_file, "/v1/psfs")


@pytest.fixture
def product_file(
    api: TestClient, run_jobs: Callable[[], None], image_file: Path, psf_id: str, tmp_path: Path
) -> Path:
    """The product of an image."""
    image_id = upload(api, image_file)
    product = result_of(api, run_jobs, "deconvolve", image_id=image_id, psf_id=psf_id, **FEW)
    path = tmp_path / "product.fits"
    path.write_bytes(api.get(product["file"]).content)
    return path


def test_a_product_is_deconvolved_again_only_if_told(
    api: TestClient, catalogue: Catalogue, run_jobs: Callable[[], None], product_file: Path, psf_id: str
) -> None:
    image_id = upload(api, product_file)
    assert "again = true" in refusal(ask(api, image_id, psf_id), 409, "already-deconvolved")
    product = result_of(api, run_jobs, "deconvolve", image_id=image_id, psf_id=psf_id, again=True, **FEW)
    with fits.open(io.BytesIO(api.get(product["file"]).content)) as hdus:
        header = hdus[0].header
    assert fits.getheader(product_file)["DCNVPASS"] == 1 and header["DCNVPASS"] == 2
    assert any("deconvolution number 2" in line for line in header["HISTORY"])

    # The row of an image uploaded to an earlier version does not say what it is: the worker refuses it.
    row = catalogue.get(ImageRow, image_id, "local")
    assert row is not None
    summary = {name: value for name, value in row.summary.items() if name != "content"}
    execute(catalogue, update(ImageRow).where(ImageRow.id == image_id).values(summary=summary))
    job = job_after(api, run_jobs, "deconvolve", image_id=image_id, psf_id=psf_id, **FEW)
    assert job["error"]["code"] == "already-deconvolved"


def test_a_psf_is_no_image(api: TestClient, psf_id: str, tmp_path: Path) -> None:
    kernel = np.zeros((33, 33))
    kernel[16, 16] = 1.0
    write_psf(tmp_path / "own.fits", make_psf(kernel))
    image_id = upload(api, tmp_path / "own.fits")
    refusal(ask(api, image_id, psf_id), 409, "psf-as-image")
    assert ask(api, image_id, psf_id, again=True).status_code == 202


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    (tmp_path / "archive").mkdir()
    return tmp_path / "archive"


@pytest.fixture
def settings(settings: Settings, archive: Path) -> Settings:
    return settings.model_copy(update={"bulk_roots": str(archive)})


def test_a_bulk_run_sets_products_apart_and_goes_on(
    api: TestClient, settings: Settings, archive: Path, product_file: Path, image_file: Path, psf_id: str
) -> None:
    product_file.rename(archive / "a.fits")
    image_file.rename(archive / "b.fits")
    request = {"files": [{"glob": f"{archive}/*.fits"}], "psf_id": psf_id, "parameters": FEW}

    def done(**parameters: Any) -> dict[str, Any]:
        asked = api.post("/v1/bulk", json=request | {"parameters": FEW | parameters})
        assert asked.status_code == 202, asked.text
        work_through_bulks(settings)
        return dict(api.get(f"/v1/bulk/{asked.json()['id']}").json())

    bulk = done()
    assert (bulk["phase"], bulk["images"]["done"], bulk["images"]["failed"]) == ("COMPLETED", 1, 1)
    (failure,) = api.get(bulk["failures"]).json()["items"]
    assert failure["source"].endswith("a.fits") and failure["error"]["code"] == "already-deconvolved"
    assert done(again=True)["images"]["failed"] == 0


def test_the_command_refuses_a_product_too(product_file: Path, psf_file: Path, tmp_path: Path) -> None:
    command = ["deconvolve", str(product_file), "--psf", str(psf_file), "--local", "--steps", "1"]
    output = ["-o", str(tmp_path / "twice.fits")]
    told = CliRunner().invoke(main, [*command, *output])
    assert told.exit_code == 1 and "--again" in told.output, told.output
    assert not (tmp_path / "twice.fits").exists()
    assert CliRunner().invoke(main, [*command, *output, "--again"]).exit_code == 0
    assert fits.getheader(tmp_path / "twice.fits")["DCNVPASS"] == 2
