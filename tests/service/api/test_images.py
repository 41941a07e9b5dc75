"""Products over HTTP: thumbnails, regions, and products or PSFs that are sent as images.
Lineage as W3C PROV, over HTTP."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import prov
from astropy.io import fits
from fastapi.testclient import TestClient
from httpx import Response
from matplotlib.image import imread
from prov.model import ProvDocument, ProvEntity

from psfcore.drawing.thumbnail import write_thumbnail
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.images import read_plane
from psfcore.fits.psfs import write_psf
from tests.psfcore.conftest import make_psf
from tests.service.conftest import refusal, result_of, upload
from tests.service.vo.made import ENDED_AT, STARTED_AT, add_product, write_product
from tests.workers.psf_examples import identity, product, psf
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow
from workers.files.garbage import intact
from workers.files.store import Store
from workers.lineage import provenance, provenance_text
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
    write_thumbnail(pixels, tmp_path / "expected.png")
    difference = abs(imread(io.BytesIO(answer.content)) - imread(tmp_path / "expected.png"))
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
    assert digest not in {blob.digest for blob in store.blobs()}


FEW = {"method": {"name": "richardson-lucy", "steps": 1}}


def ask(api: TestClient, image_id: str, psf_id: str, **more: Any) -> Response:
    parameters = {"image_id": image_id, "psf_id": psf_id, **FEW, **more}
    return api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters})


def test_a_region_that_cannot_be_is_refused(api: TestClient, image_file: Path, psf_file: Path) -> None:
    image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    box = {"region": "0:40,0:40"}
    discrepancy = {"name": "linear", "stop": "discrepancy"}
    cases: list[tuple[dict[str, Any], str, str]] = [
        ({"region": "10-50,20-60"}, "invalid-request", "region"),
        ({"region": "0:5000,0:50"}, "region-outside", "the size of the image"),
        ({"region": "0:40,0:8"}, "region-too-small", "16 px"),
        (box | {"error_draws": 4}, "invalid-request", "error_draws 0 with a region"),
        (box | {"method": discrepancy}, "invalid-request", "stopping rule fixed"),
        ({"method": discrepancy}, "no-noise-model", "photon gain"),
        (box | {"region_error": 0}, "invalid-request", "region_error"),
    ]
    for parameters, code, said in cases:
        assert said in refusal(ask(api, image_id, psf_id, **parameters), 422, code)
    whole = ask(api, image_id, psf_id).json()["id"]
    same = ask(api, image_id, psf_id, region_error=0.5).json()["id"]
    part = ask(api, image_id, psf_id, region="10:50,20:60", region_error=0.9).json()["id"]
    assert same == whole != part, "without a region its error means nothing"


def test_a_product_and_a_psf_are_deconvolved_only_if_told(
    api: TestClient, run_jobs: Callable[[], None], psf_file: Path, tmp_path: Path
) -> None:
    psf_id = upload(api, psf_file, "/v1/psfs")
    write_product(tmp_path / "product.fits")
    fits.setval(tmp_path / "product.fits", "PRODID", value="a")
    image_id = upload(api, tmp_path / "product.fits")
    assert "again = true" in refusal(ask(api, image_id, psf_id), 409, "already-deconvolved")
    product = result_of(api, run_jobs, "deconvolve", image_id=image_id, psf_id=psf_id, again=True, **FEW)
    with fits.open(io.BytesIO(api.get(product["file"]).content)) as hdus:
        assert hdus[0].header["DCNVPASS"] == 2
    kernel = np.zeros((33, 33))
    kernel[16, 16] = 1.0
    write_psf(tmp_path / "own.fits", make_psf(kernel))
    image_id = upload(api, tmp_path / "own.fits")
    refusal(ask(api, image_id, psf_id), 409, "psf-as-image")
    assert ask(api, image_id, psf_id, again=True).status_code == 202


# --- provenance -----------------------------------------------------------------------------------------


def read(text: str) -> ProvDocument:
    """The document that the package prov reads. It raises an error for text that is not PROV."""
    return prov.read(text if isinstance(text, bytes) else text.encode())


def named(document: ProvDocument, name: str) -> list[dict[str, list[str]]]:
    """The attributes of the records with this name."""
    return [
        {str(key): sorted(map(str, values)) for key, values in _attributes(record).items()}
        for record in document.get_record(name)
    ]


def _attributes(record: ProvEntity) -> dict[object, set[object]]:
    return {key: set(record.get_attribute(key)) for key, _ in record.attributes}


def relations(document: ProvDocument, kind: str) -> set[tuple[str, ...]]:
    """The first two names of every relation of a kind, such as ``Usage``."""
    return {
        tuple(str(value) for value in record.args[:2])
        for record in document.get_records()
        if type(record).__name__ == f"Prov{kind}"
    }


def test_a_product_s_provenance(api: TestClient, tmp_path: Path) -> None:
    ids = add_product(api, tmp_path)
    here = f"/v1/products/{ids['product']}/provenance"
    assert "'json' or 'provn'" in refusal(api.get(f"{here}?format=xml"), 422, "invalid-request")
    for of in ("product", "psf"):
        refusal(api.get(f"/v1/{of}s/{'f' * 64}/provenance"), 404, f"no-such-{of}")
    as_json, as_provn = api.get(here), api.get(f"{here}?format=provn")
    assert as_json.headers["content-type"] == "application/json"
    assert as_provn.headers["content-type"].startswith("text/provenance-notation")
    document = read(as_json.text)
    assert document == read(as_provn.text), "both say the same"
    names = {thing: f"{thing}:{ids[thing]}" for thing in ("product", "psf", "image", "job")}
    [made] = named(document, names["product"])
    digest = api.get(f"/v1/products/{ids['product']}").json()["sha256"]
    assert made["heliopsf:sha256"] == [digest] and "voprov:DatasetEntity" in made["prov:type"]
    [job] = document.get_record(names["job"])
    assert (job.get_startTime().timestamp(), job.get_endTime().timestamp()) == (STARTED_AT, ENDED_AT)
    assert relations(document, "Generation") == {(names["product"], names["job"])}
    assert relations(document, "Usage") == {(names["job"], names["image"]), (names["job"], names["psf"])}
    assert relations(document, "Derivation") == {
        (names["product"], names["image"]),
        (names["product"], names["psf"]),
    }
    [parameter] = named(document, f"parameter:{ids['job']}.method")
    assert parameter["prov:value"] == ['{"name": "linear", "steps": 2}']
    agents = {agent for _, agent in relations(document, "Association")}
    [software] = agents - {"owner:local"}
    [told] = named(document, software)
    assert told["heliopsf:library"] == ["astropy 8.0.2", "numpy 2.4.6"]
    attributed = {entity for entity, _ in relations(document, "Attribution")}
    assert attributed == {names["product"], names["image"], names["psf"]}
    assert "Generation" not in str(named(document, names["psf"])), "an upload has no activity"


def test_generations_weights_and_deleted_parents(tmp_path: Path) -> None:
    """An interpolated PSF, its two ends, of which one was deleted, and a transit."""
    catalogue = Catalogue(f"sqlite:///{tmp_path / 'c.sqlite'}")
    catalogue.upgrade()
    made = {"provenance": {"software_version": "0.1.0"}, "transit_id": identity("transit")}
    catalogue.add(psf("early", origin="fitted", details=made))
    ends = {"before": identity("early"), "after": identity("late")}
    weights = {identity("early"): 0.25, identity("late"): 0.75}
    between = psf("between", origin="interpolated", details={"parents": ends, "weights": weights})
    catalogue.add(between)
    image = product("image", "between")
    catalogue.add(image)
    for row in (between, image):
        document = provenance(catalogue, row)
        for form in ("json", "provn"):
            assert read(provenance_text(catalogue, row, form)) == document
    usages = {
        str(record.args[1]): record.get_attribute("heliopsf:weight")
        for record in document.get_records()
        if type(record).__name__ == "ProvUsage"
    }
    assert usages[f"psf:{identity('early')}"] == {0.25} and usages[f"psf:{identity('late')}"] == {0.75}
    assert f"transit:{identity('transit')}" in usages
    [late] = named(document, f"psf:{identity('late')}")
    assert late["heliopsf:deleted"] == ["True"] and "heliopsf:sha256" not in late
    catalogue.close()
