"""Files that were lost or changed on the disk: nobody gets them as good, and what can be made again is."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from fastapi.testclient import TestClient

from service.cli.main import main
from service.client.errors import ServiceError
from service.client.http import Client
from tests.service.conftest import upload
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow
from workers.files.store import Store
from workers.settings import Settings
from workers.tasks import deconvolve


@pytest.fixture
def store(settings: Settings) -> Store:
    return Store(settings.data_dir)


@pytest.fixture
def catalogue(settings: Settings, api: TestClient) -> Iterator[Catalogue]:
    catalogue = Catalogue(settings.catalogue_url)
    yield catalogue
    catalogue.close()


@pytest.fixture
def request_body(api: TestClient, image_file: Path, psf_file: Path) -> dict[str, Any]:
    image, psf = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    method = {"name": "richardson-lucy", "steps": 2}
    return {"kind": "deconvolve", "parameters": {"image_id": image, "psf_id": psf, "method": method}}


@pytest.fixture
def product(api: TestClient, run_jobs: Callable[[], None], request_body: dict[str, Any]) -> dict[str, Any]:
    """A product that was just made."""
    return done(api, run_jobs, request_body)


def done(api: TestClient, run_jobs: Callable[[], None], body: dict[str, Any]) -> dict[str, Any]:
    job = api.post("/v1/jobs", json=body).json()
    run_jobs()
    found = api.get(f"/v1/jobs/{job['id']}").json()
    assert found["phase"] == "COMPLETED", found["error"]
    made: dict[str, Any] = api.get(found["result"]).json()
    return made


def code_of(answer: httpx.Response) -> str:
    return str(answer.json()["type"]).removeprefix("urn:heliopsf:")


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def zero(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def test_a_good_file_declares_its_hash(api: TestClient, product: dict[str, Any]) -> None:
    answer = api.get(product["file"])
    content = base64.b64encode(hashlib.sha256(answer.content).digest()).decode()
    assert answer.status_code == 200 and answer.headers["repr-digest"] == f"sha-256=:{content}:"


@pytest.mark.parametrize(("spoil", "code"), [(halve, "file-damaged"), (Path.unlink, "file-lost")])
def test_a_product_that_is_not_whole_is_not_sent(
    api: TestClient,
    product: dict[str, Any],
    store: Store,
    catalogue: Catalogue,
    spoil: Callable[[Path], None],
    code: str,
) -> None:
    row = catalogue.get(ProductRow, product["id"], DEFAULT_OWNER)
    assert row is not None
    for part, digest in (("file", row.file_sha256), ("preview", row.preview_sha256)):
        spoil(store.path(digest))
        answer = api.get(product[part])
        assert (answer.status_code, code_of(answer)) == (410, code)
        assert "submit the same request again" in answer.json()["detail"]
    store.path(row.preview_sha256).write_bytes(bytes(1000))  # a picture's size is not recorded
    assert code_of(api.get(product["preview"])) == "file-damaged"


@pytest.mark.parametrize("spoil", [halve, Path.unlink])
def test_the_same_request_makes_a_lost_product_again(
    api: TestClient,
    run_jobs: Callable[[], None],
    request_body: dict[str, Any],
    product: dict[str, Any],
    store: Store,
    spoil: Callable[[Path], None],
) -> None:
    before = api.get(product["file"]).content
    spoil(store.path(product["sha256"]))
    answer = api.post("/v1/jobs", json=request_body)
    assert (answer.status_code, answer.json()["phase"]) == (202, "QUEUED")
    again = done(api, run_jobs, request_body)
    assert again["id"] == product["id"]
    found = api.get(again["file"])
    assert found.status_code == 200 and len(found.content) == len(before)
    assert hashlib.sha256(found.content).hexdigest() == again["sha256"]


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


@pytest.mark.parametrize(
    ("which", "spoil", "code"),
    [
        ("image_id", zero, "file-damaged"),
        ("image_id", Path.unlink, "file-lost"),
        ("psf_id", zero, "file-damaged"),
    ],
)
def test_a_changed_upload_is_refused_until_it_is_uploaded_again(
    api: TestClient,
    run_jobs: Callable[[], None],
    request_body: dict[str, Any],
    store: Store,
    image_file: Path,
    psf_file: Path,
    which: str,
    spoil: Callable[[Path], None],
    code: str,
) -> None:
    deconvolve._prepared.cache_clear()  # a worker may still have the PSF in its memory
    digest = request_body["parameters"][which]
    spoil(store.path(digest))
    job = api.post("/v1/jobs", json=request_body).json()
    run_jobs()
    error = api.get(f"/v1/jobs/{job['id']}").json()["error"]
    assert (error["fault"], error["code"]) == ("user", code)
    assert digest in error["message"] and "upload it again" in error["message"]
    upload(api, image_file)
    upload(api, psf_file, "/v1/psfs")
    done(api, run_jobs, request_body)


def store_check(settings: Settings, *options: str) -> tuple[int, str]:
    answer = CliRunner().invoke(main, ["store", "check", "--data", str(settings.data_dir), *options])
    return answer.exit_code, answer.output


def test_store_check_finds_lost_and_damaged_files_and_has_them_made_again(
    api: TestClient,
    run_jobs: Callable[[], None],
    settings: Settings,
    store: Store,
    product: dict[str, Any],
    request_body: dict[str, Any],
) -> None:
    assert store_check(settings) == (0, "all files are good\n")
    zero(store.path(product["sha256"]))
    store.path(request_body["parameters"]["image_id"]).unlink()
    status, text = store_check(settings, "--sizes")
    assert status == 1 and "image" in text and "product" not in text, "its size is right"
    status, text = store_check(settings)
    lines = text.splitlines()
    assert status == 1 and len(lines) == 3
    assert lines[0].split() == [
        "image", DEFAULT_OWNER, request_body["parameters"]["image_id"], "lost", request_body["parameters"]["image_id"],
    ]  # fmt: skip
    assert lines[1].split()[:3] == ["product", DEFAULT_OWNER, product["id"]]
    assert f"damaged {product['sha256']}" in lines[1] and "--repair" in lines[2]
    status, text = store_check(settings, "--repair")
    assert "must upload the file again" in text
    assert "makes it again" in text
    assert api.get(product["file"]).status_code == 410, "until the job has run, the damaged file is not sent"


def test_a_repaired_product_is_good_again(
    api: TestClient, run_jobs: Callable[[], None], settings: Settings, store: Store, product: dict[str, Any]
) -> None:
    zero(store.path(product["sha256"]))
    assert store_check(settings, "--repair")[0] == 1
    run_jobs()
    assert store_check(settings) == (0, "all files are good\n")
    assert api.get(product["file"]).status_code == 200
    assert len(list((settings.data_dir / "damaged").iterdir())) == 1, (
        "what was damaged is kept for the operator"
    )


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
