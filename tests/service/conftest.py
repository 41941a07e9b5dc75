"""The application in this process, its queued jobs run on demand, and what many tests ask of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fastapi.testclient import TestClient
from httpx import Response
from sqlalchemy import Executable

from psfcore.transit.archive import pack
from service.app import create_app
from tests.blank_figures import blank_unless_told
from tests.conftest import write_image, write_psf
from tests.service.keyed import Keyed, keyed
from tests.shared_routes import shared_routes
from tests.tables import copied_tables
from tests.transit_files import write_transit
from tests.workers.jobs import run_job
from workers.bulk.runs import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, JobRow, ProductRow, PsfRow, ReportRow
from workers.contract.jobs import Phase
from workers.contract.psf_status import Pin, StatusChange
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings
from workers.versions import PsfStatus


@pytest.fixture
def one_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the clock of the rates to the fifth second of a minute: in the next minute a caller may ask again."""
    ahead = 5 - time.time() % 60
    clock = SimpleNamespace(time=lambda: time.time() + ahead)
    monkeypatch.setattr("limits.storage.memory.time", clock)


@pytest.fixture(scope="package", autouse=True)
def _tables(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with copied_tables(tmp_path_factory.mktemp("tables")):
        yield


@pytest.fixture(scope="package", autouse=True)
def _routes() -> Iterator[None]:
    with shared_routes():
        yield


@pytest.fixture(scope="module", autouse=True)
def _figures(request: pytest.FixtureRequest) -> Iterator[None]:
    yield from blank_unless_told(request)


def settings_in(folder: Path, **changes: Any) -> Settings:
    """The settings of a small service with its data in this folder."""
    usual = {"allowed_hosts": "testserver", "max_upload_mib": 2, "max_pixels": 512 * 512}
    return Settings(data_dir=folder, database_url=None, broker_url="filesystem://", **{**usual, **changes})


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return settings_in(tmp_path / "data")


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture
def catalogue(api: TestClient) -> Catalogue:
    """The catalogue of the application."""
    rows: Catalogue = api.app.state.heliopsf.catalogue
    return rows


@pytest.fixture
def service(settings: Settings) -> Iterator[Keyed]:
    """The application with the same settings, but it asks for keys."""
    with keyed(settings) as service:
        yield service


@pytest.fixture(scope="module")
def shared_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Keyed]:
    """An application with keys for a whole file of tests: each test uses owners of its own."""
    with keyed(settings_in(tmp_path_factory.mktemp("shared"))) as service:
        yield service


@pytest.fixture(scope="module")
def shared_api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """An application for a whole file of tests: no test depends on what others have left in it."""
    settings = settings_in(tmp_path_factory.mktemp("shared"))
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture
def run_jobs(settings: Settings, api: TestClient) -> Callable[[], None]:
    def run() -> None:
        catalogue = Catalogue(settings.catalogue_url)
        runner = Runner(settings, catalogue, Store(settings.data_dir))
        for row in catalogue.page(JobRow, owner=DEFAULT_OWNER, limit=100, phase=Phase.QUEUED):
            run_job(runner, catalogue, row.id)
        catalogue.close()

    return run


@pytest.fixture
def psf_id(api: TestClient, psf_file: Path) -> str:
    """The id of an uploaded PSF."""
    return upload(api, psf_file, "/v1/psfs")


@pytest.fixture
def work(settings: Settings, api: TestClient) -> Callable[[], None]:
    """Run turns until no bulk run has work."""
    return lambda: work_through_bulks(settings)


def work_through_bulks(settings: Settings) -> None:
    """Run turns until no bulk run has work."""
    catalogue = Catalogue(settings.catalogue_url)
    runner = Runner(settings, catalogue, Store(settings.data_dir))
    while catalogue.bulks.at_work():
        keep_turns(catalogue, settings)
        for turn in catalogue.jobs.of_kind("bulk"):
            run_job(runner, catalogue, turn.id)
    catalogue.close()


def upload(api: TestClient, path: Path, where: str = "/v1/images") -> str:
    """Upload a file raw; returns its id."""
    answer = api.post(where, content=path.read_bytes(), headers={"Content-Type": "application/fits"})
    assert answer.status_code in (200, 201), answer.text
    identity: str = answer.json()["id"]
    return identity


