"""Ids that are cut to their first digits, in the addresses of requests."""

from __future__ import annotations

from pathlib import Path

from fastapi.testclient import TestClient

from tests.conftest import write_psf
from tests.service.conftest import refusal, upload
from tests.service.keyed import Keyed
from tests.service.vo.made import add_product
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow
from workers.contract.jobs import Phase

SAME = "0123456789"  # the first digits of several ids


def product(identity: str, owner: str = DEFAULT_OWNER) -> ProductRow:
    return ProductRow(
        owner=owner, id=identity, created_at=1.0, kind="deconvolved", image_id="1" * 64, psf_id="2" * 64,
        psf_version="1", file_sha256="3" * 64, bytes=1, preview_sha256="4" * 64, details={},
    )  # fmt: skip


def test_the_first_digits_of_an_id_stand_for_it(
    api: TestClient, image_file: Path, psf_file: Path, tmp_path: Path
) -> None:
    image, psf = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    assert api.get(f"/v1/images/{image[:8]}").json()["id"] == image
    for digits in (8, 12, 63, 64):
        assert api.get(f"/v1/psfs/{psf[:digits]}").json()["id"] == psf
    assert api.get(f"/v1/psfs/{psf[:9]}/file").content == psf_file.read_bytes()
    assert api.get(f"/v1/psfs/{psf[:9]}/lineage").json()["id"] == psf
    assert api.get(f"/v1/images/{image[:9]}/psf").status_code == 409, "found; it has no known instrument"
    write_psf(tmp_path / "other.fits", size=48)
    other = upload(api, tmp_path / "other.fits", "/v1/psfs")
    refusal(api.get(f"/v1/psfs/{psf[:8]}/compare/{other[:8]}"), 409, "no-tables")  # both were found
    body = {"kind": "deconvolve", "parameters": {"image_id": image, "psf_id": psf}}
    job = api.post("/v1/jobs", json=body).json()["id"]
    assert api.get(f"/v1/jobs/{job[:8]}").json()["id"] == job
    assert f"{job}</" in api.get(f"/uws/jobs/{job[:10]}").text
    assert api.get(f"/uws/jobs/{job[:10]}/phase").text == "QUEUED"
    assert api.delete(f"/v1/jobs/{job[:31]}").json()["phase"] == "ABORTED"


def test_digits_of_several_ids_are_refused_with_the_candidates(api: TestClient, catalogue: Catalogue) -> None:
    ids = [SAME + digit * 54 for digit in "0af"]
    for identity in ids:
        catalogue.add(product(identity))
    refused = api.get(f"/v1/products/{SAME}")
    detail = refusal(refused, 409, "several-ids-fit")
    assert refused.json()["candidates"] == ids and all(identity in detail for identity in ids)
    assert api.get(f"/v1/products/{SAME}a").json()["id"] == ids[1]
    many = api.delete(f"/v1/products/{SAME}")
    assert many.status_code == 409 and len(api.get("/v1/products").json()["items"]) == 3


def test_digits_of_no_id_are_refused(shared_api: TestClient) -> None:
    for kind, code in (
        ("products", "no-such-product"),
        ("psfs", "no-such-psf"),
        ("jobs", "no-such-job"),
        ("bulk", "no-such-bulk"),
        ("images", "no-such-image"),
        ("reports", "no-such-report"),
        ("transits", "no-such-transit"),
    ):
        detail = refusal(shared_api.get(f"/v1/{kind}/01234567"), 404, code)
        assert "its first 8 or more digits" in detail
        for digits in ("0123456", "0123456_"):
            refusal(shared_api.get(f"/v1/{kind}/{digits}"), 422, "invalid-request")
    refused = shared_api.get("/uws/jobs/01234567/phase")
    assert refused.status_code == 404 and refused.headers["content-type"].startswith("text/plain")


def test_ids_of_other_owners_are_not_found_and_do_not_make_digits_ambiguous(service: Keyed) -> None:
    ann, bob = service.client("ann"), service.client("bob")
    service.catalogue.add(product(SAME + "a" * 54, "ann"))
    service.catalogue.add(product(SAME + "b" * 54, "bob"))
    assert ann.get(f"/v1/products/{SAME}").json()["id"] == SAME + "a" * 54
    assert bob.get(f"/v1/products/{SAME}").json()["id"] == SAME + "b" * 54
    assert bob.get(f"/v1/products/{SAME}a").status_code == 404
    assert service.api.get(f"/v1/products/{SAME}a").status_code == 401


def test_a_deleted_product_is_gone_and_its_job_stays(
    api: TestClient, catalogue: Catalogue, tmp_path: Path
) -> None:
    ids = add_product(api, tmp_path)
    used = catalogue.owners.usage(DEFAULT_OWNER, 0).used_bytes
    row = catalogue.get(ProductRow, ids["product"], DEFAULT_OWNER)
    assert row is not None
    assert api.delete(f"/v1/products/{ids['product']}").status_code == 204
    for answer in (api.get(f"/v1/products/{ids['product']}"), api.delete(f"/v1/products/{ids['product']}")):
        refusal(answer, 404, "no-such-product")
    assert catalogue.owners.usage(DEFAULT_OWNER, 0).used_bytes == used - row.bytes
    job = catalogue.jobs.get(ids["job"])
    assert job is not None and job.phase == Phase.COMPLETED


def test_a_context_is_found_by_its_name_before_the_first_digits_of_its_id(
    api: TestClient, psf_file: Path
) -> None:
    psf = upload(api, psf_file, "/v1/psfs?instrument=hri_euv&channel=174&kind=total")
    certified = api.post(f"/v1/psfs/{psf[:8]}/status", json={"status": "certified", "version": "1.0.0"})
    assert certified.status_code == 200, certified.text
    one = api.post("/v1/contexts", json={"name": "one"}).json()
    assert api.get(f"/v1/contexts/{one['id'][:8]}").json()["id"] == one["id"]
    assert api.put("/v1/contexts/default", json={"context": one["id"][:12]}).json()["context"] == {
        key: value for key, value in one.items() if key != "pins"
    }
    named = api.post("/v1/contexts", json={"name": one["id"][:8]}).json()
    assert named["id"] != one["id"] and api.get(f"/v1/contexts/{one['id'][:8]}").json()["id"] == named["id"]
    assert api.get("/v1/contexts/0123abcd").status_code == 404
