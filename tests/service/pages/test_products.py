"""The page of a product: what it says of its artefact score, and the options that it keeps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import create_engine, update

from tests.service.conftest import upload
from workers.catalogue.tables import ProductRow
from workers.settings import Settings

ADVICE = "The artefact score is 1 or more: the deconvolution may have made artefacts."


@pytest.mark.parametrize(("score", "advised"), [(0.99, False), (1.0, True), (3.5, True), (None, False)])
def test_a_high_artefact_score_comes_with_advice(
    api: TestClient,
    settings: Settings,
    image_file: Path,
    psf_file: Path,
    run_jobs: Callable[[], None],
    score: float | None,
    advised: bool,
) -> None:
    image, psf = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    method = {"name": "linear", "steps": 2}
    asked = {"image_id": image, "psf_id": psf, "method": method, "again": True}
    api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": asked})
    run_jobs()
    (product,) = api.get("/v1/products").json()["items"]
    changes = {"artefacts": {"score": score}}
    engine = create_engine(settings.catalogue_url)
    with engine.begin() as connection:
        details = product["details"] | {"changes": changes}
        connection.execute(update(ProductRow).values(details=details))
    engine.dispose()
    page = api.get(f"/products/{product['id']}").text
    assert (ADVICE in page) == advised
    again = f"/images/{image}?psf_id={psf}&amp;method=linear&amp;steps=2&amp;again=1"
    assert page.count(f'href="{again}"') == 1 + advised
