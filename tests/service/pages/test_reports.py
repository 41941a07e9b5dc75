"""The pages of reports: the sections and figures of a stored report, and curves and tables from its numbers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from tests.conftest import SMALL_INSTRUMENT
from tests.fitted_transit import copied_data, fitted_transit
from tests.html_page import read_page
from tests.service.conftest import result_of, settings_in
from tests.service.pages.gap_report import GAP_ID, keep_gap_report
from tests.service.pages.test_login import PERSON
from workers.settings import Settings


@pytest.fixture
def gap(settings: Settings, api: TestClient) -> dict[str, Any]:
    return keep_gap_report(settings)


def test_a_gap_report_is_shown_with_its_sentence_map_sections_and_figures(
    api: TestClient, gap: dict[str, Any]
) -> None:
    page = api.get(f"/reports/{GAP_ID}").text
    places = [
        page.index(text)
        for text in (
            gap["sentence"][:16],
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
    assert next(t.text.replace("\xa0", " ") for t in tags if t.name == "strong") == gap["sentence"]
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
    rerun = result_of(api, run_jobs, "rerun", of="psf", id=built)["id"]
    page = shown(api, f"/reports/{rerun}", "bit for bit", "<td>equal</td>", f'href="/psfs/{built}"', "job_id")
    assert "library numpy" not in page
    shown(api, f"/psfs/{built}", f"/reports/{rerun}")
