"""Two PSFs compared: curves, ratio, and only the parameters that differ."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.pages.psfs import differences
from service.views import PsfView
from tests.conftest import write_psf
from tests.service.conftest import upload
from tests.service.pages.test_login import PERSON
from workers.versions import PsfStatus

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


def test_the_form_leads_to_the_comparison(api: TestClient, both: tuple[str, str]) -> None:
    page = api.get(f"/psfs/{both[0]}").text
    assert f'action="/psfs/{both[0]}/vs"' in page and f'value="{both[1]}"' in page
    answer = api.get(f"/psfs/{both[0]}/vs?other={both[1]}", follow_redirects=False)
    assert answer.status_code == 303 and answer.headers["location"] == f"/psfs/{both[0]}/vs/{both[1]}"
    assert api.get(f"/psfs/{both[0]}/vs/{'0' * 64}", headers=PERSON).status_code == 404


def view(**details: object) -> PsfView:
    whole = {"shape": [64, 64], "sum": 1.0, "provenance": {}} | details
    return PsfView(
        id="ab" * 32,
        created_at=0.0,
        name="small",
        version="1.0.0",
        instrument="hri_euv",
        channel="174",
        kind="total",
        status=PsfStatus.DRAFT,
        was_certified=False,
        valid_from=None,
        valid_to=None,
        successor=None,
        origin="built",
        bytes=1,
        details=whole,
        file="",
        preview=None,
        report=None,
    )


def test_only_what_differs_is_listed() -> None:
    text = 'name = "a"\n[[mirrors]]\nname = "primary"\nradius_mm = {}\nconic = -1.0\n'
    one = view(
        provenance={"parameters": {"size": 64, "seed": 1}, "job_id": "x", "instrument_toml": text.format(1)}
    )
    other = view(
        provenance={"parameters": {"size": 128, "seed": 1}, "job_id": "y", "instrument_toml": text.format(2)}
    )
    assert differences(one, other) == [
        ("parameters.size", "64", "128"),
        ("instrument file: mirrors primary.radius_mm", "1", "2"),
    ]
    assert differences(one, one) == []
    assert differences(one, view()) and ("parameters.seed", "1", "-") in differences(one, view())
