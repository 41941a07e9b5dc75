"""The commands for backups in docs/operating.md: a restored service serves the same products."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest
from click.testing import CliRunner
from fastapi.testclient import TestClient

from service.app import create_app
from service.cli.main import main
from tests.conftest import write_image, write_psf
from tests.service.conftest import upload
from tests.whole.stack import Missing, postgres_database
from tests.workers.jobs import run_job
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.contract.jobs import Phase
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings

DOCS = (Path(__file__).parents[2] / "docs" / "operating.md").read_text("utf-8")


@dataclass
class Places:
    """Where the service is, and where it is restored."""

    kind: str
    before: Settings
    after: Settings


@pytest.fixture(params=["SQLite", "PostgreSQL"])
def places(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Places]:
    urls: list[str | None] = [None, None]
    with ExitStack() as resources:
        if request.param == "PostgreSQL":
            if shutil.which("pg_dump") is None:
                pytest.skip("pg_dump is not installed (Debian: the package postgresql-client)")
            try:
                urls = [resources.enter_context(postgres_database()) for _ in range(2)]
            except Missing as missing:
                pytest.skip(str(missing))
        before, after = (
            Settings(
                data_dir=tmp_path / name,
                database_url=url,
                broker_url="filesystem://",
                allowed_hosts="testserver",
            )
            for name, url in zip(("before", "after"), urls, strict=True)
        )
        yield Places(request.param, before, after)


def environment(settings: Settings, backup: Path) -> dict[str, str]:
    """What an operator exports before the commands."""
    url = {} if settings.database_url is None else {"HELIOPSF_DATABASE_URL": settings.database_url}
    return os.environ | {"HELIOPSF_DATA_DIR": str(settings.data_dir), "BACKUP": str(backup)} | url


def commands(title: str) -> list[str]:
    """The commands of the block of the page that begins with this comment, one for each line of the shell."""
    (block,) = re.findall(rf"```bash\n# {re.escape(title)}\n(.*?)```", DOCS, flags=re.S)
    lines: list[str] = block.replace("\\\n", " ").strip().splitlines()
    return lines


def shell(command: str, settings: Settings, backup: Path) -> None:
    """Run a command as an operator does, with the Python of the tests as python3."""
    path = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-c", command], env=environment(settings, backup) | path, capture_output=True, text=True
    )
    assert done.returncode == 0, (command, done.stderr)


def test_a_restored_service_serves_the_same_product(places: Places, tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits")
    write_image(tmp_path / "late.fits", seed=2)
    write_psf(tmp_path / "psf.fits")
    backup = tmp_path / "backup"
    backup.mkdir()
    with TestClient(create_app(places.before)) as api:
        parameters = {
            "image_id": upload(api, tmp_path / "image.fits"),
            "psf_id": upload(api, tmp_path / "psf.fits", "/v1/psfs"),
            "method": {"name": "richardson-lucy", "steps": 2},
        }
        body = {"kind": "deconvolve", "parameters": parameters}
        job = api.post("/v1/jobs", json=body).json()["id"]
        run_jobs(places.before)
        product = api.get(f"/v1/jobs/{job}").json()["result"]
        served = api.get(f"{product}/file")
        assert served.status_code == 200
        database, *files = commands(f"backup, {places.kind}")
        shell(database, places.before, backup)
        upload(api, tmp_path / "late.fits")  # the service runs while the backup is made
        for command in files:
            shell(command, places.before, backup)
    shutil.rmtree(places.before.data_dir)
    for command in commands(f"restore, {places.kind}"):
        shell(command, places.after, backup)
    checked = CliRunner(env=environment(places.after, backup)).invoke(main, ["store", "check"])
    assert checked.exit_code == 0, checked.output
    with TestClient(create_app(places.after)) as api:
        again = api.get(f"{product}/file")
        assert again.content == served.content
        assert again.headers["Repr-Digest"] == served.headers["Repr-Digest"]
        digest = hashlib.sha256(again.content).hexdigest()
        assert digest == api.get(product).json()["sha256"]
        assert api.post("/v1/jobs", json=body).json()["id"] == job, "nothing is done twice after a restore"
        assert len(api.get("/v1/images").json()["items"]) == 1, "the late upload is not in the database"
        late = hashlib.sha256((tmp_path / "late.fits").read_bytes()).hexdigest()
        assert Store(places.after.data_dir).size(late) is not None, "its file is surplus"


def run_jobs(settings: Settings) -> None:
    """Run all queued jobs, as a worker does."""
    catalogue = Catalogue(settings.catalogue_url)
    runner = Runner(settings, catalogue, Store(settings.data_dir))
    for row in catalogue.page(JobRow, owner=DEFAULT_OWNER, limit=10, phase=Phase.QUEUED):
        run_job(runner, catalogue, row.id)
    catalogue.close()
