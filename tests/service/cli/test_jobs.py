"""``heliopsf job`` and ``heliopsf product``: short ids in and out."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from fastapi.testclient import TestClient

from service.cli.connection import short
from service.client import http
from service.client.errors import ServiceError
from tests.conftest import write_psf
from tests.service.conftest import upload

Command = Callable[..., str]


@pytest.fixture
def psf(api: TestClient, psf_file: Path) -> str:
    return upload(api, psf_file, "/v1/psfs")


def submitted(api: TestClient, image: str, psf: str, **more: object) -> str:
    parameters = {"image_id": image, "psf_id": psf, "method": {"name": "linear", "steps": 1}, **more}
    identity: str = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters}).json()["id"]
    return identity


def test_a_job_is_found_waited_for_and_its_product_fetched_by_short_ids(
    command: Command, api: TestClient, image_file: Path, psf: str, tmp_path: Path
) -> None:
    assert command("job", "list") == "no job yet\n"
    assert "no product yet" in command("product", "list")
    job = submitted(api, upload(api, image_file), psf)
    [line] = command("job", "list").splitlines()
    assert line.startswith(f"{short(job)}  QUEUED     deconvolve")
    assert command("job", "list", "--phase", "ERROR") == "no job in phase ERROR\n"

    waited = command("job", "wait", short(job))
    product = api.get(f"/v1/jobs/{job}").json()["result"].rpartition("/")[2]
    said = f"product {short(product)}: heliopsf product get {short(product)} -o FILE"
    assert waited.splitlines()[-1] == f"job {short(job)}: {said}"  # after lines of progress, if it lasts
    assert said in command("job", "list")
    shown = command("job", "show", job[:8].upper(), "--json", tmp_path / "j.json")
    assert f"job {job}: deconvolve, COMPLETED" in shown and f"psf_id {short(psf)}" in shown
    assert json.loads((tmp_path / "j.json").read_text())["id"] == job

    [listed] = command("product", "list", "--psf", short(psf), "--most", 5).splitlines()
    assert listed.startswith(short(product)) and listed.endswith("linear") and short(psf) in listed
    assert command("product", "list", "--image", psf[:9], code=1).startswith(
        "Error: expected the id of one of your images"
    )
    got = command("product", "get", short(product), "-o", tmp_path / "p.fits", "--plot", tmp_path / "p.png")
    assert short(product) in got and fits.getval(tmp_path / "p.fits", "PSFID") == psf
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    assert "changes_picture" in command("product", "get", short(product), "--changes", tmp_path / "c", code=1)
    assert "expected an output" in command("product", "get", short(product), code=2)
    assert command("product", "delete", short(product)) == f"product {short(product)} is deleted\n"
    assert "no product yet" in command("product", "list")
    gone = command("product", "delete", short(product), code=1)
    assert (
        f"{short(product)}, which fits none of them: list your products with `heliopsf product list`" in gone
    )
    said = f"product {short(product)} was deleted; the same request makes it again\n"
    assert command("job", "wait", short(job)).endswith(f"job {short(job)}: {said}")
    assert said in command("job", "list") and said in command("job", "show", job)
    again = submitted(api, upload(api, image_file), psf)
    assert again != job
    command("job", "wait", again)
    assert said not in command("job", "list"), "made again: no job's result is missing"


def test_results_go_into_a_folder_under_their_own_names(
    command: Command, api: TestClient, image_file: Path, psf: str, tmp_path: Path
) -> None:
    job = submitted(api, upload(api, image_file), psf)
    command("job", "wait", job)
    found = api.get(api.get(f"/v1/jobs/{job}").json()["result"]).json()
    (tmp_path / "there").mkdir()
    for folder in ("there", "new/"):
        command("product", "get", short(found["id"]), "-o", f"{tmp_path}/{folder}")
        command("psf", "download", short(psf), "-o", f"{tmp_path}/{folder}")
        names = {path.name for path in (tmp_path / folder).iterdir()}
        assert names == {found["details"]["filename"], f"psf-{short(psf)}.fits"}
    twice = command("psf", "download", short(psf), "-o", tmp_path / "there", code=1)
    assert "the file exists" in twice
    (tmp_path / "file").touch()
    assert "expected a folder" in command("psf", "download", short(psf), "-o", f"{tmp_path}/file/", code=1)


def test_a_name_that_the_service_sends_leads_out_of_no_folder_and_controls_no_terminal(
    command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    row = {"id": "a" * 64, "image_id": "b" * 64, "psf_id": "c" * 64, "created_at": 0.0}
    foreign = row | {"psf_version": "1\x1b[2J\x9b2J\u202e", "details": {"method": {"name": "x\x07"}}}

    def download(_client: http.Client, _address: str, path: Path, **_options: Any) -> None:
        path.write_text("product")

    monkeypatch.setattr(http.Client, "products", lambda _client, **_filters: [foreign])
    monkeypatch.setattr(http.Client, "download", download)
    printed = command("product", "list")
    for name, expected in (
        ("../../x.fits", "x.fits"),
        ("..\\..\\x.fits", "x.fits"),
        ("..", "result.fits"),
        (".bashrc", "bashrc"),
        ("a\x1b[2J.fits", "a[2J.fits"),
    ):
        sent = foreign | {"details": {"filename": name}}
        monkeypatch.setattr(http.Client, "product", lambda _client, _identity, sent=sent: sent)
        printed += command("product", "get", "a" * 8, "-o", f"{tmp_path}/in/there/", "--overwrite")
        assert [one.name for one in (tmp_path / "in" / "there").iterdir()] == [expected], name
        (tmp_path / "in" / "there" / expected).unlink()

    def refused(_client: http.Client, _identity: str) -> Any:
        raise ServiceError("no such\x1b[2J")

    monkeypatch.setattr(http.Client, "product", refused)
    printed += command("product", "get", "a" * 8, "-o", f"{tmp_path}/in/there/", code=1)
    assert printed.replace("\n", "").isprintable() and "1\\x1b[2J\\x9b2J\\u202e" in printed


def test_jobs_are_cancelled_and_a_wait_for_several_ends_with_1_if_one_failed(
    command: Command, api: TestClient, image_file: Path, psf: str
) -> None:
    image = upload(api, image_file)
    stopped, fine = submitted(api, image, psf), submitted(api, image, psf, changes_picture=True)
    assert command("job", "cancel", short(stopped)) == f"job {short(stopped)}: ABORTED\n"
    told = command("job", "wait", short(stopped), short(fine), code=1)
    assert f"job {short(stopped)}: ABORTED" in told
    assert f"job {short(fine)}: product" in told
    assert "the id of one of your jobs, or its first" in command("job", "wait", "01234567", code=1)


def test_a_text_that_cannot_be_an_id_is_refused_before_a_request(command: Command) -> None:
    for identity in ("0123456", "../../metrics", "x" * 12):
        assert "expected an id, or its first 8 or more" in command("job", "show", identity, code=2)


def test_psfs_are_downloaded_and_named_by_short_ids(
    command: Command, api: TestClient, image_file: Path, psf: str, psf_file: Path, tmp_path: Path
) -> None:
    got = command("psf", "download", short(psf), "-o", tmp_path / "p.fits")
    assert short(psf) in got and (tmp_path / "p.fits").read_bytes() == psf_file.read_bytes()
    done = command("deconvolve", image_file, "-o", tmp_path / "o.fits", "--psf", short(psf), "--steps", 2)
    assert "product " in done and fits.getval(tmp_path / "o.fits", "PSFID") == psf
    assert "sum 1.000000 on 64 x 64 px" in command("psf", "query", short(psf), "--radius", 5)
    write_psf(tmp_path / "other.fits", size=48)
    other = upload(api, tmp_path / "other.fits", "/v1/psfs")
    assert " minus " in command("psf", "query", short(psf), "--compare", short(other))
    mixed = command("psf", "query", short(psf), "--compare", psf_file, code=2)
    assert "expected two PSF ids or two files" in mixed
    assert "central 9 x 9 px" in command("psf", "cutout", short(psf), "--size", 9, "-o", tmp_path / "c.fits")
    assert "px of 2 x 2" in command("psf", "rebin", short(psf), "--factor", 2, "-o", tmp_path / "r.fits")
    assert command("psf", "lineage", short(psf)).startswith(f"psf {short(psf)}")


def test_the_instruments_that_can_be_built_are_listed(command: Command) -> None:
    assert "heliopsf psf build --instrument hri_euv -o FILE" in command("psf", "instruments")
