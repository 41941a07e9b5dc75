"""The pages of PSFs: the list with its filters and forms, and one PSF with its facts, curves and status.
Two PSFs compared: curves, ratio, and only the parameters that differ."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.pages.psfs import psf_parameters
from service.pages.rendering import differing
from service.views import PsfView
from tests.conftest import write_psf
from tests.service.conftest import upload
from tests.service.keyed import keyed
from tests.service.pages.test_login import OWN_PAGE, PERSON, browser
from workers.catalogue.access import Scope
from workers.settings import Settings
from workers.versions import PsfStatus


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


SERIES = {"instrument": "hri_euv", "channel": "174", "kind": "total"}


def certify(api: TestClient, psf_id: str, version: str, **more: object) -> int:
    data = {
        "status": "certified",
        "version": version,
        "with_range": "1",
        "reason": "tested",
        **SERIES,
        **more,
    }
    answer = api.post(f"/psfs/{psf_id}/status", data=data, headers=PERSON, follow_redirects=False)
    return int(answer.status_code)


def test_an_uploaded_psf_gets_its_curves_by_a_job(
    api: TestClient, run_jobs: Callable[[], None], psf_id: str
) -> None:
    page = api.get(f"/psfs/{psf_id}").text
    assert "has no curves and no picture yet" in page and "data-plot" not in page
    started = api.post(f"/psfs/{psf_id}/tables", follow_redirects=False)
    assert started.status_code == 303 and started.headers["location"].startswith("/jobs/")
    run_jobs()
    page = api.get(f"/psfs/{psf_id}").text
    assert page.count("data-plot") == 2 and f"/v1/psfs/{psf_id}/preview" in page and "no curves" not in page
    (core,) = re.findall(r'<img class="picture core" src="([^"]+)"', page)
    picture = api.get(core)
    assert picture.headers["content-type"] == "image/png" and picture.content.startswith(b"\x89PNG")
    assert api.get(core, headers={"If-None-Match": picture.headers["etag"]}).status_code == 304
    assert len(re.findall("<img class=.picture", page)) == 1, "the curves are not drawn twice"
    # The numbers of the table are those of the API.
    profile = api.get(f"/v1/psfs/{psf_id}/profile").json()["mean_weight"]["TOTAL"]
    shown = re.findall(r'<td class="number">0</td><td class="number">([^<]+)</td>', page)
    assert float(shown[0]) == pytest.approx(profile[0], rel=1e-4)


def test_certify_change_the_range_supersede_deprecate_and_delete(
    api: TestClient, psf_id: str, tmp_path: Path
) -> None:
    page = api.get(f"/psfs/{psf_id}").text
    assert "Certify" in page and "Reject: delete this draft" in page
    assert certify(api, psf_id, "1.0.0", valid_from="2024-01-01T00:00:00Z", valid_to="") == 303
    page = api.get(f"/psfs/{psf_id}").text
    assert "draft to certified" in page and "tested" in page and "from 2024-01-01T00:00:00" in page
    assert "Reject" not in page and "Change the range" in page
    bounded = {"status": "certified", "with_range": "1", "valid_from": "2023-01-01T00:00:00Z"}
    assert api.post(f"/psfs/{psf_id}/status", data=bounded).status_code == 200
    assert api.get(f"/v1/psfs/{psf_id}").json()["valid_from"].startswith("2023-01-01")

    write_psf(tmp_path / "next.fits", scale=0.9)
    following = upload(api, tmp_path / "next.fits", "/v1/psfs")
    assert certify(api, following, "2.0.0") == 409, "the ranges overlap"
    assert certify(api, following, "2.0.0", supersedes=psf_id) == 303
    old = api.get(f"/v1/psfs/{psf_id}").json()
    assert (old["status"], old["successor"]) == ("deprecated", following)
    assert f"/psfs/{following}" in api.get(f"/psfs/{psf_id}").text
    gone = {"status": "deprecated", "reason": "wrong mesh"}
    assert "wrong mesh" in api.post(f"/psfs/{following}/status", data=gone).text
    assert api.post(f"/psfs/{following}/delete", headers=PERSON).status_code == 409
    write_psf(tmp_path / "draft.fits", scale=0.8)
    draft = upload(api, tmp_path / "draft.fits", "/v1/psfs")
    deleted = api.post(f"/psfs/{draft}/delete", follow_redirects=False)
    assert deleted.status_code == 303 and deleted.headers["location"] == "/psfs"
    assert api.get(f"/v1/psfs/{draft}").status_code == 404


def test_a_form_says_whether_a_series_may_be_interpolated(
    api: TestClient, psf_id: str, tmp_path: Path
) -> None:
    address, series = f"/psfs/{psf_id}/series", "/v1/series/hri_euv/174/total"
    allow = {"interpolated": "true", "reason": "the mirrors age"}
    refused = api.post(address, data=allow, headers=PERSON)
    assert refused.status_code in (404, 409), "no PSF of the series was certified"
    assert address not in api.get(f"/psfs/{psf_id}").text
    assert certify(api, psf_id, "1.0.0") == 303
    page = api.get(f"/psfs/{psf_id}").text
    assert address in page and "Allow interpolation" in page and "are not interpolated" in page

    page = api.post(address, data=allow, headers=PERSON).text
    assert "Forbid interpolation" in page and "may be interpolated" in page and "the mirrors age" in page
    assert api.get(series).json()["interpolated"] is True
    page = api.post(address, data={"interpolated": "false"}, headers=PERSON).text
    assert "Allow interpolation" in page and api.get(series).json()["interpolated"] is False
    write_psf(tmp_path / "part.fits", scale=0.7)
    part = upload(api, tmp_path / "part.fits", "/v1/psfs")
    assert certify(api, part, "1.0.0", kind="diffraction") == 303
    assert f"/psfs/{part}/series" not in api.get(f"/psfs/{part}").text, "only total PSFs are interpolated"
    wrong = api.post(address, data={"interpolated": "perhaps"}, headers=PERSON)
    assert wrong.status_code == 422 and "interpolated: " in wrong.text.lower()


def test_forms_are_shown_by_scope(settings: Settings, psf_file: Path) -> None:
    with keyed(settings) as service:
        psf_id = upload(service.client("ann"), psf_file, "/v1/psfs")
        reader = browser(service, service.key("ann", Scope.READ))
        assert "Upload a whole PSF" not in reader.get("/psfs").text
        page = reader.get(f"/psfs/{psf_id}").text
        assert "/status" not in page and "/delete" not in page and "/tables" not in page
        refused = reader.post(f"/psfs/{psf_id}/status", data={"status": "certified"}, headers=OWN_PAGE)
        assert refused.status_code == 403 and "certify" in refused.text
        certifier = browser(service, service.key("ann", Scope.READ, Scope.CERTIFY))
        page = certifier.get(f"/psfs/{psf_id}").text
        assert f"/psfs/{psf_id}/status" in page and "/delete" not in page
        assert f"/psfs/{psf_id}/series" not in page, "no PSF of the series was certified"
        allow = {"interpolated": "true"}
        assert reader.post(f"/psfs/{psf_id}/series", data=allow, headers=OWN_PAGE).status_code == 403
        assert browser(service, service.key("bob")).get(f"/psfs/{psf_id}").status_code == 404


def test_the_products_of_a_psf_are_listed(
    api: TestClient, run_jobs: Callable[[], None], psf_id: str, image_file: Path
) -> None:
    assert "No product was made" in api.get(f"/psfs/{psf_id}/products").text
    image_id = upload(api, image_file)
    parameters = {"image_id": image_id, "psf_id": psf_id, "method": {"name": "linear"}}
    job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters}).json()
    run_jobs()
    product = api.get(f"/v1/jobs/{job['id']}").json()["result"].removeprefix("/v1")
    assert product in api.get(f"/psfs/{psf_id}/products").text


# --- two PSFs compared ----------------------------------------------------------------------------------


SCALE = 0.5


@pytest.fixture
def both(api: TestClient, tmp_path: Path) -> tuple[str, str]:
    write_psf(tmp_path / "one.fits")
    write_psf(tmp_path / "other.fits", scale=SCALE)
    one, other = (upload(api, tmp_path / f"{name}.fits", "/v1/psfs") for name in ("one", "other"))
    return one, other


def test_the_ratio_of_two_psfs_of_one_shape_is_their_scale(
    api: TestClient, run_jobs: Callable[[], None], both: tuple[str, str]
) -> None:
    address = f"/psfs/{both[0]}/vs/{both[1]}"
    assert "The curves cannot be compared." in api.get(address).text
    for psf_id in both:
        api.post(f"/psfs/{psf_id}/tables")
    run_jobs()
    page = api.get(address).text
    assert page.count("data-plot") == 4
    ratio = page[page.index("Ratio of the mean weights") :].split("<tbody>")[1].split("</tbody>")[0]
    cells = re.findall(r'<td class="number">([^<]*)</td></tr>', ratio)
    assert len(cells) > 10
    assert all(float(cell) == pytest.approx(SCALE, rel=1e-4) for cell in cells if cell)


def view(**details: object) -> PsfView:
    whole = {"shape": [64, 64], "sum": 1.0, "provenance": {}} | details
    of_psf = {
        "instrument": "hri_euv",
        "channel": "174",
        "kind": "total",
        "status": PsfStatus.DRAFT,
        "origin": "built",
    }
    unset = dict.fromkeys(("valid_from", "valid_to", "successor", "preview", "report"))
    known = {"id": "ab" * 32, "created_at": 0.0, "name": "small", "version": "1.0.0", "bytes": 1, "file": ""}
    return PsfView.model_validate({**of_psf, **unset, **known, "was_certified": False, "details": whole})


def test_only_what_differs_is_listed() -> None:
    text = 'name = "a"\n[[mirrors]]\nname = "primary"\nradius_mm = {}\nconic = -1.0\n'
    one = view(
        provenance={"parameters": {"size": 64, "seed": 1}, "job_id": "x", "instrument_toml": text.format(1)}
    )
    other = view(
        provenance={"parameters": {"size": 128, "seed": 1}, "job_id": "y", "instrument_toml": text.format(2)}
    )
    assert differing(psf_parameters(one), psf_parameters(other)) == [
        ("parameters.size", "64", "128"),
        ("instrument file: mirrors primary.radius_mm", "1", "2"),
    ]
