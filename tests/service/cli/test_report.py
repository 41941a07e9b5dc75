"""A report over HTTP and on the command line: upload, job, page with its policy."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from astropy.io import fits
from click.testing import CliRunner
from fastapi.testclient import TestClient

from psfcore.psf import REACH_GRID_PX
from psfcore.simulate.scatter_truth import total_kernel
from psfcore.transit.archive import pack
from service.cli.main import main
from tests.html_page import check_stands_alone
from tests.service.conftest import upload
from tests.transit_files import TRUTH, diffraction, write_simulated


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_simulated(tmp_path_factory.mktemp("simulated") / "transit")


@pytest.fixture
def psf(tmp_path: Path) -> Path:
    """The true PSF, small enough for the service of these tests."""
    path = tmp_path / "true.fits"
    kernel = total_kernel(TRUTH, diffraction(), REACH_GRID_PX)
    fits.PrimaryHDU(kernel[896:-896, 896:-896].astype("f4")).writeto(path)
    return path


def test_a_transit_becomes_a_page(
    api: TestClient, run_jobs: Callable[[], None], folder: Path, psf: Path, tmp_path: Path
) -> None:
    pack(folder, tmp_path / "transit.tar")
    transit_id = upload(api, tmp_path / "transit.tar", "/v1/transits")
    parameters = {"transit_id": transit_id, "psf_id": upload(api, psf, "/v1/psfs")}
    asked = api.post("/v1/jobs", json={"kind": "report", "parameters": parameters})
    assert asked.status_code == 202, asked.text
    run_jobs()
    job = api.get(asked.headers["location"]).json()
    assert job["phase"] == "COMPLETED", job["error"]
    report = api.get(job["result"]).json()
    assert report["kind"] == "report" and report["transit_id"] == transit_id
    page = api.get(report["html"])
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    policy = page.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'unsafe-inline'")
    check_stands_alone(page.text)
    again = api.get(report["html"], headers={"If-None-Match": page.headers["etag"]})
    assert again.status_code == 304 and again.headers["content-security-policy"] == policy
    assert api.get(report["file"]).json()["schema"] == "psf-report/1"
    assert api.get(report["preview"]).content.startswith(b"\x89PNG")
    equal = api.post("/v1/jobs", json={"kind": "report", "parameters": parameters})
    assert equal.status_code == 200 and equal.json()["id"] == job["id"]


def test_the_command_writes_the_page_and_its_numbers(folder: Path, psf: Path, tmp_path: Path) -> None:
    page, numbers = tmp_path / "R.html", tmp_path / "R.json"
    arguments = ["report", folder, "-o", page, "--json", numbers, "--psf", psf, "--local"]
    done = CliRunner().invoke(main, [str(one) for one in arguments])
    assert done.exit_code == 0, done.output
    check_stands_alone(page.read_text("utf-8"))
    told = json.loads(numbers.read_text())
    assert told["sentence"] in done.output
    whole = told["evaluation"]["all"]
    assert f"all pointings: {whole['images']} images, mean {whole['mean_pct']:+.2f} %" in done.output
    pointings = [
        line for line in done.output.splitlines() if line.startswith("pointing ") and "images" in line
    ]
    assert len(pointings) == len(told["evaluation"]["pointings"])
    assert "the PSF was given, and no fit was made" in done.output


def test_a_plot_alone_is_enough_and_noise_may_come_with_the_command(
    folder: Path, psf: Path, tmp_path: Path
) -> None:
    plots = [tmp_path / name for name in ("quiet.png", "loud.png")]
    said = []
    for plot, noise in zip(plots, ((), ("--noise", "24", "8")), strict=True):
        arguments = ["report", folder, "--plot", plot, "--psf", psf, "--no-dark-offsets", "--local", *noise]
        done = CliRunner().invoke(main, [str(one) for one in arguments])
        assert done.exit_code == 0, done.output
        assert plot.read_bytes().startswith(b"\x89PNG")
        said.append(next(line for line in done.output.splitlines() if line.startswith("all pointings")))
    assert said[0] != said[1]


def test_what_is_wrong_is_said_in_a_line_and_nothing_is_written(
    subtests: pytest.Subtests, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for arguments, said in (
        (["-o", "no/such/folder/R.html"], "there is no folder"),
        (["-o", "R.html", "--psf", "missing.fits"], "expected a PSF id"),
        (["-o", "R.html", "--noise", "-1", "2"], "greater than or equal to 0"),
        (["-o", "R.html", "--seed", "-1"], "not in the range"),
        ([], "expected an output: -o PAGE.html, --json FILE or --plot FILE"),
        (["-o", "R.html", "--shapes", "--psf", 64 * "a"], "--shapes fits every shape to TRANSIT"),
    ):
        with subtests.test(str((arguments, said))):
            monkeypatch.chdir(tmp_path)
            done = CliRunner().invoke(main, ["report", str(folder), "--local", *arguments])
            assert done.exit_code != 0 and said in done.output and "Traceback" not in done.output
            assert list(tmp_path.iterdir()) == []
