"""``heliopsf bulk submit --upload FOLDER`` with bad files in the folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from tests.conftest import write_image
from tests.service.conftest import upload

Command = Callable[..., str]


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
