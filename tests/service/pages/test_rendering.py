"""What is true of every page: its policy, that it is not kept, that names are text, and errors as pages.
Forms: which fields become parameters, and how wrong ones are refused.
Which radii a table of a curve shows, and what differs between two things."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from astropy.io import fits
from fastapi.testclient import TestClient
from httpx import Response
from sqlalchemy.exc import OperationalError

from psfcore.instruments.files import instrument_names
from service.app import create_app
from service.http.problems import Problem
from service.pages.forms import job_request, number_field, parameters
from service.pages.rendering import (
    FINE_TO_PX,
    POLICY,
    RATIO,
    counted,
    date,
    dense,
    differing,
    duration,
    number,
    once,
    percent,
    size,
)
from tests.conftest import write_image, write_psf
from tests.service.conftest import upload
from tests.service.pages.test_login import PERSON
from workers.contract.requests import CrossValidate, GapDiagnose, Report
from workers.settings import Settings

SCRIPT = "<script>alert(1)</script>"
ESCAPED = "&lt;script&gt;alert(1)&lt;/script&gt;"
NOTHING = "0" * 32


# Headers --------------------------------------------------------------------------------------------


def test_a_page_has_a_policy_without_other_hosts_and_is_not_kept(api: TestClient) -> None:
    for address in ("/", "/jobs", "/nothing"):
        headers = api.get(address, headers=PERSON).headers
        assert headers["Content-Type"] == "text/html; charset=utf-8"
        assert headers["Content-Security-Policy"] == POLICY
        assert headers["Cache-Control"] == "no-store" and headers["Vary"] == "Cookie"
        assert (headers["X-Content-Type-Options"], headers["X-Frame-Options"]) == ("nosniff", "DENY")
    rules = dict(rule.strip().split(" ", 1) for rule in POLICY.split(";"))
    assert rules["default-src"] == "'none'" and rules["require-trusted-types-for"] == "'script'"
    for kind in ("script-src", "style-src", "connect-src", "form-action"):
        assert rules[kind] == "'self'"
    assert "unsafe" not in POLICY and "http" not in POLICY and "*" not in POLICY


def test_scripts_and_styles_are_kept_for_ever_under_their_version_alone(api: TestClient) -> None:
    page = api.get("/", headers=PERSON).text
    address = page.split('<link rel="stylesheet" href="')[1].split('"')[0]
    kept = api.get(address)
    assert kept.status_code == 200 and "immutable" in kept.headers["Cache-Control"]
    earlier = api.get("/static/000000000000/heliopsf.css")
    assert earlier.headers["Cache-Control"] == "no-cache" and earlier.content == kept.content
    assert api.get("/static/000000000000/passwd.css").status_code == 404


# Hostile names --------------------------------------------------------------------------------------


def test_names_that_people_and_files_choose_are_shown_as_text(
    api: TestClient, tmp_path: Path, run_jobs: Callable[[], None]
) -> None:
    write_image(tmp_path / "image.fits", TELESCOP=SCRIPT, **{"DATE-OBS": SCRIPT})
    body = (tmp_path / "image.fits").read_bytes()
    image = api.post("/v1/images", params={"filename": f"{SCRIPT}.fits"}, content=body).json()["id"]
    write_psf(tmp_path / "psf.fits")
    with fits.open(tmp_path / "psf.fits", mode="update") as file:
        file[0].header["PSFNAME"] = SCRIPT
        file[0].header["PSFVERS"] = '"><img src=x>'
    psf = upload(api, tmp_path / "psf.fits", "/v1/psfs")
    asked = {"image_id": image, "psf_id": psf, "method": {"name": "richardson-lucy", "steps": 2}}
    job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": asked}).json()["id"]
    bulk = api.post("/v1/bulk", json={"images": [image], "psf_id": psf, "name": SCRIPT}).json()["id"]
    run_jobs()
    product = api.get(f"/v1/jobs/{job}").json()["result"].removeprefix("/v1")
    shown = ""
    of_rows = (f"/images/{image}?psf_id={psf}", f"/jobs/{job}", product, f"/bulk/{bulk}")
    for address in ("/", "/jobs", "/bulk", *of_rows):
        answer = api.get(address, headers=PERSON)
        assert answer.status_code == 200, address
        assert "<script>alert" not in answer.text and "<img src=x>" not in answer.text, address
        shown += answer.text
    assert ESCAPED in shown and "&lt;img src=x&gt;" in shown, "they are shown, and not left out"


def test_an_error_shows_what_was_asked_as_text(api: TestClient) -> None:
    for address in (f"/{SCRIPT}", f"/jobs/{SCRIPT}", f"/images/{SCRIPT}", f"/jobs?cursor={SCRIPT}"):
        answer = api.get(address, headers=PERSON)
        assert answer.status_code in (404, 422), address
        assert "<script>alert" not in answer.text, address
    write = {"filename": f"{SCRIPT}.fits"}
    refused = api.post("/images", files={"file": (write["filename"], b"Dear editor" * 500)}, headers=PERSON)
    assert refused.status_code == 415 and "<script>alert" not in refused.text


# Errors ---------------------------------------------------------------------------------------------


def _away(*_: object, **__: object) -> None:
    raise OperationalError("SELECT 1", {}, Exception("the server closed the connection"))


def _broken(*_: object, **__: object) -> None:
    raise RuntimeError("secret of the service")


def _answer(
    api: TestClient, status: int, headers: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> Response:
    """The answer to a request that has an error of this status."""
    catalogue = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]
    send: dict[str, object] = {"headers": headers}
    with monkeypatch.context() as patched:
        if status in (500, 503):
            patched.setattr(catalogue, "page", _broken if status == 500 else _away)
        if status in (413, 415):
            body = b"SIMPLE  =" + bytes(3 * 2**20) if status == 413 else b"Dear editor,\n" * 500
            found = api.post("/images", files={"file": ("sun.fits", body)}, **send)  # type: ignore[arg-type]
        else:
            address = {404: f"/jobs/{NOTHING}", 422: "/jobs?cursor=none"}.get(status, "/jobs")
            found = api.get(address, **send)  # type: ignore[arg-type]
            while status == 429 and found.status_code == 200:
                found = api.get(address, **send)  # type: ignore[arg-type]
    return found


def test_an_error_is_a_page_for_people_and_a_document_for_programs(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    for status, told, kept in (
        (404, "There is nothing here", False),
        (413, "This is too large", False),
        (415, "The service cannot read this file", False),
        (422, "The service cannot do that", False),
        (429, "Too many requests", True),
        (500, "The service failed", True),
        (503, "The service cannot answer now", True),
    ):
        few = settings.model_copy(update={"reads_per_minute": 5}) if status == 429 else settings
        with TestClient(create_app(few), raise_server_exceptions=False) as api:
            answer = _answer(api, status, PERSON, monkeypatch)
            assert (answer.status_code, answer.headers["Content-Type"]) == (
                status,
                "text/html; charset=utf-8",
            )
            assert answer.headers["Content-Security-Policy"] == POLICY
            page = answer.text
            assert f"<h1>{told}" in page and f"Status {status}" in page and 'role="alert"' in page
            assert ("Nothing is lost" in page) == kept
            assert "secret" not in page and "Traceback" not in page
            answer = _answer(api, status, {"Accept": "*/*"}, monkeypatch)
            assert answer.headers["Content-Type"] == "application/problem+json"
            assert answer.json()["status"] == answer.status_code == status and answer.json()["detail"]


def test_addresses_of_the_interface_never_answer_with_pages(api: TestClient) -> None:
    for address in (f"/v1/jobs/{NOTHING}", "/v1/nothing", "/openapi.json/x"):
        answer = api.get(address, headers=PERSON)
        assert answer.status_code == 404
        assert answer.headers["Content-Type"] == "application/problem+json"


def test_the_first_page_names_the_telescopes_of_the_instrument_files(api: TestClient) -> None:
    page = api.get("/").text
    assert "SDO/AIA 94 to 335 Å, STEREO/EUVI 171 to 304 Å, Solar Orbiter EUI/HRI_EUV 174 Å" in page
    assert not [name for name in instrument_names() if name in page]


# Words ----------------------------------------------------------------------------------------------


def test_numbers_are_written_with_their_units() -> None:
    assert [size(count) for count in (999, 1000, 2.5e6, 3e9)] == ["999 B", "1 kB", "2.5 MB", "3 GB"]
    assert [duration(s) for s in (None, 0.2, 42.0, 600.0, 7200.0)] == [
        "unknown", "less than 1 s", "42 s", "10 min", "2.0 h",
    ]  # fmt: skip
    assert [percent(value) for value in (None, 3.716, -0.5)] == ["-", "+3.72\u00a0%", "-0.5\u00a0%"]
    assert [number(value, 3) for value in (None, 11_497.0, 999_600.0, 2.5e6, 0.123456, 2e-7)] == [
        "-", "11500", "1000000", "2.5e+06", "0.123", "2e-07",
    ]  # fmt: skip
    assert [counted(number, "row") for number in (0, 1, 2)] == ["0 rows", "1 row", "2 rows"]
    assert date(None) == "-"
    assert date(0.0) == '<time datetime="1970-01-01T00:00:00+00:00">1970-01-01 00:00:00 UTC</time>'


# --- forms ----------------------------------------------------------------------------------------------


def test_the_fields_of_a_request_become_its_parameters() -> None:
    form = {"shape": " core ", "seed": "", "runs": "3", "form_token": "x", "transit": "y"}
    assert parameters(CrossValidate, form) == {"shape": "core", "runs": "3"}
    assert parameters(Report, {"shapes": "1"}) == {"shapes": True, "dark_offsets": False}
    figures = {"photon_gain_dn": "6.5", "read_noise_dn": "2"}
    noise = {"photon_gain_dn": 6.5, "read_noise_dn": 2.0}
    assert parameters(GapDiagnose, {"correct": "1", **figures}) == {"correct": True, "noise": noise}
    with pytest.raises(Problem, match="photon_gain_dn: "):
        parameters(GapDiagnose, {"photon_gain_dn": "many"})


def test_an_input_has_the_limits_of_its_parameter() -> None:
    assert number_field("psf-build", "size") == 'type="number" name="size" min="64" max="4096" step="2"'
    assert number_field("deconvolve", "steps") == 'type="number" name="steps" min="1" max="1000"'


def test_a_wrong_parameter_is_named() -> None:
    job = job_request("psf-build", {"instrument": "hri_euv", "size": "128"})
    assert job.kind == "psf-build" and job.parameters.size == 128
    with pytest.raises(Problem, match="size: Input should be") as refused:
        job_request("psf-build", {"instrument": "hri_euv", "size": "wide"})
    assert refused.value.status == 422
    with pytest.raises(Problem, match=r"method: expected name to be one of richardson-lucy, .*; got 'magic'"):
        job_request("deconvolve", {"image_id": "0" * 64, "method": {"name": "magic"}})


# --- numbers of curves, and what differs ------------------------------------------------------------------


def test_radii_are_shown_densely_near_the_centre_and_in_ratios_farther_out() -> None:
    radii = [float(radius) for radius in range(1500)]
    shown = [radii[at] for at in dense(radii)]
    assert shown[: int(FINE_TO_PX) + 1] == radii[: int(FINE_TO_PX) + 1] and shown[-1] == radii[-1]
    far = [radius for radius in shown[:-1] if radius > FINE_TO_PX]
    assert all(b / a >= RATIO for a, b in pairwise(far)) and len(shown) < 150
    assert dense([]) == []


def test_only_what_differs_is_listed() -> None:
    first = {"name": "a", "libraries": {"numpy": "1", "scipy": "2"}, "mirrors": [{"name": "m1", "mm": 1}]}
    again = {"name": "a", "libraries": {"numpy": "3", "scipy": "2"}, "mirrors": [{"name": "m1"}], "id": "x"}
    changed = [("libraries.numpy", "1", "3"), ("mirrors m1.mm", "1", "-"), ("id", "-", "x")]
    assert differing(first, again) == changed and differing(first, first) == []


def test_curves_of_a_psf_that_coincide_are_one_column() -> None:
    curves = {"TOTAL": [1.0, 0.5], "AIRY": [1.0, 0.2], "DIFFRACTION": [1.0, 0.5]}
    assert once(curves) == {"AIRY": [1.0, 0.2], "TOTAL, DIFFRACTION": [1.0, 0.5]}
