"""A bulk run whose request is sent again, and one that is cancelled while it lists files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from fastapi.testclient import TestClient

from service.cli import bulk as cli_bulk
from service.cli.main import main
from service.client.http import Client
from tests.conftest import write_image
from tests.service.api.bulk.conftest import FEW, now, started
from tests.service.conftest import refusal
from workers.bulk.runs import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.files import archive as archive_files
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """An image, a file that is none, and a name that is not UTF-8."""
    root = tmp_path / "archive"
    root.mkdir()
    write_image(root / "a.fits")
    (root / "letter.fits").write_text("Dear archive,\n" * 300)
    write_image(root / os.fsdecode(b"Sonne\xf6.fits"))
    for number in range(20):
        (root / f"{number:02}").mkdir()
    return root


def test_failed_images_can_be_retried_after_the_identical_run_has_ended(
    api: TestClient,
    archive: Path,
    psf_id: str,
    work: Callable[[], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    request = {"files": [{"glob": f"{archive}/*.fits"}], "psf_id": psf_id, "parameters": FEW}
    first = started(api, **request)
    work()
    ended = now(api, first)
    assert (ended["phase"], ended["images"]["done"], ended["images"]["failed"]) == ("COMPLETED", 1, 2)
    failed = {line["error"]["code"]: line for line in api.get(ended["failures"]).json()["items"]}
    assert set(failed) == {"not-fits", "path-not-utf-8"} and failed["not-fits"]["attempts"] == 1
    assert failed["path-not-utf-8"]["source"] == f"{archive}/Sonne\\xf6.fits"
    assert "expected a path in UTF-8; got" in failed["path-not-utf-8"]["error"]["message"]

    second = api.post("/v1/bulk", json=request).json()
    detail = refusal(api.post(f"/v1/bulk/{first['id']}/retry"), 409, "equal-bulk-open")
    assert f"run {second['id']} is LISTING" in detail
    assert now(api, first) == ended

    class Here(Client):
        def close(self) -> None:
            """The transport is the application's: it goes on."""

    client = Here("http://testserver", transport=api._transport)
    monkeypatch.setattr(cli_bulk, "remote", lambda server: client)
    answer = CliRunner().invoke(main, ["bulk", "retry", first["id"]])
    assert answer.exit_code == 1
    (line,) = answer.output.splitlines()
    assert line.startswith("Error: ") and f"run {second['id']} is LISTING" in line

    work()
    (archive / "letter.fits").unlink()
    write_image(archive / "letter.fits", seed=1)
    assert CliRunner().invoke(main, ["bulk", "retry", first["id"]]).exit_code == 0
    work()
    again = now(api, first)
    assert (again["phase"], again["images"]["done"], again["images"]["failed"]) == ("COMPLETED", 2, 1)
    (line,) = api.get(ended["failures"]).json()["items"]
    assert line == failed["path-not-utf-8"], "its reason stays: there is no path to try again"


def test_a_run_can_be_cancelled_while_it_lists_and_finds_no_file(
    api: TestClient,
    archive: Path,
    psf_id: str,
    catalogue: Catalogue,
    settings: Settings,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("workers.run.attempt.REPORT_EVERY_S", 0.0)
    monkeypatch.setattr("workers.bulk.listing.ADD_EVERY_S", 0.0)
    request = {"files": [{"glob": f"{archive}/**/*.none"}], "psf_id": psf_id, "parameters": FEW}
    bulk = api.post("/v1/bulk", json=request).json()
    keep_turns(catalogue, settings)
    (turn,) = catalogue.jobs.of_kind("bulk")
    looked: list[Any] = []
    real = os.scandir

    def counted(folder: Any) -> Any:
        looked.append(folder)
        if len(looked) == 3:
            assert api.post(f"/v1/bulk/{bulk['id']}/cancel").json()["phase"] == "CANCELLED"
        return real(folder)

    with monkeypatch.context() as patched:
        patched.setattr(archive_files.os, "scandir", counted)
        Runner(settings, catalogue, Store(settings.data_dir)).run(turn.id)
    assert len(looked) == 3, "of 21"
    row = catalogue.jobs.get(turn.id)
    assert row is not None and row.phase in ("ABORTED", "COMPLETED"), (
        "it saw that the run, or that itself is cancelled"
    )
    assert api.get(f"/v1/bulk/{bulk['id']}").json()["phase"] == "CANCELLED"
