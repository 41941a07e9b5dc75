"""``heliopsf serve``: the address for a browser; ``heliopsf demo``: the command that it prints, and the files that it
replaces."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from fastapi.testclient import TestClient

from service.app import create_app
from service.cli import serve
from service.cli.main import main
from tests.service.conftest import result_of, upload
from workers.settings import Settings


@pytest.fixture
def settings(settings: Settings, tmp_path: Path) -> Settings:
    return settings.model_copy(update={"data_dir": tmp_path / "a demo" / serve.DEMO_DATA})


def test_the_command_that_the_demo_tells_shows_its_product(
    api: TestClient,
    run_jobs: Callable[[], None],
    settings: Settings,
    image_file: Path,
    psf_file: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    inputs = {"image_id": upload(api, image_file), "psf_id": upload(api, psf_file, "/v1/psfs")}
    product = result_of(api, run_jobs, "deconvolve", **inputs)
    files = image_file.with_name("product.fits"), image_file.with_name("picture.png")
    lines = serve.demo_lines(settings.data_dir.parent, image_file, *files, product)
    (command,) = [line for line in lines if " serve " in line]
    (path,) = re.findall(r"this path: (/products/\w+)$", "\n".join(lines))
    started: list[Settings] = []
    monkeypatch.setattr("service.server.serve", lambda settings, *_, **__: started.append(settings))
    assert CliRunner().invoke(main, shlex.split(command)[1:]).exit_code == 0
    (again,) = started
    assert again.data_dir == settings.data_dir
    with TestClient(create_app(settings.model_copy(update={"data_dir": again.data_dir}))) as service:
        page = service.get(path, headers={"Accept": "text/html"})
        assert page.status_code == 200 and f"/v1{path}/file" in page.text


def test_a_demo_replaces_only_the_files_of_a_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.cli.serve.run_demo", lambda image, output, report: ["done"])
    own, earlier = tmp_path / "own", tmp_path / "demo"
    for folder, name in ((own, "psf.fits"), (earlier, serve.DEMO_LOG)):
        folder.mkdir()
        (folder / name).write_text("kept")
    refused = CliRunner().invoke(main, ["demo", "-o", str(own)])
    assert refused.exit_code == 1 and "not empty" in refused.output
    for folder in (earlier, tmp_path / "new"):
        assert CliRunner().invoke(main, ["demo", "-o", str(folder)]).exit_code == 0


def test_a_browser_is_sent_to_an_address_that_it_can_open() -> None:
    for listens, open in (
        ("http://127.0.0.1:8765", "http://127.0.0.1:8765"),
        ("http://[::1]:80", "http://[::1]:80"),
        ("http://sun.example.org:9000", "http://sun.example.org:9000"),
        ("http://0.0.0.0:8765", "http://localhost:8765"),
        ("http://[::]:8765", "http://localhost:8765"),
    ):
        assert serve.browser_address(listens) == open
