"""Products over HTTP: thumbnails, regions, and products or PSFs that are sent as images.
Lineage as W3C PROV, over HTTP."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import prov
import pytest
from astropy.io import fits
from click.testing import CliRunner
from fastapi.testclient import TestClient
from httpx import Response
from matplotlib.image import imread
from prov.model import ProvDocument, ProvEntity
from prov.scripts.convert import main as prov_convert

from psfcore.drawing.thumbnail import write_thumbnail
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.images import read_plane
from psfcore.fits.psfs import write_psf
from service.cli.main import main
from tests.psfcore.conftest import make_psf
from tests.service.conftest import refusal, result_of, upload, work_through_bulks
from tests.service.vo.made import ENDED_AT, STARTED_AT, add_product
from tests.workers.psf_examples import identity, product, psf
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow
from workers.files.collection import intact
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
    assert digest not in {blob.digest for blob in store.blobs()}


DEFAULT = {"method": {"name": "linear"}}


def ask_for_region(api: TestClient, image_id: str, psf_id: str, **more: Any) -> Response:
    parameters = {"image_id": image_id, "psf_id": psf_id, **DEFAULT, **more}
    return api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters})


def test_the_product_of_a_region_is_the_box(
    api: TestClient, run_jobs: Callable[[], None], image_file: Path, psf_file: Path
) -> None:
    fits.setval(image_file, "CRPIX1", value=1.5)
    image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    whole = ask_for_region(api, image_id, psf_id).json()
    same = ask_for_region(api, image_id, psf_id, region_error=0.5).json()
    assert same["id"] == whole["id"], "without a region it means nothing"
    job = ask_for_region(api, image_id, psf_id, region="10:50,20:60", region_error=0.9).json()
    assert job["id"] != whole["id"]
    run_jobs()
    product, of_whole = (
        api.get(api.get(f"/v1/jobs/{one['id']}").json()["result"]).json() for one in (job, whole)
    )
    told = product["details"]["region"]
    assert told["box"] == "10:50,20:60" and told["rim_px"] > 0 and told["error"] > 0
    assert of_whole["details"]["region"] is None
    found, expected = (fits.open(io.BytesIO(api.get(one["file"]).content))[0] for one in (product, of_whole))
    assert found.data.shape == (40, 40) and found.header["DCNVBERR"] == told["error"]
    assert found.header["CRPIX1"] == 1.5 - 10
    assert abs(found.data - expected.data[20:60, 10:50]).max() <= told["error"]


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
        (box | {"region_error": 0}, "invalid-request", "region_error"),
    ]
    for parameters, code, said in cases:
        assert said in refusal(ask_for_region(api, image_id, psf_id, **parameters), 422, code)
    method = {"name": "linear", "steps": 2}
    whole, part = (
        api.post("/v1/estimates", json={"kind": "deconvolve", "parameters": parameters}).json()["estimate"]
        for parameters in (
            {"image_id": image_id, "psf_id": psf_id, "method": method},
            {"image_id": image_id, "psf_id": psf_id, "method": method, "region": "0:16,0:16"},
        )
    )
    assert part["memory_mib"] <= whole["memory_mib"] and part["seconds"] <= whole["seconds"]


FEW = {"method": {"name": "richardson-lucy", "steps": 1}}


def ask(api: TestClient, image_id: str, psf_id: str, **more: Any) -> Response:
    parameters = {"image_id": image_id, "psf_id": psf_id, **FEW, **more}
    return api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters})


@pytest.fixture
def psf_id(api: TestClient, psf_file: Path) -> str:
    return upload(api, psf_file, "/v1/psfs")


@pytest.fixture
def product_file(
    api: TestClient, run_jobs: Callable[[], None], image_file: Path, psf_id: str, tmp_path: Path
) -> Path:
    """The product of an image."""
    image_id = upload(api, image_file)
    product = result_of(api, run_jobs, "deconvolve", image_id=image_id, psf_id=psf_id, **FEW)
    path = tmp_path / "product.fits"
    path.write_bytes(api.get(product["file"]).content)
    return path


def test_a_product_is_deconvolved_again_only_if_told(
    api: TestClient, catalogue: Catalogue, run_jobs: Callable[[], None], product_file: Path, psf_id: str
) -> None:
    image_id = upload(api, product_file)
    assert "again = true" in refusal(ask(api, image_id, psf_id), 409, "already-deconvolved")
    product = result_of(api, run_jobs, "deconvolve", image_id=image_id, psf_id=psf_id, again=True, **FEW)
    with fits.open(io.BytesIO(api.get(product["file"]).content)) as hdus:
        header = hdus[0].header
    assert fits.getheader(product_file)["DCNVPASS"] == 1 and header["DCNVPASS"] == 2
    assert any("deconvolution number 2" in line for line in header["HISTORY"])


def test_a_psf_is_no_image(api: TestClient, psf_id: str, tmp_path: Path) -> None:
    kernel = np.zeros((33, 33))
    kernel[16, 16] = 1.0
    write_psf(tmp_path / "own.fits", make_psf(kernel))
    image_id = upload(api, tmp_path / "own.fits")
    refusal(ask(api, image_id, psf_id), 409, "psf-as-image")
    assert ask(api, image_id, psf_id, again=True).status_code == 202


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    (tmp_path / "archive").mkdir()
    return tmp_path / "archive"


@pytest.fixture
def settings(settings: Settings, archive: Path) -> Settings:
    return settings.model_copy(update={"bulk_roots": str(archive)})


def test_a_bulk_run_sets_products_apart_and_goes_on(
    api: TestClient, settings: Settings, archive: Path, product_file: Path, image_file: Path, psf_id: str
) -> None:
    product_file.rename(archive / "a.fits")
    image_file.rename(archive / "b.fits")
    request = {"files": [{"glob": f"{archive}/*.fits"}], "psf_id": psf_id, "parameters": FEW}

    def done(**parameters: Any) -> dict[str, Any]:
        asked = api.post("/v1/bulk", json=request | {"parameters": FEW | parameters})
        assert asked.status_code == 202, asked.text
        work_through_bulks(settings)
        return dict(api.get(f"/v1/bulk/{asked.json()['id']}").json())

    bulk = done()
    assert (bulk["phase"], bulk["images"]["done"], bulk["images"]["failed"]) == ("COMPLETED", 1, 1)
    (failure,) = api.get(bulk["failures"]).json()["items"]
    assert failure["source"].endswith("a.fits") and failure["error"]["code"] == "already-deconvolved"
    assert done(again=True)["images"]["failed"] == 0


def test_the_command_refuses_a_product_too(product_file: Path, psf_file: Path, tmp_path: Path) -> None:
    command = ["deconvolve", str(product_file), "--psf", str(psf_file), "--local", "--steps", "1"]
    output = ["-o", str(tmp_path / "twice.fits")]
    told = CliRunner().invoke(main, [*command, *output])
    assert told.exit_code == 1 and "--again" in told.output, told.output
    assert not (tmp_path / "twice.fits").exists()
    assert CliRunner().invoke(main, [*command, *output, "--again"]).exit_code == 0
    assert fits.getheader(tmp_path / "twice.fits")["DCNVPASS"] == 2


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


def test_prov_convert_reads_both_forms(
    api: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = add_product(api, tmp_path)
    wrong = api.get(f"/v1/products/{ids['product']}/provenance?format=xml")
    assert "'json' or 'provn'" in refusal(wrong, 422, "invalid-request")
    for of in ("product", "psf"):
        refusal(api.get(f"/v1/{of}s/{'f' * 64}/provenance"), 404, f"no-such-{of}")
    for of, form, other in (
        ("product", "json", "provn"),
        ("product", "provn", "json"),
        ("psf", "json", "provn"),
    ):
        text = api.get(f"/v1/{of}s/{ids[of]}/provenance?format={form}").text
        (tmp_path / f"in.{form}").write_text(text)
        out = tmp_path / f"{of}-{form}.{other}"
        words = ["prov-convert", "-i", form, "-f", other, str(tmp_path / f"in.{form}"), str(out)]
        monkeypatch.setattr(sys, "argv", words)
        assert not prov_convert()
        assert read(out.read_text()) == read(text)


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
