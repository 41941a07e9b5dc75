"""A full disk and a damaged database: clear errors, nothing stays behind, and work can be submitted again."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from fastapi.testclient import TestClient

from psfcore.fits import hdus
from service.cli import doctor
from tests.conftest import write_image
from tests.service.conftest import job_after, refusal, result_of, upload, work_through_bulks
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ProductRow
from workers.files import archive as archive_files
from workers.files import store as stores
from workers.files.store import is_disk_full
from workers.settings import Settings


@pytest.fixture
def settings(settings: Settings, tmp_path: Path) -> Settings:
    return settings.model_copy(update={"bulk_output_roots": str(tmp_path / "out")})


def full(number: int = errno.ENOSPC) -> OSError:
    return OSError(number, os.strerror(number))


def the_rename(patched: pytest.MonkeyPatch) -> None:
    def replace(source: Path, target: Path) -> None:
        raise full()

    patched.setattr(stores.os, "replace", replace)


def the_flush(patched: pytest.MonkeyPatch) -> None:
    """The quota of the file system, which the system tells when the content is forced to the disk."""

    def sync(path: Path) -> None:
        raise full(errno.EDQUOT)

    patched.setattr(stores, "sync", sync)


def the_content(patched: pytest.MonkeyPatch) -> None:
    """astropy and numpy lose the number of the error when an array does not fit on the disk."""

    def writeto(self: object, file: Any, **_: object) -> None:
        file.write(b"SIMPLE")
        raise OSError("160000 requested and 100144 written")

    def probe(target: Path) -> None:
        assert target.exists(), "the disk is still full"
        raise full()

    patched.setattr(fits.HDUList, "writeto", writeto)
    patched.setattr(hdus, "probe", probe)


def test_a_job_that_finds_the_disk_full_says_so_and_can_be_submitted_again(
    api: TestClient,
    settings: Settings,
    catalogue: Catalogue,
    run_jobs: Callable[[], None],
    image_file: Path,
    psf_file: Path,
) -> None:
    parameters = {"image_id": upload(api, image_file), "psf_id": upload(api, psf_file, "/v1/psfs")}
    parameters |= {"method": {"name": "richardson-lucy", "steps": 1}}
    jobs = set()
    for fill in (the_rename, the_flush, the_content):
        with pytest.MonkeyPatch.context() as patched:
            fill(patched)
            patched.setattr(checks, "free_bytes", lambda _folder: settings.min_free_mib * 2**20 + 1)
            job = job_after(api, run_jobs, "deconvolve", **parameters)
            patched.setattr(checks, "free_bytes", lambda _folder: 0)
            ready = api.get("/readyz")
        jobs.add(job["id"])
        assert job["phase"] == "ERROR" and job["attempt"] == 1
        assert (job["error"]["code"], job["error"]["fault"]) == ("storage-full", "transient")
        assert "ask the operator to make room" in job["error"]["message"]
        assert ready.status_code == 503 and "0 MiB of free space" in ready.json()["parts"]["storage"]
        assert list((settings.data_dir / "tmp").iterdir()) == []
        assert catalogue.page(ProductRow, owner="local", limit=1) == []
        catalogue.check_pages()
    assert len(jobs) == 3
    product = result_of(api, run_jobs, "deconvolve", **parameters)
    assert api.get(product["file"]).status_code == 200


def test_a_bulk_run_that_finds_the_disk_full_stops_and_goes_on_with_room(
    api: TestClient, tmp_path: Path, settings: Settings, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also the disk of its output folder: it is full for every image."""
    images = []
    for seed in range(3):
        write_image(tmp_path / f"{seed}.fits", seed=seed)
        images.append(upload(api, tmp_path / f"{seed}.fits"))
    body = {
        "images": images,
        "psf_id": upload(api, psf_file, "/v1/psfs"),
        "parameters": {"method": {"name": "richardson-lucy", "steps": 1}},
        "output": {"folder": str(tmp_path / "out")},
    }
    here = f"/v1/bulk/{api.post('/v1/bulk', json=body).json()['id']}"
    put = archive_files.put
    written: list[Path] = []

    def put_one(source: Path, target: Path, *given: Any, **options: Any) -> None:
        written.append(target)
        if len(written) > 1:
            raise full()
        put(source, target, *given, **options)

    with monkeypatch.context() as patched:
        patched.setattr(archive_files, "put", put_one)
        work_through_bulks(settings)
        stopped = api.get(here).json()
    assert (stopped["phase"], stopped["error"]["code"]) == ("ERROR", "storage-full")
    assert (stopped["images"]["done"], stopped["images"]["failed"]) == (1, 0)
    assert len(written) == 2, "no further image is deconvolved for nothing"
    assert api.post(f"{here}/resume").status_code == 200
    work_through_bulks(settings)
    finished = api.get(here).json()
    assert (finished["phase"], finished["images"]["done"]) == ("COMPLETED", 3)


def test_a_full_disk_is_known_by_the_error_of_the_system() -> None:
    assert is_disk_full(full()) and is_disk_full(full(errno.EDQUOT)) and not is_disk_full(full(errno.EIO))
    for wrapper, known in ((OSError("not enough space"), True), (ValueError("something else"), False)):
        wrapper.__cause__ = full()
        assert is_disk_full(wrapper) == known


PAGE_BYTES = 4096


def zero_a_page(file: Path) -> None:
    """Zero one page, as a bad disk does; the first pages, with the header and the list of tables, stay good."""
    content = bytearray(file.read_bytes())
    pages = len(content) // PAGE_BYTES
    place = PAGE_BYTES * (pages // 2)
    content[place : place + PAGE_BYTES] = bytes(PAGE_BYTES)
    file.write_bytes(content)


def database_file(settings: Settings) -> Path:
    """The file of the database, with all changes in it."""
    file = settings.data_dir / "catalogue.sqlite"
    connection = sqlite3.connect(file)
    busy, *_ = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
    assert not busy, "a reader keeps pages of the log, which would hide the damage"
    connection.close()
    return file


def test_a_damaged_database_is_told_of(api: TestClient, settings: Settings) -> None:
    file = database_file(settings)
    assert doctor.examine(settings)["database"].state == "ok"
    zero_a_page(file)
    answer = api.get("/readyz")
    assert answer.status_code == 503 and "damaged" in answer.json()["parts"]["database"]
    database = doctor.examine(settings)["database"]
    assert database.state == "broken" and "damaged" in database.found and "restore a copy" in database.advice


def test_a_request_to_a_damaged_database_is_answered_clearly(api: TestClient, settings: Settings) -> None:
    assert "damaged" not in api.get("/readyz").text
    state = api.app.state.heliopsf
    state.reconciler.stop()  # its rounds would open connections that keep good pages in memory
    state.catalogue.close()
    file = database_file(settings)
    # The files beside it are mapped into memory: a shorter one would end this process.
    file.write_bytes(b"\0" * file.stat().st_size)
    refusal(api.get("/v1/jobs"), 503, "database-damaged")


def test_the_check_takes_a_small_share_of_the_time(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, made = [1000.0], []
    monkeypatch.setattr(checks.time, "monotonic", lambda: now[0])

    def check_pages() -> None:
        made.append(now[0])
        now[0] += 2.0  # the check of a large database

    monkeypatch.setattr(catalogue, "check_pages", check_pages)
    for _ in range(500):
        checks.database(catalogue)
        now[0] += 1.0
    assert len(made) == 3
