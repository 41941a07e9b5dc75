"""The application in this process, and its queued jobs run on demand."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from tests.blank_figures import blank_unless_told
from tests.shared_routes import shared_routes
from tests.tables import copied_tables
from workers.bulk.turns import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.contract.phases import Phase
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings


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


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(
        data_dir=tmp_path / "data",
        database_url=None,
        broker_url="filesystem://",
        allowed_hosts="testserver",
        max_upload_mib=2,
        max_pixels=512 * 512,
    )


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture
def run_jobs(settings: Settings, api: TestClient) -> Callable[[], None]:
    def run() -> None:
        catalogue = Catalogue(settings.catalogue_url)
        runner = Runner(settings, catalogue, Store(settings.data_dir))
        for row in catalogue.page(JobRow, owner=DEFAULT_OWNER, limit=100, phase=Phase.QUEUED):
            runner.run(row.id)
        catalogue.close()

    return run


def work_through_bulks(settings: Settings) -> None:
    """Run turns until no bulk run has work."""
    catalogue = Catalogue(settings.catalogue_url)
    runner = Runner(settings, catalogue, Store(settings.data_dir))
    while catalogue.bulks.at_work():
        keep_turns(catalogue, settings)
        for turn in catalogue.jobs.of_kind("bulk"):
            runner.run(turn.id)
    catalogue.close()


def upload(api: TestClient, path: Path, where: str = "/v1/images") -> str:
    """Upload a file raw; returns its id."""
    answer = api.post(where, content=path.read_bytes(), headers={"Content-Type": "application/fits"})
    assert answer.status_code in (200, 201), answer.text
    identity: str = answer.json()["id"]
    return identity
