"""The pages of transits: upload, the check of transit.json, and the jobs that a form starts.
The pages of reports: the sections and figures of a stored report, and curves and tables from its numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from psfcore.transit.archive import pack
from service.app import create_app
from tests.conftest import SMALL_INSTRUMENT
from tests.fitted_transit import copied_data, fitted_transit
from tests.html_page import read_page
from tests.service.conftest import result_of, settings_in, upload
from tests.service.keyed import keyed
from tests.service.pages.gap_report import GAP_ID, keep_gap_report
from tests.service.pages.test_login import PERSON, browser
from tests.transit_files import write_transit
from workers.catalogue.access import Scope
from workers.settings import Settings


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    pack(write_transit(tmp_path / "mercury", images=4), tmp_path / "mercury.tar")
    return tmp_path / "mercury.tar"


@pytest.fixture
def transit_id(api: TestClient, archive: Path) -> str:
    return upload(api, archive, "/v1/transits")


def test_an_upload_by_the_form_leads_to_the_page_of_the_transit(api: TestClient, archive: Path) -> None:
    assert "There are no transits yet" in api.get("/transits").text
    answer = api.post(
        "/transits", files={"file": ("mercury.tar", archive.read_bytes())}, follow_redirects=False
    )
    assert answer.status_code == 303
    page = api.get(answer.headers["location"]).text
    assert "<h1>mercury.tar</h1>" in page and "4 in 2 pointings" in page and "read noise 2 DN" in page
    assert "003.fits" in page and "mercury.tar" in api.get("/transits").text
    refused = api.post("/transits", files={"file": ("x.zip", b"no archive")}, headers=PERSON)
    assert refused.status_code == 415 and refused.headers["content-type"].startswith("text/html")


def test_a_manifest_is_checked_before_its_files_are_sent(api: TestClient, tmp_path: Path) -> None:
    manifest = write_transit(tmp_path / "mercury", images=4) / "transit.json"
    content = json.loads(manifest.read_text())
    names = [one["file"] for one in content["images"]]
    assert set(names) <= set(api.post("/transits/check", content=manifest.read_bytes()).json())
    for image in content["images"]:
        image["r"] = -1
    del content["images"][1]["x"]
    answer = api.post("/transits/check", content=json.dumps(content).encode())
    assert answer.status_code == 422 and answer.json()["type"].endswith("bad-manifest")
    told = answer.json()["detail"]
    assert all(name in told for name in names) and "no such key" in told, "all faults are named"
    assert api.post("/transits/check", content=b"{").status_code == 422


def test_a_form_starts_a_job_with_its_options(api: TestClient, transit_id: str) -> None:
    for kind, form, expected in (
        ("psf-fit", {"shape": "core", "seed": "7"}, {"shape": "core", "seed": 7, "as_published": False}),
        ("cross-validate", {"runs": "3", "scheme": "exact"}, {"runs": 3, "scheme": "exact"}),
        ("report", {"psf_id": "", "shapes": "1"}, {"shapes": True, "dark_offsets": False, "psf_id": None}),
        (
            "gap-diagnose",
            {"correct": "1", "photon_gain_dn": "5", "read_noise_dn": "1.5"},
            {"correct": True, "noise": {"photon_gain_dn": 5.0, "read_noise_dn": 1.5}},
        ),
    ):
        assert f'action="/transits/{transit_id}/jobs/{kind}"' in api.get(f"/transits/{transit_id}").text
        answer = api.post(f"/transits/{transit_id}/jobs/{kind}", data=form, follow_redirects=False)
        assert answer.status_code == 303, answer.text
        job = api.get("/v1" + answer.headers["location"]).json()
        assert job["kind"] == kind and job["parameters"]["transit_id"] == transit_id
        assert {name: job["parameters"].get(name) for name in expected} == expected


def test_wrong_options_and_kinds_are_told_on_a_page(api: TestClient, transit_id: str) -> None:
    for kind, form, told, status in (
        ("psf-fit", {"seed": "soon"}, "Seed: ", 422),
        ("psf-fit", {"photon_gain_dn": "six"}, "Photon gain (DN): ", 422),
        ("deconvolve", {}, "Expected one of psf-fit", 404),
    ):
        answer = api.post(f"/transits/{transit_id}/jobs/{kind}", data=form, headers=PERSON)
        assert answer.status_code == status and told in answer.text, kind
        assert answer.headers["content-type"].startswith("text/html")


def test_readers_see_no_forms_and_other_owners_nothing(settings: Settings, archive: Path) -> None:
    with keyed(settings) as service:
        transit_id = upload(service.client("ann"), archive, "/v1/transits")
        page = browser(service, service.key("ann", Scope.READ)).get(f"/transits/{transit_id}")
        assert page.status_code == 200 and "/jobs/psf-fit" not in page.text
        bob = browser(service, service.key("bob"))
        assert bob.get(f"/transits/{transit_id}").status_code == 404
        assert transit_id not in bob.get("/transits").text


# --- a report -------------------------------------------------------------------------------------------


def test_a_gap_report_is_shown_with_its_sentence_map_sections_and_figures(
    api: TestClient, settings: Settings
) -> None:
    gap = keep_gap_report(settings)
    page = api.get(f"/reports/{GAP_ID}").text
    places = [
        page.index(text)
        for text in (
            gap["lines"][0][:16],
            "What was found",
            "The discs, on the",
            "Where the gap lies",
            "Which effect causes the gap",
        )
    ]
    assert places == sorted(places)
    assert page.count("<circle") == sum(image["residual_pct"] is not None for image in gap["images"]) > 5
    tags = read_page(page)  # every tag is closed in the right order
    assert next(t.text for t in tags if t.name == "h1").startswith("Gap between model and images of")
    assert next(t.text.replace("\xa0", " ") for t in tags if t.name == "strong") == gap["lines"][0]
    assert {"h2", "dt", "figcaption", "summary", "td"} <= {t.name for t in tags}
    assert "data:image" not in page and "style=" not in page and "<style" not in page
    download = api.get(f"/v1/reports/{GAP_ID}/page").text
    count = download.count("data:image/png")
    assert count > 3 and page.count(f'src="/reports/{GAP_ID}/figures/') == count
    answer = api.get(f"/reports/{GAP_ID}/figures/{count}")
    assert answer.headers["content-type"] == "image/png" and answer.content.startswith(b"\x89PNG")
    again = api.get(f"/reports/{GAP_ID}/figures/{count}", headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304
    for number in (0, count + 1):
        missing = api.get(f"/reports/{GAP_ID}/figures/{number}", headers=PERSON)
        assert missing.status_code == 404 and f"from 1 to {count}" in missing.text
    assert api.get(f"/reports/{'0' * 64}", headers=PERSON).status_code == 404
    # The map and the table of residuals show the numbers of the report, in the order of time.
    first = min(
        (one for one in gap["images"] if one["residual_pct"] is not None), key=lambda one: one["time_s"]
    )
    disc = next(t.attributes for t in tags if t.name == "circle")
    ny, nx = gap["shape"]
    place = first["x_px"] / max(nx, ny), (ny - first["y_px"]) / max(nx, ny)
    assert (float(disc["cx"]) / 400, float(disc["cy"]) / 400) == pytest.approx(place, abs=1e-3)
    assert (disc["fill"] == "#b2182b") == (first["residual_pct"] > 0)
    assert f"{first['residual_pct']:+.2f} ± {first['noise_pct']:.2f} %" in disc["data-told"]
    table = page[page.index("Residuals of the held-out discs") :].split("<tbody>")[1].split("</tr>")[0]
    cells = [float(cell) for cell in re.findall(r'<td class="number">([^<]*)</td>', table)]
    shown = ("time_s", "residual_pct", "noise_pct", "residual_after_pct", "noise_after_pct")
    assert cells == pytest.approx([first[name] for name in shown], rel=1e-4)


def test_a_report_of_an_older_version_is_shown_with_a_link_to_its_page(
    api: TestClient, settings: Settings
) -> None:
    gap = keep_gap_report(settings, old=True)
    page = api.get(f"/reports/{GAP_ID}")
    assert page.status_code == 200 and gap["sentence"][:40] in page.text and page.text.count("<circle") > 5
    assert f'href="/v1/reports/{GAP_ID}/page"' in page.text and "older version" in page.text
    assert "/figures/" not in page.text
    assert api.get(f"/reports/{GAP_ID}/figures/1", headers=PERSON).status_code == 404


def shown(api: TestClient, address: str, *texts: str) -> str:
    """The page at this address, which contains these texts."""
    page = api.get(address).text
    assert [text for text in texts if text not in page] == []
    return page


def test_a_fit_and_its_cross_validation_are_shown(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    fitted = fitted_transit(tmp_path_factory)
    made = json.loads((fitted / "made.json").read_text())
    copied_data(fitted, tmp_path / "data")
    psf, folds = f"/psfs/{made['psf']['id']}", f"/reports/{made['folds']['id']}"
    with TestClient(create_app(settings_in(tmp_path / "data"))) as api:
        shown(api, psf, "Fit to the transit", "Weight of the scatter without a formula", "000.fits, pointing")
        page = shown(api, folds, "3 fits with held-out blocks", "Parameters over all folds", "/preview")
        assert "data-plot" not in page, "the picture shows the curves; they are not drawn twice"
        shown(api, f"/transits/{made['folds']['transit_id']}", psf, folds)


def test_a_rerun_is_shown(api: TestClient, run_jobs: Callable[[], None]) -> None:
    built = result_of(api, run_jobs, "psf-build", instrument_file=SMALL_INSTRUMENT, size=128)["id"]
    begun = api.post(f"/psfs/{built}/rerun", follow_redirects=False)
    run_jobs()
    rerun = api.get(f"/v1{begun.headers['location']}").json()["result"].rpartition("/")[2]
    page = shown(api, f"/reports/{rerun}", "bit for bit", "<td>equal</td>", f'href="/psfs/{built}"', "job_id")
    assert "library numpy" not in page
    shown(api, f"/psfs/{built}", f"/reports/{rerun}")
    assert api.get(f"/v1/reports/{rerun}/output").content.startswith(b"SIMPLE  =")
    (listed,) = api.get("/v1/reports", params={"about_id": built}).json()["items"]
    assert listed["id"] == rerun
