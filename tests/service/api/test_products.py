"""Thumbnails of products over HTTP."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from matplotlib.image import imread
from sqlalchemy import update

from psfcore.drawing.thumbnail import write_thumbnail
from psfcore.fits.header import FitsLimits
from psfcore.fits.images import read_plane
from tests.service.conftest import upload
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow
from workers.files.intact import intact
from workers.files.store import Store
from workers.settings import Settings


@pytest.fixture
def catalogue(api: TestClient) -> Catalogue:
    found = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]
    assert isinstance(found, Catalogue)
    return found


@pytest.fixture
def product(
    api: TestClient, image_file: Path, psf_file: Path, run_jobs: Callable[[], None]
) -> dict[str, Any]:
    parameters = {"image_id": upload(api, image_file), "psf_id": upload(api, psf_file, "/v1/psfs")}
    parameters |= {"method": {"name": "richardson-lucy", "steps": 2}}
    job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters}).json()
    run_jobs()
    return dict(api.get(api.get(f"/v1/jobs/{job['id']}").json()["result"]).json())


def test_a_product_has_a_thumbnail(api: TestClient, product: dict[str, Any], tmp_path: Path) -> None:
    answer = api.get(product["thumbnail"])
    digest = product["details"]["thumbnail_sha256"]
    assert answer.status_code == 200 and answer.headers["Content-Type"] == "image/png"
    assert answer.headers["ETag"] == f'"{digest}"' and "immutable" in answer.headers["Cache-Control"]
    assert api.get(product["thumbnail"], headers={"If-None-Match": f'"{digest}"'}).status_code == 304
    (tmp_path / "product.fits").write_bytes(api.get(product["file"]).content)
    pixels = read_plane(tmp_path / "product.fits", FitsLimits(max_pixels=512 * 512))
    (tmp_path / "picture.png").write_bytes(answer.content)
    write_thumbnail(pixels, tmp_path / "expected.png")
    difference = abs(imread(tmp_path / "picture.png") - imread(tmp_path / "expected.png"))
    assert difference.max() < 0.03  # the file has 32-bit numbers, the picture was made from 64-bit ones


def test_a_product_without_a_thumbnail_says_so(
    api: TestClient, product: dict[str, Any], catalogue: Catalogue
) -> None:
    details = {name: value for name, value in product["details"].items() if name != "thumbnail_sha256"}
    older = update(ProductRow).where(ProductRow.id == product["id"]).values(details=details)
    catalogue._database.change(older)
    answer = api.get(f"/v1/products/{product['id']}/thumbnail")
    assert answer.status_code == 404 and answer.json()["type"] == "urn:heliopsf:no-thumbnail"
    assert "made before products had one" in answer.json()["detail"]
    assert api.get(f"/v1/products/{product['id']}").json()["thumbnail"] is None


def test_a_lost_thumbnail_is_found(
    api: TestClient, product: dict[str, Any], catalogue: Catalogue, settings: Settings
) -> None:
    store, digest = Store(settings.data_dir), product["details"]["thumbnail_sha256"]
    row = catalogue.get(ProductRow, product["id"], DEFAULT_OWNER)
    assert row is not None and intact(store, row) and digest in set(catalogue.named_files.all())
    store.path(digest).unlink()
    assert not intact(store, row) and api.get(product["thumbnail"]).status_code == 410


def test_a_deleted_product_leaves_no_thumbnail(
    api: TestClient, product: dict[str, Any], settings: Settings
) -> None:
    store, digest = Store(settings.data_dir), product["details"]["thumbnail_sha256"]
    assert store.size(digest)
    assert api.delete(f"/v1/products/{product['id']}").status_code == 204
    assert store.size(digest) is None
