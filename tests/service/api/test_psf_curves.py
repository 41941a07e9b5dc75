"""Curves and weights of a PSF from its tables, over HTTP, in this process and on the command line."""

from __future__ import annotations

import gzip
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
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.psf import FittedShape, Psf, cumulative_curve, encircled_energy
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from service.app import create_app
from service.cli.main import main
from service.client.http import Client, ServiceError
from tests.conftest import SMALL_INSTRUMENT
from tests.conftest import write_psf as write_plain_psf
from tests.service.conftest import refusal, result_of, settings_in, upload
from workers.catalogue.tables import DEFAULT_OWNER, JobRow, PsfRow
from workers.run.runner import Runner

LIMITS = FitsLimits(max_pixels=512 * 512)
AT = SOFTENED_POWER_LAW.coordinates({"b_px": 5.0, "c": 2.6, "total": 0.4})


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
                Runner(settings, state.catalogue, state.store).run(row.id)

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


def test_etags_depend_on_the_question(served: Served) -> None:
    api, built = served.api, served.psf
    here = f"/v1/psfs/{built['id']}"
    asked = [
        f"{here}/curve",
        f"{here}/curve?radii=1",
        f"{here}/curve?radii=2",
        f"{here}/profile",
        f"{here}/encircled?radius=3",
        f"{here}/annulus?inner=1&outer=2",
        f"{here}/cutout?size=8",
        f"{here}/cutout?size=9",
        f"{here}/compare/{built['id']}",
    ]
    answers = [api.get(address) for address in asked]
    assert [answer.status_code for answer in answers] == [200] * len(asked)
    tags = [answer.headers["ETag"] for answer in answers]
    assert len(set(tags)) == len(tags)
    for address, answer in zip(asked, answers, strict=True):
        assert "immutable" in answer.headers["Cache-Control"]
        again = api.get(address, headers={"If-None-Match": answer.headers["ETag"]})
        assert again.status_code == 304 and not again.content
        assert api.get(address).headers["ETag"] == answer.headers["ETag"]
    assert api.get(asked[1], headers={"If-None-Match": tags[2]}).status_code == 200


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


def test_a_fitted_psf_answers_with_errors(
    api: TestClient, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    kernel = SOFTENED_POWER_LAW.kernel(AT, 128)
    point = np.zeros_like(kernel)
    point[64, 64] = 1
    names, covariance = SOFTENED_POWER_LAW.names, ((1e-3, 0, 0), (0, 1e-3, 0), (0, 0, 2e-3))
    parts = {"DIFFRACTION": point, "SCATTER": kernel}
    fitted = FittedShape(SOFTENED_POWER_LAW.name, names, tuple(AT), covariance)
    psf = Psf(kernel, "fit", "1", None, "draft", components=parts, fitted=fitted)
    write_psf(tmp_path / "fit.fits", psf)
    psf_id = upload(api, tmp_path / "fit.fits", "/v1/psfs")
    assert result_of(api, run_jobs, "psf-tables", psf_id=psf_id)["id"] == psf_id
    here = f"/v1/psfs/{psf_id}"
    curve = api.get(f"{here}/curve?radii=1,10").json()
    assert set(curve["sigma_points"]) == {"TOTAL", "SCATTER"}
    assert 0.5 < curve["sigma_points"]["TOTAL"][0] < 2
    ring = api.get(f"{here}/annulus?inner=1&outer=10").json()
    assert 0 < ring["sigma"]["TOTAL"] < 0.02
    same = api.get(f"{here}/compare/{psf_id}").json()
    assert same["largest_points"] == {"TOTAL": 0, "DIFFRACTION": 0, "SCATTER": 0}
    assert max(same["sigma_points"]["TOTAL"]) > 0.5


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


def test_a_cutout_of_an_upload(api: TestClient, tmp_path: Path) -> None:
    y, x = np.indices((40, 51))
    kernel = np.exp(-0.5 * ((y - 20) ** 2 + (x - 25) ** 2))
    kernel /= kernel.sum()
    fits.PrimaryHDU(kernel).writeto(tmp_path / "double.fits")  # float64, not square
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(kernel)]).writeto(tmp_path / "second.fits")
    (tmp_path / "packed.fits.gz").write_bytes(gzip.compress((tmp_path / "double.fits").read_bytes()))
    fits.PrimaryHDU((kernel == kernel.max()).astype("i4")).writeto(tmp_path / "whole.fits")
    double = upload(api, tmp_path / "double.fits", "/v1/psfs")
    answer = api.get(f"/v1/psfs/{double}/cutout?size=7")
    assert np.array_equal(fits.getdata(io.BytesIO(answer.content)), kernel[17:24, 22:29])
    for name in ("second.fits", "packed.fits.gz", "whole.fits"):
        psf_id = upload(api, tmp_path / name, "/v1/psfs")
        answer = api.get(f"/v1/psfs/{psf_id}/cutout?size=7")
        refusal(answer, 409, "cutout-not-plain")


