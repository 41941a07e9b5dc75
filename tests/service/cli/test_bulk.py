"""``heliopsf bulk``: uploads with bad files, dry runs, and what is printed while files are still being listed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.client.http import Client
from tests.conftest import write_image
from tests.service.conftest import upload
from workers.settings import Settings

Command = Callable[..., str]


def described(phase: str, total: int, *, listed: bool) -> dict[str, Any]:
    """The description of a bulk run."""
    images = {"total": total, "waiting": total - 3, "at_work": 0, "done": 3, "reused": 0, "failed": 0}
    return {
        "id": "a" * 32, "phase": phase, "images": images | {"to_look_at": 0}, "images_an_hour": None,
        "time_left_s": None, "error": None, "listed": listed,
    }  # fmt: skip


def test_the_progress_of_a_run_that_lists_files_has_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """No time left can be computed from the number of images that are listed so far."""
    client, told = Client("http://testserver"), []
    runs = [
        described("LISTING", 0, listed=False) | {"images": {"total": 0, "done": 0, "failed": 0}},
        described("LISTING", 400, listed=False),
        described("RUNNING", 500, listed=True),
        described("COMPLETED", 500, listed=True),
    ]
    monkeypatch.setattr(client, "follow", lambda address: iter(runs))
    client.wait_for_bulk("a" * 32, progress=lambda *step: told.append(step))
    client.close()
    assert told == [
        ("0 of at least 0 images", 0, 1),
        ("3 of at least 400 images", 0, 1),
        ("images", 3, 500),
        ("images", 3, 500),
    ]


@pytest.fixture
def settings(settings: Settings, tmp_path: Path) -> Settings:
    (tmp_path / "archive").mkdir()
    return settings.model_copy(update={"bulk_roots": str(tmp_path / "archive")})


def test_a_dry_run_ends_with_status_1_if_an_image_would_be_refused(
    api: TestClient, command: Command, tmp_path: Path, psf_file: Path
) -> None:
    archive = tmp_path / "archive"
    for number in range(3):
        write_image(archive / f"{number}.fits", seed=number)
    (archive / "letter.fits").write_text("Dear archive,\n" * 300)
    psf = upload(api, psf_file, "/v1/psfs")[:12]
    told = command("bulk", "submit", f"{archive}/*", "--psf", psf, "--dry-run", code=1)
    assert told.startswith("4 images, about ") and f"refused: {archive}/letter.fits: expected" in told
    told = command("bulk", "submit", f"{archive}/[0-2]*", "--psf", psf, "--dry-run")
    assert "examined: 3 of 3 images; 0 would be refused" in told and "refused:" not in told
    told = command("bulk", "submit", "--upload", archive, "--psf", psf, "--dry-run", code=2)
    assert "--dry-run uploads and starts nothing" in told
    assert api.get("/v1/bulk").json()["items"] == []


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "images"
    folder.mkdir()
    for number in (1, 3):
        write_image(folder / f"{number}.fits", seed=number)
    (folder / "2.fits").write_text("a letter " * 400)
    (folder / "4.fits").touch()
    return folder


def test_bad_files_are_named_and_the_run_starts_with_the_others(
    command: Command, api: TestClient, folder: Path, psf_file: Path
) -> None:
    psf = upload(api, psf_file, "/v1/psfs")
    told = command("bulk", "submit", "--upload", folder, "--psf", psf[:8], code=1)
    assert f"not uploaded: {folder / '2.fits'}: expected a FITS file" in told
    assert f"not uploaded: {folder / '4.fits'}: " in told
    assert told.endswith("Error: 2 files were not uploaded; the reasons are listed above\n")
    [run] = api.get("/v1/bulk").json()["items"]
    assert run["total"] == 2 and f"bulk {run['id'][:12]}" in told
    [line] = command("bulk", "list").splitlines()
    assert line.startswith(f"{run['id'][:12]}  RUNNING") and "0 of 2 done, 0 failed" in line
    assert "0 of 2 done" in command("bulk", "status", run["id"][:8])
    refused = command("bulk", "delete", run["id"][:8], code=1)
    assert refused.endswith("this bulk run is in phase RUNNING: cancel it first\n")
    assert "CANCELLED" in command("bulk", "cancel", run["id"][:8])
    assert command("bulk", "delete", run["id"][:8]) == f"bulk run {run['id'][:12]} is deleted\n"
    assert "no bulk run yet" in command("bulk", "list")
    assert "expected the id of one of your bulk runs" in command("bulk", "delete", run["id"][:8], code=1)


def test_a_folder_of_bad_files_starts_nothing(
    command: Command, api: TestClient, folder: Path, psf_file: Path
) -> None:
    psf = upload(api, psf_file, "/v1/psfs")
    for name in ("1.fits", "3.fits"):
        (folder / name).unlink()
    assert "no bulk run yet" in command("bulk", "list")
    told = command("bulk", "submit", "--upload", folder, "--psf", psf, code=1)
    assert "no file could be uploaded, so no bulk run was started" in told
    assert api.get("/v1/bulk").json()["items"] == api.get("/v1/images").json()["items"] == []


def test_a_run_without_images_is_refused_before_the_psf_is_sent(
    command: Command, client: Client, tmp_path: Path, psf_file: Path
) -> None:
    (tmp_path / "empty").mkdir()
    for given in ((), ("--upload", tmp_path / "empty")):
        assert "--upload" in command("bulk", "submit", *given, "--psf", psf_file, code=2)
    assert client.get("/v1/psfs")["items"] == []
