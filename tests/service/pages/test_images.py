"""The page of an image: what the check of the options says, what it offers, and which options it keeps.
The page of a product: what it says of its artefact score and of its PSF, and the options that it keeps."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fastapi.testclient import TestClient
from sqlalchemy import update

from service.pages.forms import address_of
from service.pages.sentences import of_error, plain
from tests.conftest import write_image, write_psf
from tests.service.conftest import execute, result_of, upload
from tests.service.pages.test_login import PERSON
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ImageRow, ProductRow
from workers.files.store import Store

AIA = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 1600, "CDELT1": 0.6, "CDELT2": 0.6}
XRT = {
    "TELESCOP": "HINODE",
    "INSTRUME": "XRT",
    "DATE_OBS": "2012-06-05T22:00:00.123",
    "CDELT1": 1.03,
    "CDELT2": 1.03,
}
HRI = {"DETECTOR": "HRI_EUV", "WAVELNTH": 174, "CDELT1": 0.492, "CDELT2": 0.492}
FORM = {"method": "richardson-lucy", "steps": "2"}


def image(api: TestClient, tmp_path: Path, **cards: Any) -> str:
    write_image(tmp_path / "i.fits", **cards)
    identity = upload(api, tmp_path / "i.fits")
    (tmp_path / "i.fits").unlink()
    return identity


def checked(api: TestClient, image_id: str, **options: str) -> list[str]:
    """What the page says of the options; the script gets the same."""
    page = api.get(f"/images/{image_id}", params=options).text
    (box,) = re.findall(r'<div id="checked" [^>]*>(.*?)</div>', page)
    lines = [line.replace("&#39;", "'") for line in re.findall("<p>(.*?)</p>", box)]
    found = api.get(f"/images/{image_id}/check", params=options).json()
    assert found["lines"] == lines and found["button"] in page
    return lines


# What the check says --------------------------------------------------------------------------------


def test_an_image_without_a_psf_is_told_so(api: TestClient, tmp_path: Path) -> None:
    xrt = image(api, tmp_path, **XRT)
    line, upload_one, _ = checked(api, xrt)
    assert (
        line.startswith("No PSF for Hinode/XRT is known here: ")
        and "mirrors" in line
        and "Upload a PSF here" in line
    )
    assert "xrt_560ev_2017" in upload_one and "xrt_1kev_2017" in upload_one, "as the command names them"
    page = api.get(f"/images/{xrt}").text
    assert "none: choose a PSF" in page and "chosen for this image" not in page
    assert "2012-06-05T22:00:00.123" in page
    assert f'action="/psfs?image={xrt}"' in page, "a PSF is uploaded here"


def test_an_error_plane_needs_no_figures_and_the_form_takes_them(api: TestClient, tmp_path: Path) -> None:
    hri = image(api, tmp_path, **HRI)
    before = checked(api, hri, error_draws="8")[0]
    assert re.match(r"PSF hri_euv 0\.2\.0-draft\+[0-9a-f]{8}, built for", before)
    figures = {"photon_gain_dn": "4", "read_noise_dn": "1.5"}
    assert checked(api, hri, error_draws="8", **figures)[0] == before
    sent = api.post(f"/images/{hri}/start", data={"error_draws": "8", **figures}, follow_redirects=False)
    job = api.get(f"/v1{sent.headers['location']}").json()
    assert job["parameters"]["noise"] == {"photon_gain_dn": 4.0, "read_noise_dn": 1.5}
    assert checked(api, hri, photon_gain_dn="four")[0].startswith("Photon gain (DN): ")
    assert checked(api, hri, error_draws="1") == [
        "Noise realisations: expected 0, or 2 or more; got 1: the spread cannot be estimated from one realisation."
    ]


# What is kept ---------------------------------------------------------------------------------------


def test_a_refused_start_leads_back_with_its_options(api: TestClient, tmp_path: Path) -> None:
    xrt = image(api, tmp_path, **XRT)
    answer = api.post(f"/images/{xrt}/start", data={**FORM, "again": "1"}, follow_redirects=False)
    assert answer.status_code == 303
    assert answer.headers["location"] == f"/images/{xrt}?method=richardson-lucy&steps=2&again=1"
    assert 'name="steps" min="1" max="1000" value="2"' in api.get(answer.headers["location"]).text
    assert api.get("/v1/jobs").json()["items"] == []


def test_a_failed_job_leads_to_its_options(
    api: TestClient, psf_file: Path, tmp_path: Path, run_jobs: Callable[[], None]
) -> None:
    psf = upload(api, psf_file, "/v1/psfs")
    given = {
        **FORM,
        "psf_id": psf,
        "error_draws": "2",
        "photon_gain_dn": "4",
        "read_noise_dn": "1.5",
        "again": "1",
    }
    sent = api.post(f"/images/{image(api, tmp_path)}/start", data=given, follow_redirects=False)
    page = api.get(sent.headers["location"]).text
    (kept,) = re.findall(r'href="(/images/[^"]*)">Change the request', page)
    query = kept.replace("&amp;", "&").partition("?")[2]
    assert dict(part.split("=") for part in query.split("&")) == given


def test_a_psf_that_the_service_chose_is_chosen_again() -> None:
    made = {"image_id": "1" * 64, "psf_id": "2" * 64, "method": {"name": "linear", "steps": 5}}
    for name, value in (("picked_for", "hri_euv"), ("psf_recipe", {"instrument": "hri_euv"})):
        assert "psf_id" not in address_of(made | {name: value})
    assert "psf_id=2222" in address_of(made)


# Sentences ------------------------------------------------------------------------------------------


def test_a_message_becomes_a_sentence_without_words_for_programs() -> None:
    assert (
        plain("expected one PSF (psf_id in a request, --psf in a command); got two")
        == "Expected one PSF; got two."
    )
    assert plain("use it (--again, in a request again = true)") == "Use it."
    assert plain("expected 2 axes (NAXIS); got 3!") == "Expected 2 axes (NAXIS); got 3!"
    assert plain("") == ""


def test_an_error_with_and_without_its_fields() -> None:
    for code, message, told in (
        ("no-such-psf", "expected the id of a PSF; got x", "There is no such PSF here."),
        ("channel-mismatch", "expected an image; got another", "Expected an image; got another."),
        ("invalid-request", "error_draws: x; valid_from: y", "Noise realisations: x; Valid from: y."),
        ("bad-key", "this key has expired", "This key has expired."),
        ("not-fits", "expected a FITS file, got b'\\x00'", "This file is not a FITS file"),
    ):
        assert of_error(code, message).startswith(told)
    fields = {"psf": "aia", "psf_arcsec": 0.6, "image_arcsec": "2.4 x 2.4", "factor": 4}
    assert "rebin PSF.fits --factor 4" in of_error("plate-scale-mismatch", "", fields)
    assert "rebin" not in of_error("plate-scale-mismatch", "", fields | {"factor": None})


def test_a_wrong_address_is_a_sentence(api: TestClient) -> None:
    page = api.get("/images/short", headers=PERSON).text
    assert "/images/short is not the address of a page." in page and "String should match" not in page


# --- a product ------------------------------------------------------------------------------------------


def test_a_high_artefact_score_comes_with_advice(
    api: TestClient, catalogue: Catalogue, image_file: Path, psf_file: Path, run_jobs: Callable[[], None]
) -> None:
    image, psf = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    method = {"name": "linear", "steps": 2}
    request = {"image_id": image, "psf_id": psf, "method": method, "again": True}
    api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": request})
    run_jobs()
    (product,) = api.get("/v1/products").json()["items"]
    again = f"/images/{image}?psf_id={psf}&amp;method=linear&amp;steps=2&amp;again=1"
    for score, advised in ((0.99, False), (1.0, True)):
        details = product["details"] | {"changes": {"artefacts": {"score": score}}}
        execute(catalogue, update(ProductRow).values(details=details))
        page = api.get(f"/products/{product['id']}").text
        sheet = api.get(f"/products/{product['id']}/print").text
        for text in (page, sheet):
            assert ("The artefact score is 1, which is 1 or more" in text) == advised, score
        assert page.count(f'href="{again}"') == 1 + advised, score
    assert "<dd>linear, 2 steps</dd>" in page


def sentences(page: str) -> list[str]:
    """The notes of a page, without tags."""
    notes = re.findall(r'<p class="note">(.*?)</p>', page, re.DOTALL)
    return [html.unescape(" ".join(re.sub("<[^>]+>", "", note).split())) for note in notes]


def test_a_product_whose_psf_was_deprecated_says_what_to_do(
    api: TestClient, image_file: Path, psf_file: Path, tmp_path: Path, run_jobs: Callable[[], None]
) -> None:
    image, psf = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    line = {"instrument": "hri_euv", "channel": "174", "kind": "total"}
    certified = {"status": "certified", "version": "1.0.0", **line}
    assert api.post(f"/v1/psfs/{psf}/status", json=certified).status_code == 200
    method = {"name": "linear", "steps": 2}

    def told(product: str) -> list[str]:
        return [one for one in sentences(api.get(f"/products/{product}").text) if "deprecated" in one]

    asked = {"image_id": image, "psf_id": psf, "method": method, "other_channel": True}
    before = result_of(api, run_jobs, "deconvolve", **asked)["id"]
    assert told(before) == []
    wrong = {"status": "deprecated", "reason": "a <b>wrong</b> mesh"}
    assert api.post(f"/v1/psfs/{psf}/status", json=wrong).status_code == 200
    (said,) = told(before)
    assert "(reason: a <b>wrong</b> mesh)" in said and "no replacement" in said
    assert f'<a href="/images/{image}?method=linear' in api.get(f"/products/{before}").text

    write_psf(tmp_path / "next.fits", scale=0.9)
    better = upload(api, tmp_path / "next.fits", "/v1/psfs")
    assert api.post(f"/v1/psfs/{better}/status", json=certified | {"version": "2.0.0"}).status_code == 200
    named = {"status": "deprecated", "successor": better}
    assert api.post(f"/v1/psfs/{psf}/status", json=named).status_code == 200
    name = api.get(f"/v1/psfs/{better}").json()["name"]
    page = api.get(f"/products/{before}").text
    (said,) = told(before)
    assert f"its replacement is {name} 2.0.0" in said
    assert f'<a href="/psfs/{better}">{name} 2.0.0</a>' in page
    assert f'<a href="/images/{image}?psf_id={better}&amp;method=linear&amp;steps=2' in page
    assert f'<a href="/psfs/{psf}">PSF of this product</a>' in page


def test_lost_and_deleted_files_are_told(
    api: TestClient, catalogue: Catalogue, image_file: Path, psf_file: Path, run_jobs: Callable[[], None]
) -> None:
    ids = {"image_id": upload(api, image_file), "psf_id": upload(api, psf_file, "/v1/psfs")}
    product = result_of(api, run_jobs, "deconvolve", **ids, method={"name": "linear", "steps": 1})
    store: Store = api.app.state.heliopsf.store  # type: ignore[attr-defined]
    address, image = f"/products/{product['id']}", f"/images/{ids['image_id']}"
    page = api.get(address).text
    assert f'data-before="/v1{image}"' in page and 'role="alert"' not in page

    store.path(ids["image_id"]).unlink()
    page = api.get(address).text
    assert "The file of the uploaded image is lost" in page and 'role="alert"' in page
    assert "data-before" not in page and 'data-after="' in page and 'id="blink"' not in page
    store.path(product["sha256"]).unlink()
    page = api.get(address).text
    assert "The file of this product is lost." in page and 'id="viewer"' not in page

    deleted = api.post(f"{address}/delete", follow_redirects=False)
    assert (deleted.status_code, deleted.headers["location"]) == (303, image)
    assert api.get(address, headers=PERSON).status_code == 404
    upload(api, image_file)
    again = result_of(api, run_jobs, "deconvolve", **ids, method={"name": "linear", "steps": 1})
    assert again["id"] == product["id"]
    catalogue.delete(ImageRow, ids["image_id"], DEFAULT_OWNER)
    assert "The uploaded image was deleted" in api.get(address).text
    assert api.post(f"{address}/delete", follow_redirects=False).headers["location"] == "/"
