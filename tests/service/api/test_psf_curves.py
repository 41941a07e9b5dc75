"""Curves and weights of a PSF from its tables, over HTTP, in this process and on the command line."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner, Result
from fastapi.testclient import TestClient
from numpy.typing import NDArray

from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.psf import cumulative_curve, encircled_energy
from service.app import create_app
from service.cli.main import main
from service.client.http import Client, ServiceError
from tests.conftest import SMALL_INSTRUMENT
from tests.service.conftest import refusal, result_of, settings_in, upload
from tests.workers.jobs import run_job
from workers.catalogue.tables import DEFAULT_OWNER, JobRow, PsfRow
from workers.run.runner import Runner

LIMITS = FitsLimits(max_pixels=512 * 512)


@dataclass(frozen=True)
class Served:
    """A service with one PSF that was built there."""

    api: TestClient
    psf: dict[str, Any]
    file: Path


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    settings = settings_in(tmp_path_factory.mktemp("served"))
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        state = api.app.state.heliopsf

        def run_jobs() -> None:
            for row in state.catalogue.page(JobRow, owner=DEFAULT_OWNER, limit=9):
                run_job(Runner(settings, state.catalogue, state.store), state.catalogue, row.id)

        psf = result_of(api, run_jobs, "psf-build", instrument_file=SMALL_INSTRUMENT, size=128)
        row = state.catalogue.get(PsfRow, psf["id"], DEFAULT_OWNER)
        yield Served(api, psf, state.store.path(row.file_sha256))


@pytest.fixture
def without_pixels(served: Served) -> Iterator[NDArray[np.float64]]:
    """The PSF's weights, whose file is away meanwhile."""
    away = served.file.with_name("away")
    kernel = read_psf(served.file, LIMITS).kernel
    served.file.rename(away)
    yield kernel
    away.rename(served.file)


def test_a_built_psf_answers_without_its_pixels(served: Served, without_pixels: NDArray[np.float64]) -> None:
    api, kernel = served.api, without_pixels
    here = f"/v1/psfs/{served.psf['id']}"
    curve = api.get(f"{here}/curve", params={"radii": "0.5,10,31.4"}).json()
    assert curve["radii_px"] == [0.5, 10, 31.4] and curve["sigma_points"] == {}
    wanted = cumulative_curve(kernel, [0.5, 10, 31.4])
    assert curve["light_beyond_pct"]["TOTAL"] == pytest.approx(wanted, abs=1e-5)
    assert {"TOTAL", "DIFFRACTION", "AIRY"} <= set(curve["light_beyond_pct"])
    whole = api.get(f"{here}/curve").json()
    assert len(whole["radii_px"]) > 500 and whole["radii_px"][-1] == pytest.approx(whole["reach_px"])
    within = api.get(f"{here}/encircled", params={"radius": 10}).json()
    assert within["light_within"]["TOTAL"] == pytest.approx(float(encircled_energy(kernel, 10)), abs=1e-7)
    ring = api.get(f"{here}/annulus", params={"inner": 10, "outer": 31.4}).json()
    assert 100 * ring["light"]["TOTAL"] == pytest.approx(wanted[1] - wanted[2], abs=1e-5)
    assert "exact to 50 px" in ring["resolution"]
    profile = api.get(f"{here}/profile").json()
    assert profile["mean_weight"]["TOTAL"][0] == pytest.approx(kernel[64, 64])
    assert len(profile["radius_px"]) == len(profile["pixels"]) == len(profile["azimuthal_rms_over_mean"])
    with Client("http://testserver", transport=api._transport) as client:
        assert client.psf_curve(served.psf["id"], [0.5, 10, 31.4]) == curve
        with pytest.raises(ServiceError, match="expected"):
            client.psf_encircled(served.psf["id"], -1)


def test_etags_depend_on_the_question(served: Served) -> None:
    api, built = served.api, served.psf
    here = f"/v1/psfs/{built['id']}"
    asked = (
        "curve",
        "curve?radii=1",
        "curve?radii=2",
        "profile",
        "encircled?radius=3",
        "annulus?inner=1&outer=2",
    )
    tags = set()
    for question in (*asked, "cutout?size=8", "cutout?size=9", f"compare/{built['id']}"):
        answer = api.get(f"{here}/{question}")
        assert answer.status_code == 200 and "immutable" in answer.headers["Cache-Control"]
        tag = answer.headers["ETag"]
        assert tag not in tags, question
        tags.add(tag)
        again = api.get(f"{here}/{question}", headers={"If-None-Match": tag})
        assert again.status_code == 304 and not again.content


