"""What the commands of bulk runs say while files are still being listed, and about a dry run."""

from __future__ import annotations

from typing import Any
from unittest.mock import MagicMock

import pytest
from click.testing import CliRunner

from service.cli import bulk as cli_bulk
from service.cli.main import main
from service.client.http import Client


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """A client that answers as it is told."""
    service = MagicMock()
    service.__enter__.return_value = service
    service.psf.return_value = {"status": "draft"}
    monkeypatch.setattr(cli_bulk, "remote", lambda server: service)
    return service


def described(phase: str, total: int, *, listed: bool) -> dict[str, Any]:
    """The description of a bulk run."""
    images = {"total": total, "waiting": total - 3, "at_work": 0, "done": 3, "reused": 0, "failed": 0}
    return {
        "id": "a" * 32, "phase": phase, "images": images | {"to_look_at": 0}, "images_an_hour": None,
        "time_left_s": None, "error": None, "listed": listed,
    }  # fmt: skip


def test_a_number_of_images_that_may_grow_is_a_lower_limit(service: MagicMock) -> None:
    for listed, said in ((False, "3 of at least 400 done"), (True, "3 of 400 done")):
        service.bulk.return_value = described("PAUSED", 400, listed=listed)
        told = CliRunner().invoke(main, ["bulk", "status", "a" * 32]).output
        assert f"PAUSED: {said}, 0 failed, 0 in progress, 397 waiting" in told


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


def test_a_dry_run_names_the_path_of_a_product(service: MagicMock) -> None:
    estimate = {
        "images": 4, "complete": True, "examined": 4, "refused_images": 0, "refused": [], "existing": 0,
        "output_bytes": 2**20, "seconds": 8.0, "workers": 1, "memory_mib": 100,
    }  # fmt: skip
    path = "/out/SOLO/2021/03/01/a.fits"
    for more, named in (({"example_output": path}, True), ({"example_output": None}, False)):
        service.estimate_bulk.return_value = estimate | more
        told = CliRunner().invoke(main, ["bulk", "submit", "/x/*.fits", "--psf", "a" * 64, "--dry-run"])
        assert told.exit_code == 0 and (f"for example: {path}" in told.output) == named, told.output