A = "a" * 64
BAD = [
    ("curve?radii=-1", 422, "bad-radius"),
    ("curve?radii=nan", 422, "bad-radius"),
    ("curve?radii=", 422, "bad-radius"),
    ("curve?radii=1,x", 422, "bad-radius"),
    ("curve?radii=" + ",".join(["1"] * 501), 422, "bad-radius"),
    ("curve?radii=" + "1," * 10_000, 422, "invalid-request"),
    ("curve?radii=1,91", 422, "radius-beyond-reach"),
    ("encircled", 422, "invalid-request"),
    ("encircled?radius=x", 422, "invalid-request"),
    ("encircled?radius=-0.1", 422, "bad-radius"),
    ("encircled?radius=inf", 422, "bad-radius"),
    ("encircled?radius=1e9", 422, "radius-beyond-reach"),
    ("annulus?inner=2&outer=2", 422, "bad-annulus"),
    ("annulus?inner=3&outer=2", 422, "bad-annulus"),
    ("annulus?inner=3", 422, "invalid-request"),
    ("annulus?inner=3&outer=1e5", 422, "radius-beyond-reach"),
    ("cutout", 422, "invalid-request"),
    ("cutout?size=0", 422, "invalid-request"),
    ("cutout?size=129", 422, "cutout-too-large"),
    (f"cutout?size={10**30}", 422, "cutout-too-large"),
    (f"compare/{A}", 404, "no-such-psf"),
    ("compare/short", 422, "invalid-request"),
]


def test_invalid_parameters_are_refused(served: Served) -> None:
    api, built = served.api, served.psf
    for question, status, code in BAD:
        answer = api.get(f"/v1/psfs/{built['id']}/{question}")
        assert refusal(answer, status, code), question
    for question in ("curve", "profile", "encircled?radius=1", "cutout?size=3"):
        assert api.get(f"/v1/psfs/{A}/{question}").status_code == 404
        assert api.get(f"/v1/psfs/short/{question}").status_code == 422
    missing = api.post("/v1/jobs", json={"kind": "psf-tables", "parameters": {"psf_id": A}})
    refusal(missing, 404, "no-such-psf")


def test_psfs_on_other_pixels_are_not_compared(
    api: TestClient, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    ids = []
    for scale in (0.5, 0.6):
        path = tmp_path / f"{scale}.fits"
        write_plain_psf(path)
        fits.setval(path, "CDELT1", value=scale)
        ids.append(upload(api, path, "/v1/psfs"))
        result_of(api, run_jobs, "psf-tables", psf_id=ids[-1])
    answer = api.get(f"/v1/psfs/{ids[0]}/compare/{ids[1]}")
    refusal(answer, 409, "plate-scale-mismatch")


def test_the_client_gets_the_same_answers(served: Served, tmp_path: Path) -> None:
    psf_id = served.psf["id"]
    with Client("http://testserver", transport=served.api._transport) as sun:
        assert sun.psf_curve(psf_id, [1]) == served.api.get(f"/v1/psfs/{psf_id}/curve?radii=1").json()
        sun.psf_cutout(psf_id, 16, tmp_path / "cut.fits")
        assert fits.getdata(tmp_path / "cut.fits").shape == (16, 16)
        with pytest.raises(ServiceError) as caught:
            sun.psf_encircled(psf_id, -1)
        assert caught.value.code == "bad-radius"


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
    plain = run("query", psf_file)
    assert plain.exit_code == 0 and "        20 " in plain.output and "        50 " not in plain.output


def test_the_command_compares_cuts_and_bins_files(psf_file: Path, tmp_path: Path) -> None:
    cut, binned = tmp_path / "cut.fits", tmp_path / "binned.fits"
    assert run("cutout", psf_file, "--size", 21, "-o", cut).exit_code == 0
    assert run("rebin", psf_file, "--factor", 2, "-o", binned).exit_code == 0
    whole = read_psf(psf_file, LIMITS).kernel
    assert read_psf(cut, LIMITS).kernel == pytest.approx(whole[22:43, 22:43], rel=1e-6)
    assert read_psf(binned, LIMITS).kernel.sum() == pytest.approx(1, abs=1e-5)
    result = run("query", psf_file, "--compare", cut)
    assert result.exit_code == 0 and "largest" in result.output
    for wrong in (
        ("query", tmp_path / "none.fits"),
        ("query", psf_file, "--radius", -1),
        ("query", psf_file, "--annulus", 5, 4),
        ("query", psf_file, "--compare", A),
        ("cutout", psf_file, "--size", 65, "-o", tmp_path / "new.fits"),
        ("rebin", psf_file, "--factor", 99, "-o", tmp_path / "new.fits"),
    ):
        refused = run(*wrong)
        assert refused.exit_code != 0 and "expected" in refused.output, (wrong, refused.output)
        assert "Traceback" not in refused.output