QUESTIONS = ("curve", "profile", "encircled?radius=1", "annulus?inner=1&outer=2")


def test_an_uploaded_psf_says_which_job_makes_its_tables(
    api: TestClient, run_jobs: Callable[[], None], psf_file: Path, tmp_path: Path
) -> None:
    psf_id = upload(api, psf_file, "/v1/psfs")
    for question in (*QUESTIONS, f"compare/{psf_id}"):
        hint = refusal(api.get(f"/v1/psfs/{psf_id}/{question}"), 409, "no-tables")
    body = json.loads(hint[hint.index("{") : hint.rindex("}") + 1])
    job = api.post("/v1/jobs", json=body)
    assert job.status_code == 202
    assert api.get(f"/v1/psfs/{psf_id}").json()["preview"] is None
    run_jobs()
    view = api.get(f"/v1/psfs/{psf_id}").json()
    assert api.get(view["preview"]).content.startswith(b"\x89PNG")
    curve = api.get(f"/v1/psfs/{psf_id}/curve?radii=1,5").json()
    kernel = read_psf(psf_file, LIMITS).kernel
    assert curve["light_beyond_pct"] == {"TOTAL": pytest.approx(cumulative_curve(kernel, [1, 5]), abs=1e-6)}
    assert api.post("/v1/jobs", json=body).json()["phase"] == "COMPLETED", "an equal job is that one"


def test_a_cutout_is_the_middle_of_the_file_byte_for_byte(served: Served) -> None:
    whole = fits.getdata(served.file)
    for size in (1, 31, 128):
        answer = served.api.get(f"/v1/psfs/{served.psf['id']}/cutout", params={"size": size})
        assert answer.status_code == 200 and answer.headers["content-type"] == "application/fits"
        with fits.open(io.BytesIO(answer.content)) as hdus:
            hdus.verify("exception")
            header, pixels = hdus[0].header, hdus[0].data
        first = 64 - size // 2
        assert np.array_equal(pixels, whole[first : first + size, first : first + size])
        assert header["CRPIX1"] == header["CRPIX2"] == size // 2 + 1 and header["PSFNAME"] == "small"


A = "a" * 64
BAD = [
    ("curve?radii=", 422, "bad-radius"),
    ("curve?radii=1,x", 422, "bad-radius"),
    ("curve?radii=" + ",".join(["1"] * 501), 422, "bad-radius"),
    ("curve?radii=" + "1," * 10_000, 422, "invalid-request"),
    ("curve?radii=1,91", 422, "radius-beyond-reach"),
    ("encircled", 422, "invalid-request"),
    ("annulus?inner=2&outer=2", 422, "bad-annulus"),
    ("cutout?size=129", 422, "cutout-too-large"),
    (f"compare/{A}", 404, "no-such-psf"),
]


def test_invalid_parameters_are_refused(served: Served, psf_file: Path, tmp_path: Path) -> None:
    api, built = served.api, served.psf
    for question, status, code in BAD:
        answer = api.get(f"/v1/psfs/{built['id']}/{question}")
        assert refusal(answer, status, code), question
    missing = api.post("/v1/jobs", json={"kind": "psf-tables", "parameters": {"psf_id": A}})
    refusal(missing, 404, "no-such-psf")


def run(*arguments: str | Path | float) -> Result:
    return CliRunner().invoke(main, ["psf", *[str(argument) for argument in arguments]])


def test_the_command_asks_a_file(psf_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.json"
    questions = ("--radius", 1, "--radius", 5, "--annulus", 1, 5, "--profile")
    result = run("query", psf_file, *questions, "--json", out)
    assert result.exit_code == 0, result.output
    answers = json.loads(out.read_text())
    kernel = read_psf(psf_file, LIMITS).kernel
    wanted = cumulative_curve(kernel, [1, 5])
    assert answers["curve"]["light_beyond_pct"]["TOTAL"] == pytest.approx(wanted, abs=1e-7)
    assert 100 * answers["annulus"]["light"]["TOTAL"] == pytest.approx(wanted[0] - wanted[1], abs=1e-7)
    assert f"{wanted[1]:.3f}" in result.output and f"{wanted[0] - wanted[1]:.3f}" in result.output
    assert "largest" in run("query", psf_file, "--compare", psf_file).output
    plain = run("query", psf_file)
    assert plain.exit_code == 0 and "        20 " in plain.output and "        50 " not in plain.output
