"""What stays of an upload: a bounded row, and a file only if its row was accepted."""

from __future__ import annotations

import gzip
import io
import os
import random
import sqlite3
import string
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psycopg
import pytest
from astropy.io import fits
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError

from tests.conftest import write_image
from tests.service.conftest import refusal, upload
from tests.service.keyed import keyed
from tests.whole.stack import Missing, postgres_database
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.owners import ROW_BYTES
from workers.catalogue.tables import ImageRow
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


@pytest.fixture(params=["sqlite", "postgresql"])
def any_database(request: pytest.FixtureRequest, settings: Settings) -> Iterator[Settings]:
    if request.param == "sqlite":
        yield settings
        return
    try:
        with postgres_database() as url:
            yield settings.model_copy(update={"database_url": url})
    except Missing as missing:
        pytest.skip(str(missing))


def test_a_header_with_long_texts_is_cut(any_database: Settings) -> None:
    long = random_text(9000)
    content = psf_with(PSFNAME=long, PSFVERS=long, INSTRUME=long, TELESCOP=long, BUNIT=long)
    with keyed(any_database) as service:
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


def test_rows_count_in_the_quota(settings: Settings, image_file: Path) -> None:
    """Files of some hundred bytes, compressed: their rows take more room than they do."""
    left, sent = 20 * 2**10, 0
    with keyed(settings, quota_mib=1) as service:
        ann = service.client("ann")
        image = service.catalogue.get(ImageRow, upload(ann, image_file), "ann")
        assert image is not None
        used = service.catalogue.owners.usage("ann", 1).used_bytes
        row = ImageRow(owner="ann", id="b" * 64, created_at=1.0, bytes=2**20 - used - left, summary={})
        service.catalogue.add(row)
        for number in range(left // ROW_BYTES):
            header = fits.Header(
                {"SIMPLE": True, "BITPIX": 8, "NAXIS": 2, "NAXIS1": 1, "NAXIS2": 1, "N": number}
            )
            content = gzip.compress(header.tostring().encode() + bytes(2880), mtime=0)
            assert len(content) < 500
            answer = ann.post("/v1/images", content=content)
            if answer.status_code != 201:
                break
            sent += 1
        refusal(answer, 413, "quota-exceeded")
        assert 3 < sent < left / ROW_BYTES
        assert service.catalogue.owners.recount() == []


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
