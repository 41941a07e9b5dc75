"""``heliopsf bulk submit --dry-run``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from tests.conftest import write_image
from tests.service.conftest import upload
from workers.settings import Settings

Command = Callable[..., str]


@pytest.fixture
def settings(settings: Settings, tmp_path: Path) -> Settings:
    (tmp_path / "archive").mkdir()
    return settings.model_copy(update={"bulk_roots": str(tmp_path / "archive")})


def test_it_ends_with_status_1_if_an_image_would_be_refused(
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
