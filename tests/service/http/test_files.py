"""Files: what stays of an upload, and files that were lost or changed on the disk, which nobody gets as good."""

from __future__ import annotations

import base64
import hashlib
import io
import os
import random
import sqlite3
import string
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psycopg
import pytest
from astropy.io import fits
from click.testing import CliRunner
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError

from service.cli.main import main
from service.client.errors import ServiceError
from service.client.http import Client
from tests.conftest import write_image, write_psf
from tests.service.conftest import job_after, refusal, result_of, upload
from tests.service.keyed import keyed
from tests.whole.stack import Missing, postgres_database
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow
from workers.files.store import Store
from workers.settings import Settings


def blobs(settings: Settings) -> list[str]:
    return sorted(path.name for path in (settings.data_dir / "blobs").rglob("*") if path.is_file())


def psf_with(**cards: str) -> bytes:
    """A small PSF with these texts, however long, in its header."""
    y, x = np.indices((64, 64)) - 32
    kernel = np.exp(-0.5 * (x**2 + y**2)).astype("f4")
    file = io.BytesIO()
    fits.PrimaryHDU(kernel / kernel.sum(), fits.Header(cards)).writeto(file)
    return file.getvalue()


def random_text(length: int) -> str:
    """A text that a database cannot compress."""
    return "".join(random.Random(1).choices(string.ascii_letters + string.digits, k=length))


def test_a_header_with_long_texts_is_cut(settings: Settings) -> None:
    """PostgreSQL refuses a text that is too long for its index; on SQLite if there is no PostgreSQL."""
    long = random_text(9000)
    content = psf_with(PSFNAME=long, PSFVERS=long, INSTRUME=long, TELESCOP=long, BUNIT=long)
    with ExitStack() as held:
        with suppress(Missing):
            url = held.enter_context(postgres_database())
            settings = settings.model_copy(update={"database_url": url})
        service = held.enter_context(keyed(settings))
        ann = service.client("ann")
        psf = ann.post("/v1/psfs", content=content)
        assert psf.status_code == 201, psf.text
        assert psf.json()["name"] == long[:80] and psf.json()["version"] == long[:40]
        image = ann.post("/v1/images", content=content)
        assert image.status_code == 201 and image.json()["header"]["telescop"] == long[:200]
        assert len(image.content) < 3000
        assert ann.get(f"/v1/psfs?name={long[:80]}").json()["items"][0]["id"] == psf.json()["id"]


def test_the_file_of_a_row_that_fails_goes(
    api: TestClient, settings: Settings, image_file: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OperationalError("INSERT", {}, Exception("the disk is on fire"))

    def fails(file: Path, where: str) -> None:
        with monkeypatch.context() as patched:
            patched.setattr(Catalogue, "add", fail)
            assert api.post(where, content=file.read_bytes()).status_code == 503

    there: list[str] = []
    for file, where in ((image_file, "/v1/images"), (psf_file, "/v1/psfs")):
        fails(file, where)
        assert blobs(settings) == sorted(there), where
        there.append(upload(api, file, where))
        fails(file, where)
        assert blobs(settings) == sorted(there), "it was there before"


def test_an_upload_that_does_not_fit_leaves_no_file(settings: Settings, tmp_path: Path) -> None:
    """It fits when it is announced; another upload takes the room before it is complete."""
    write_image(tmp_path / "a.fits", shape=(300, 500))
    content = (tmp_path / "a.fits").read_bytes()
    with keyed(settings, quota_mib=1) as service:
        ann = service.client("ann")

        def body() -> Iterator[bytes]:
            yield content[:5760]
            write_image(tmp_path / "b.fits", shape=(300, 500), seed=2)
            upload(service.client("ann"), tmp_path / "b.fits")
            yield content[5760:]

        headers = {"Content-Length": str(len(content))}
        refused = ann.post("/v1/images", content=body(), headers=headers)
        refusal(refused, 413, "quota-exceeded")
        assert blobs(settings) == [one["id"] for one in ann.get("/v1/images").json()["items"]]


# A full disk ----------------------------------------------------------------------------------------


def test_a_full_disk_is_said_to_be_full(
    shared_api: TestClient, image_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """/dev/full answers every write as a full disk does."""
    state = shared_api.app.state.heliopsf

    class Full:
        def __enter__(self) -> Path:
            return Path("/dev/full")

        def __exit__(self, *_: object) -> None:
            return None

    monkeypatch.setattr(state.store, "temporary", Full)
    for where in ("/v1/images", "/v1/psfs"):
        answer = shared_api.post(where, content=image_file.read_bytes())
        assert "disk is full" in refusal(answer, 507, "storage-full")
        assert str(state.settings.data_dir) not in answer.text


def full_sqlite() -> Exception:
    """The error of an SQLite database that may not grow."""
    connection = sqlite3.connect(":memory:")
    connection.execute("PRAGMA max_page_count = 2")
    connection.execute("CREATE TABLE t (x)")
    with pytest.raises(sqlite3.OperationalError) as error:
        connection.execute("INSERT INTO t VALUES (zeroblob(100000))")
    connection.close()
    return error.value


def test_errors_of_the_system_behind_the_database(
    shared_api: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    for error, status, code in (
        (OperationalError("INSERT", {}, full_sqlite()), 507, "storage-full"),
        (OperationalError("INSERT", {}, psycopg.errors.DiskFull()), 507, "storage-full"),
        (OSError(5, os.strerror(5)), 500, "internal-error"),
    ):

        def fail(*_: object, error: Exception = error, **__: object) -> None:
            raise error

        monkeypatch.setattr(Catalogue, "page", fail)
        refusal(shared_api.get("/v1/images"), status, code)


def test_little_room_is_refused_before_it_is_used_up(
    api: TestClient, settings: Settings, image_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = settings.min_free_mib * 2**20 + 1000
    monkeypatch.setattr(checks, "free_bytes", lambda _folder: free)
    content = image_file.read_bytes()
    for body in (content, iter([content[:2880], content[2880:]])):
        answer = api.post("/v1/images", content=body)
        assert "ask the operator" in refusal(answer, 507, "storage-full")
    assert blobs(settings) == []
    assert api.get("/readyz").json()["parts"]["storage"] == "ok"
    free = settings.min_free_mib * 2**20 - 1
    ready = api.get("/readyz")
    assert ready.status_code == 503 and "free space" in ready.json()["parts"]["storage"]
    job = api.post("/v1/jobs", json={"kind": "psf-build", "parameters": {"instrument": "hri_euv"}})
    assert job.status_code == 507


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
    for spoil, code in ((halve, "file-damaged"), (Path.unlink, "file-lost")):
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
    for which, spoil, code in (("psf_id", zero, "file-damaged"), ("image_id", Path.unlink, "file-lost")):
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
