"""The list of PSFs: filters, upload, build."""

from __future__ import annotations

from pathlib import Path

from fastapi.testclient import TestClient

from service.app import create_app
from tests.conftest import write_psf
from tests.service.conftest import upload
from tests.service.keyed import keyed
from tests.service.pages.test_login import PERSON, browser
from workers.catalogue.access import Scope
from workers.settings import Settings


def test_filters_choose_psfs_and_empty_fields_do_not_count(api: TestClient, tmp_path: Path) -> None:
    ids = []
    for name, scale in (("one", 1.0), ("two", 0.5)):
        write_psf(tmp_path / f"{name}.fits", scale=scale)
        answer = api.post(
            f"/v1/psfs?name={name}&kind=total", content=(tmp_path / f"{name}.fits").read_bytes()
        )
        ids.append(answer.json()["id"])
    everything = api.get("/psfs?status=&name=&valid_at=").text
    assert all(f"/psfs/{psf_id}" in everything for psf_id in ids)
    chosen = api.get("/psfs?status=draft&name=two&channel=").text
    assert f"/psfs/{ids[1]}" in chosen and f"/psfs/{ids[0]}" not in chosen
    assert "No PSF matches" in api.get("/psfs?status=certified").text
    for query, told in (
        ("status=good", "draft"),
        ("valid_at=soon", "Valid at:"),
        ("context=none", "context"),
    ):
        answer = api.get(f"/psfs?{query}", headers=PERSON)
        assert answer.status_code in (404, 422) and told in answer.text, query
        assert answer.headers["content-type"].startswith("text/html")


def test_an_upload_by_the_form_leads_to_the_page_of_the_psf(api: TestClient, psf_file: Path) -> None:
    files = {"file": ("mine.fits", psf_file.read_bytes())}
    answer = api.post("/psfs?kind=total", files=files, follow_redirects=False)
    assert answer.status_code == 303
    psf_id = answer.headers["location"].removeprefix("/psfs/")
    assert api.get(f"/v1/psfs/{psf_id}").json()["kind"] == "total"
    refused = api.post("/psfs", files={"file": ("x.fits", b"no FITS at all")}, headers=PERSON)
    assert refused.status_code == 415 and "SIMPLE" in refused.text
    assert refused.headers["content-type"].startswith("text/html")


def test_a_build_by_the_form_leads_to_its_job(api: TestClient) -> None:
    data = {"instrument": "hri_euv", "size": "128", "component": "airy"}
    answer = api.post("/psfs/build", data=data, follow_redirects=False)
    assert answer.status_code == 303, answer.text
    job = api.get("/v1" + answer.headers["location"]).json()
    assert job["kind"] == "psf-build"
    assert (job["parameters"]["size"], job["parameters"]["component"]) == (128, "airy")
    wrong = api.post("/psfs/build", data=data | {"size": "7"}, headers=PERSON)
    assert wrong.status_code == 422 and "Size: " in wrong.text


def test_a_reader_sees_no_forms_that_change(settings: Settings) -> None:
    with keyed(settings) as service:
        page = browser(service, service.key("ann", Scope.READ)).get("/psfs").text
        assert "Upload a whole PSF" not in page and 'action="/psfs/build"' not in page
        other = browser(service, service.key("ann")).get("/psfs").text
        assert "Upload a whole PSF" in other and 'name="form_token"' in other


def test_the_list_goes_on_over_pages(settings: Settings, psf_file: Path) -> None:
    with TestClient(create_app(settings)) as api:
        first = upload(api, psf_file, "/v1/psfs")
        assert f"/psfs/{first}" in api.get("/psfs").text and "Earlier PSFs" not in api.get("/psfs").text
        assert api.get("/psfs?cursor=nonsense", headers=PERSON).status_code == 422
