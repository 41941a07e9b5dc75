"""The page of a product: what it says of its artefact score and of its PSF, and the options that it keeps."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from pathlib import Path

from fastapi.testclient import TestClient
from sqlalchemy import create_engine, select, update

from tests.conftest import write_psf
from tests.service.conftest import upload
from workers.catalogue.tables import ProductRow
from workers.settings import Settings


def test_a_high_artefact_score_comes_with_advice(
    api: TestClient, settings: Settings, image_file: Path, psf_file: Path, run_jobs: Callable[[], None]
) -> None:
    image, psf = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    method = {"name": "linear", "steps": 2}
    request = {"image_id": image, "psf_id": psf, "method": method, "again": True}
    api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": request})
    run_jobs()
    (product,) = api.get("/v1/products").json()["items"]
    again = f"/images/{image}?psf_id={psf}&amp;method=linear&amp;steps=2&amp;again=1"
    engine = create_engine(settings.catalogue_url)
    for score, advised in ((0.99, False), (1.0, True)):
        details = product["details"] | {"changes": {"artefacts": {"score": score}}}
        with engine.begin() as connection:
            connection.execute(update(ProductRow).values(details=details))
        page = api.get(f"/products/{product['id']}").text
        assert ("The artefact score is 1 or more" in page) == advised, score
        assert page.count(f'href="{again}"') == 1 + advised, score
    assert "<dd>linear, 2 steps</dd>" in page
    engine.dispose()


def sentences(page: str) -> list[str]:
    """The notes of a page, without tags."""
    notes = re.findall(r'<p class="note">(.*?)</p>', page, re.DOTALL)
    return [html.unescape(" ".join(re.sub("<[^>]+>", "", note).split())) for note in notes]


def test_a_product_whose_psf_was_deprecated_says_what_to_do(
    api: TestClient,
    settings: Settings,
    image_file: Path,
    psf_file: Path,
    tmp_path: Path,
    run_jobs: Callable[[], None],
) -> None:
    image, psf = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    line = {"instrument": "hri_euv", "channel": "174", "kind": "total"}
    certified = {"status": "certified", "version": "1.0.0", **line}
    assert api.post(f"/v1/psfs/{psf}/status", json=certified).status_code == 200
    method = {"name": "linear", "steps": 2}

    def made(**more: object) -> str:
        asked = {"image_id": image, "psf_id": psf, "method": method, "other_channel": True, **more}
        job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": asked}).json()
        run_jobs()
        return str(api.get(f"/v1/jobs/{job['id']}").json()["result"].rpartition("/")[2])

    def told(product: str) -> list[str]:
        return [one for one in sentences(api.get(f"/products/{product}").text) if "deprecated" in one]

    before = made()
    assert told(before) == []
    wrong = {"status": "deprecated", "reason": "a <b>wrong</b> mesh"}
    assert api.post(f"/v1/psfs/{psf}/status", json=wrong).status_code == 200
    assert told(before) == [
        "The PSF of this product is deprecated (reason: a <b>wrong</b> mesh), and it has no replacement: "
        "deconvolve the image again with another PSF."
    ]
    assert f'<a href="/images/{image}?method=linear' in api.get(f"/products/{before}").text

    write_psf(tmp_path / "next.fits", scale=0.9)
    better = upload(api, tmp_path / "next.fits", "/v1/psfs")
    assert api.post(f"/v1/psfs/{better}/status", json=certified | {"version": "2.0.0"}).status_code == 200
    named = {"status": "deprecated", "successor": better}
    assert api.post(f"/v1/psfs/{psf}/status", json=named).status_code == 200
    name = api.get(f"/v1/psfs/{better}").json()["name"]
    expected = (
        f"The PSF of this product is deprecated (reason: a <b>wrong</b> mesh), and its replacement is {name} 2.0.0: "
        "deconvolve the image again with the replacement."
    )
    page = api.get(f"/products/{before}").text
    assert told(before) == [expected]
    assert f'<a href="/psfs/{better}">{name} 2.0.0</a>' in page
    assert f'<a href="/images/{image}?psf_id={better}&amp;method=linear&amp;steps=2' in page
    assert f'<a href="/psfs/{psf}">PSF of this product</a>' in page

    after = made(method={"name": "linear", "steps": 1})
    engine = create_engine(settings.catalogue_url)
    with engine.connect() as connection:
        kept = connection.scalar(select(ProductRow.details).where(ProductRow.id == after))["warnings"]
    engine.dispose()
    assert "psf-deprecated" in {one["code"] for one in kept}, "this product was made with the warning"
    assert told(after) == [expected] and "was deprecated (" not in "".join(
        sentences(api.get(f"/products/{after}").text)
    )
