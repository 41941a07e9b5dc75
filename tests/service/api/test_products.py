"""Thumbnails of products over HTTP."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fastapi.testclient import TestClient
from matplotlib.image import imread

from psfcore.drawing.thumbnail import write_thumbnail
from psfcore.fits.header import FitsLimits
from psfcore.fits.images import read_plane
from tests.service.conftest import refusal, result_of, upload
from tests.service.vo.made import add_product
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow
from workers.files.intact import intact
from workers.files.store import Store
from workers.settings import Settings


def test_a_product_has_a_thumbnail(
    api: TestClient, image_file: Path, psf_file: Path, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    ids = {"image_id": upload(api, image_file), "psf_id": upload(api, psf_file, "/v1/psfs")}
    method = {"name": "richardson-lucy", "steps": 1}
    product = result_of(api, run_jobs, "deconvolve", **ids, method=method)
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


def test_a_thumbnail_that_is_lost_deleted_or_was_never_made(
    api: TestClient, catalogue: Catalogue, settings: Settings, tmp_path: Path
) -> None:
    store = Store(settings.data_dir)
    older = add_product(api, tmp_path, thumbnail_sha256=None)["product"]
    detail = refusal(api.get(f"/v1/products/{older}/thumbnail"), 404, "no-thumbnail")
    assert "made before products had one" in detail
    assert api.get(f"/v1/products/{older}").json()["thumbnail"] is None

    (tmp_path / "thumbnail.png").write_bytes(b"\x89PNG\r\n\x1a\nsmall")
    digest = store.keep(tmp_path / "thumbnail.png")
    own = add_product(api, tmp_path, number=2, thumbnail_sha256=digest)["product"]
    row = catalogue.get(ProductRow, own, DEFAULT_OWNER)
    assert row is not None and intact(store, row) and digest in set(catalogue.named_files.all())
    content = store.path(digest).read_bytes()
    store.path(digest).unlink()
    assert not intact(store, row) and api.get(f"/v1/products/{own}/thumbnail").status_code == 410
    store.path(digest).write_bytes(content)
    assert store.size(digest)
    assert api.delete(f"/v1/products/{own}").status_code == 204
    assert store.size(digest) is None
