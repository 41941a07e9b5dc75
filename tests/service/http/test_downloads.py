"""Files that were lost or changed on the disk: nobody gets them as good, and what can be made again is."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from fastapi.testclient import TestClient

from service.cli.main import main
from service.client.errors import ServiceError
from service.client.http import Client
from tests.conftest import write_psf
from tests.service.conftest import job_after, refusal, result_of, upload
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow
from workers.files.store import Store
from workers.settings import Settings


@pytest.fixture
def store(settings: Settings) -> Store:
    return Store(settings.data_dir)


@pytest.fixture
def parameters(api: TestClient, image_file: Path, psf_file: Path) -> dict[str, Any]:
    image, psf = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    return {"image_id": image, "psf_id": psf, "method": {"name": "richardson-lucy", "steps": 1}}


@pytest.fixture
def product(api: TestClient, run_jobs: Callable[[], None], parameters: dict[str, Any]) -> dict[str, Any]:
    """A product that was just made."""
    return result_of(api, run_jobs, "deconvolve", **parameters)


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def zero(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def test_a_product_that_is_not_whole_is_not_sent_and_is_made_again(
    api: TestClient,
    run_jobs: Callable[[], None],
    parameters: dict[str, Any],
    product: dict[str, Any],
    store: Store,
    catalogue: Catalogue,
) -> None:
    spoilers: tuple[tuple[Callable[[Path], None], str], ...] = (
        (halve, "file-damaged"),
        (Path.unlink, "file-lost"),
    )
    for spoil, code in spoilers:
        good = api.get(product["file"])
        content = base64.b64encode(hashlib.sha256(good.content).digest()).decode()
        assert good.status_code == 200 and good.headers["repr-digest"] == f"sha-256=:{content}:"
        row = catalogue.get(ProductRow, product["id"], DEFAULT_OWNER)
        assert row is not None
        for part, digest in (("file", row.file_sha256), ("preview", row.preview_sha256)):
            spoil(store.path(digest))
            assert "submit the same request again" in refusal(api.get(product[part]), 410, code)
        again = result_of(api, run_jobs, "deconvolve", **parameters)
        assert again["id"] == product["id"]
        file = api.get(again["file"])
        assert file.status_code == 200 and len(file.content) == len(good.content)
        assert hashlib.sha256(file.content).hexdigest() == again["sha256"]
    row = catalogue.get(ProductRow, product["id"], DEFAULT_OWNER)
    assert row is not None
    store.path(row.preview_sha256).write_bytes(bytes(1000))  # a picture's size is not recorded
    refusal(api.get(product["preview"]), 410, "file-damaged")


def test_the_client_refuses_what_has_another_hash(
    tmp_path: Path, api: TestClient, product: dict[str, Any], store: Store
) -> None:
    zero(store.path(product["sha256"]))
    answer = api.get(product["file"])
    assert answer.status_code == 200, "the server sees only the size"

    def served(_request: httpx.Request) -> httpx.Response:
        return httpx.Response(200, headers=answer.headers, content=answer.content)

    client = Client("http://test", transport=httpx.MockTransport(served))
    with client, pytest.raises(ServiceError) as refused:
        client.download("/v1/products/x/file", tmp_path / "product.fits")
    assert refused.value.code == "download-damaged" and product["sha256"] in str(refused.value)
    assert list(tmp_path.glob("product*")) == []


def test_a_changed_upload_is_refused_until_it_is_uploaded_again(
    api: TestClient,
    run_jobs: Callable[[], None],
    parameters: dict[str, Any],
    store: Store,
    image_file: Path,
    psf_file: Path,
) -> None:
    psf_file.unlink()
    write_psf(psf_file, size=40)  # as no other test has it: a worker keeps PSFs in its memory
    parameters["psf_id"] = upload(api, psf_file, "/v1/psfs")
    spoilers: tuple[tuple[str, Callable[[Path], None], str], ...] = (
        ("psf_id", zero, "file-damaged"),
        ("image_id", zero, "file-damaged"),
        ("image_id", Path.unlink, "file-lost"),
    )
    for which, spoil, code in spoilers:
        spoil(store.path(parameters[which]))
        error = job_after(api, run_jobs, "deconvolve", **parameters)["error"]
        assert (error["fault"], error["code"]) == ("user", code)
        assert parameters[which] in error["message"] and "upload it again" in error["message"]
        upload(api, image_file)
        upload(api, psf_file, "/v1/psfs")
    result_of(api, run_jobs, "deconvolve", **parameters)


def store_check(settings: Settings, *options: str) -> tuple[int, str]:
    answer = CliRunner().invoke(main, ["store", "check", "--data", str(settings.data_dir), *options])
    return answer.exit_code, answer.output


def test_store_check_finds_lost_and_damaged_files_and_has_them_made_again(
    api: TestClient,
    run_jobs: Callable[[], None],
    settings: Settings,
    store: Store,
    product: dict[str, Any],
    parameters: dict[str, Any],
    image_file: Path,
) -> None:
    image = parameters["image_id"]
    assert store_check(settings) == (0, "all files are good\n")
    zero(store.path(product["sha256"]))
    store.path(image).unlink()
    status, text = store_check(settings, "--sizes")
    assert status == 1 and "image" in text and "product" not in text, "its size is right"
    status, text = store_check(settings)
    lines = text.splitlines()
    assert status == 1 and len(lines) == 3
    assert lines[0].split() == ["image", DEFAULT_OWNER, image, "lost", image]
    assert lines[1].split()[:3] == ["product", DEFAULT_OWNER, product["id"]]
    assert f"damaged {product['sha256']}" in lines[1] and "--repair" in lines[2]
    status, text = store_check(settings, "--repair")
    assert status == 1 and "must upload the file again" in text and "makes it again" in text
    assert api.get(product["file"]).status_code == 410, "until the job has run, the damaged file is not sent"
    upload(api, image_file)
    run_jobs()
    assert store_check(settings) == (0, "all files are good\n")
    assert api.get(product["file"]).status_code == 200
    damaged = list((settings.data_dir / "damaged").iterdir())
    assert len(damaged) == 1, "what was damaged is kept for the operator"


def test_a_product_whose_job_was_deleted_is_made_again(
    api: TestClient,
    run_jobs: Callable[[], None],
    settings: Settings,
    store: Store,
    catalogue: Catalogue,
    product: dict[str, Any],
) -> None:
    assert catalogue.uws.destroy(product["details"]["job_id"])
    store.path(product["sha256"]).unlink()
    assert "makes it again" in store_check(settings, "--repair")[1]
    run_jobs()
    assert api.get(product["file"]).status_code == 200