def refusal(answer: Response, status: int, code: str) -> str:
    """The detail of an answer that must be the problem with this status and code."""
    assert (answer.status_code, answer.json()["type"]) == (status, f"urn:heliopsf:{code}"), answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    return str(answer.json()["detail"])


def job_after(api: TestClient, run_jobs: Callable[[], None], kind: str, **parameters: Any) -> dict[str, Any]:
    """A job that is submitted and has ended."""
    answer = api.post("/v1/jobs", json={"kind": kind, "parameters": parameters})
    assert answer.status_code == 202, answer.text
    run_jobs()
    return dict(api.get(answer.headers["Location"]).json())


def result_of(api: TestClient, run_jobs: Callable[[], None], kind: str, **parameters: Any) -> dict[str, Any]:
    """The description of what a job makes."""
    job = job_after(api, run_jobs, kind, **parameters)
    assert job["phase"] == "COMPLETED", job["error"]
    return dict(api.get(job["result"]).json())


def execute(catalogue: Catalogue, statement: Executable) -> None:
    """Change rows in a way that no method of the catalogue does."""
    catalogue._database.change(statement)


def one_of_everything(service: Keyed, folder: Path) -> dict[str, str]:
    """Ids of ann's, one of each kind, by the names that they have in addresses. folder: for the files that are
    uploaded."""
    write_image(folder / "image.fits")
    write_psf(folder / "psf.fits")
    pack(write_transit(folder / "transit", images=3), folder / "transit.tar")
    ann, catalogue = service.client("ann"), service.catalogue
    image_id, psf_id = upload(ann, folder / "image.fits"), upload(ann, folder / "psf.fits", "/v1/psfs")
    job = {"kind": "deconvolve", "parameters": {"image_id": image_id, "psf_id": psf_id}}
    pending = ann.post("/uws/jobs", data={"KIND": "deconvolve", "image_id": image_id}, follow_redirects=False)
    store: Store = service.api.app.state.heliopsf.store
    with store.temporary() as path:
        path.write_bytes(b"kept")
        digest = store.keep(path)
    parts = ("changes_picture", "page", "report", "tables")
    about: dict[str, Any] = {
        "owner": "ann",
        "created_at": time.time(),
        "bytes": 4,
        "file_sha256": digest,
        "preview_sha256": digest,
        "details": {f"{part}_sha256": digest for part in parts},
    }
    made = {"image_id": image_id, "psf_id": psf_id, "psf_version": "1"}
    series = {"instrument": "hri_euv", "series": "hri_euv/174/total", "status": "draft", "origin": "built"}
    catalogue.add(ProductRow(**about, **made, id="1" * 64, kind="x"))
    catalogue.add(ReportRow(**about, id="2" * 64, kind="x", transit_id="3" * 64))
    catalogue.add(PsfRow(**about, **series, id="4" * 64, name="s3cret", version="1"))
    certified = StatusChange(status=PsfStatus.CERTIFIED, reason="good", version="1.0.0", channel="174")
    catalogue.psfs.change("4" * 64, "ann", certified, "ann")
    context, _ = catalogue.contexts.create("s3cret", "ann", "ann", pins=[Pin(psf_id="4" * 64)])
    bulk = ann.post("/v1/bulk", json={"images": [image_id], "psf_id": psf_id})
    tus = {"Tus-Resumable": "1.0.0", "Upload-Length": "10", "Upload-Metadata": "kind dHJhbnNpdA=="}
    open_upload = ann.post("/v1/uploads", headers=tus).headers["location"]
    return {
        "upload_id": open_upload.rpartition("/")[2],
        "bulk_id": bulk.json()["id"],
        "image_id": image_id,
        "psf_id": "4" * 64,
        "other_id": "4" * 64,
        "product_id": "1" * 64,
        "report_id": "2" * 64,
        "transit_id": upload(ann, folder / "transit.tar", "/v1/transits"),
        "context": context.id,
        "job_id": ann.post("/v1/jobs", json=job).json()["id"],
        "uws": pending.headers["location"].rpartition("/")[2],
        "name": "result",
        "instrument": "hri_euv",
        "channel": "174",
        "kind": "total",
        "key_id": next(row.id for row in catalogue.keys.all() if row.owner == "ann"),
    }
