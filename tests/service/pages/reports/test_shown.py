"""The pages of reports: what a stored report says, its figures, and its download."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from psfcore.transit.archive import pack
from tests.conftest import SMALL_INSTRUMENT
from tests.service.conftest import upload
from tests.service.pages.gap_report import GAP_ID, keep_gap_report
from tests.service.pages.test_login import PERSON
from tests.transit_files import write_simulated
from workers.settings import Settings


@pytest.fixture
def settings(settings: Settings) -> Settings:
    """Settings that allow PSFs of full size, which a rerun reads."""
    return settings.model_copy(update={"max_pixels": 4096**2})


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


def test_a_fit_its_cross_validation_and_a_rerun_are_shown(
    api: TestClient, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    pack(write_simulated(tmp_path / "transit"), tmp_path / "t.tar")
    transit_id = upload(api, tmp_path / "t.tar", "/v1/transits")

    def made(kind: str, **parameters: object) -> str:
        job = api.post("/v1/jobs", json={"kind": kind, "parameters": parameters}).json()
        run_jobs()
        job = api.get(f"/v1/jobs/{job['id']}").json()
        assert job["phase"] == "COMPLETED", job["error"]
        return str(job["result"].removeprefix("/v1"))

    def shown(address: str, *texts: str) -> str:
        page = api.get(address).text
        assert [text for text in texts if text not in page] == []
        return page

    psf = made("psf-fit", transit_id=transit_id)
    shown(psf, "Fit to the transit", "Weight of the scatter without a formula", "000.fits, pointing")
    folds = made("cross-validate", transit_id=transit_id, runs=1)
    shown(folds, "3 fits with held-out blocks", "Parameters over all folds", "run 0, fold 2")
    shown(f"/transits/{transit_id}", psf, folds)
    built = made("psf-build", instrument_file=SMALL_INSTRUMENT, size=128)
    rerun = made("rerun", of="psf", id=built.removeprefix("/psfs/"))
    page = shown(rerun, "bit for bit", "<td>equal</td>", f'href="{built}"', "job_id")
    assert "library numpy" not in page
    shown(built, rerun)
