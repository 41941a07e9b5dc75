"""Nothing goes across owners: what is another's is answered as if it were not there.
Ids that are cut to their first digits, in the addresses of requests."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.service.conftest import one_of_everything, refusal, upload
from tests.service.keyed import Keyed
from workers.catalogue.access import Scope
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, ProductRow

UNKNOWN = {64: "f" * 64, 32: "f" * 32, 16: "f" * 16}


@pytest.fixture(scope="module")
def anns(shared_service: Keyed, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """One of everything, ann's; by the name that it has in addresses. No test changes these."""
    return one_of_everything(shared_service, tmp_path_factory.mktemp("anns"))


def asked(client: TestClient, ids: dict[str, str]) -> Iterator[tuple[str, str, str]]:
    """Every method and address that names something, with these ids, and with ids of nothing."""
    paths = client.get("/openapi.json").json()["paths"]
    for path, operations in paths.items():
        names = re.findall(r"\{(\w+)\}", path)
        if not names:
            continue
        known = {**ids, "job_id": ids["uws"]} if path.startswith("/uws") else ids
        missing = set(names) - known.keys()
        assert not missing, (
            f"{path}: say above what {missing} is of ann's, so that it is asked for as another"
        )
        nothing = {name: UNKNOWN.get(len(value), "nothing") for name, value in known.items()}
        query = {"annulus": "?inner=0&outer=1", "encircled": "?radius=1", "cutout": "?size=2"}
        tail = query.get(path.rpartition("/")[2], "")
        for method in operations:
            yield method.upper(), path.format(**known) + tail, path.format(**nothing) + tail


def plain(answer: Any, *ids: str) -> tuple[int, str, str]:
    """An answer without the ids that were asked for."""
    text = answer.text
    for one in ids:
        # The number of a job may also be a part of another id.
        text = re.sub(rf"(?<!\w){re.escape(one)}(?!\w)", "ID", text)
    return answer.status_code, answer.headers.get("content-type", ""), text


def test_another_s_things_are_answered_as_if_there_were_none_and_do_not_change(
    shared_service: Keyed, anns: dict[str, str]
) -> None:
    bob, ann = shared_service.client("bob"), shared_service.client("ann")
    count, ids = 0, [*anns.values(), *UNKNOWN.values(), "nothing"]
    for method, address, unknown in asked(bob, anns):
        for headers in ({}, {"If-None-Match": "*"}, {"Range": "bytes=0-1"})[: 3 if method == "GET" else 1]:
            data = {"PHASE": "RUN", "ACTION": "DELETE", "DESTRUCTION": "2090-01-01", "EXECUTIONDURATION": "9"}
            body = {"data": data} if address.startswith("/uws") and method == "POST" else {}
            if address.startswith("/v1/uploads"):
                # Without these a request is refused before its upload is looked for.
                part = "application/offset+octet-stream"
                headers = headers | {"Tus-Resumable": "1.0.0", "Upload-Offset": "0", "Content-Type": part}
            others = bob.request(method, address, headers=headers, follow_redirects=False, **body)
            nobodys = bob.request(method, unknown, headers=headers, follow_redirects=False, **body)
            assert plain(others, *ids) == plain(nobodys, *ids), (method, address)
            assert others.status_code in (404, 422), (method, address, others.text)
            assert others.status_code == 404 or method != "GET"
            assert "ETag" not in others.headers and "s3cret" not in others.text
            count += 1
    assert count > 100
    job = ann.get(f"/v1/jobs/{anns['job_id']}").json()
    assert job["phase"] == "QUEUED" and not job["cancel_requested"]
    assert ann.get(f"/uws/jobs/{anns['uws']}/phase").text == "PENDING"
    assert ann.get(f"/uws/jobs/{anns['uws']}/executionduration").text != "9"
    upload_now = ann.head(f"/v1/uploads/{anns['upload_id']}", headers={"Tus-Resumable": "1.0.0"})
    assert (upload_now.status_code, upload_now.headers["upload-offset"]) == (200, "0")


def test_lists_show_one_s_own_alone(shared_service: Keyed, anns: dict[str, str]) -> None:
    bob, ann = shared_service.client("eve"), shared_service.client("ann")
    # One PSF; a stream, which test_events.py tests; and keys, of which everybody who asks has one.
    no_lists = ("/v1/psfs/best", "/v1/events", "/v1/keys")
    lists = [
        p
        for p, o in ann.get("/openapi.json").json()["paths"].items()
        if p.startswith("/v1/") and "{" not in p and "get" in o and p not in no_lists
    ]
    assert len(lists) >= 6
    for path in lists:
        anns_page = ann.get(path, params={"limit": 1})
        assert anns_page.status_code == bob.get(path).status_code == 200, path
        if anns_page.json().get("items"):
            assert bob.get(path).json()["items"] == [], path
            later = anns_page.json()["next"]
            if later is not None:  # a cursor is a place, and gives nobody a right
                assert bob.get(later).json()["items"] == []
    assert {one["owner"] for one in bob.get("/v1/keys").json()["items"]} == {"eve"}
    assert bob.get("/uws/jobs").text.count("jobref") == 0
    assert ann.get("/uws/jobs").text.count("</uws:jobref>") >= 2
    assert "<uws:ownerId>ann</uws:ownerId>" in ann.get(f"/uws/jobs/{anns['uws']}").text
    assert ann.get(f"/uws/jobs/{anns['uws']}/owner").text == "ann"


def test_a_job_uses_one_s_own_things_alone(
    shared_service: Keyed, anns: dict[str, str], tmp_path: Path
) -> None:
    bob = shared_service.client("bob")
    write_image(tmp_path / "bobs.fits", seed=2)
    own = upload(bob, tmp_path / "bobs.fits")
    transit = {"transit_id": anns["transit_id"]}
    between = {"before_psf_id": anns["psf_id"], "before_time": "2021-01-01", "time": "2021-06-01"}
    for kind, parameters in (
        ("deconvolve", {"image_id": anns["image_id"]}),
        ("deconvolve", {"image_id": own, "psf_id": anns["psf_id"]}),
        ("psf-tables", {"psf_id": anns["psf_id"]}),
        ("psf-build", {"instrument_file": SMALL_INSTRUMENT, "mask_id": anns["image_id"]}),
        ("psf-interpolate", between | {"after_psf_id": anns["psf_id"], "after_time": "2022-01-01"}),
        ("report", transit),
        ("psf-fit", transit),
        ("gap-diagnose", transit),
    ):
        answer = bob.post("/v1/jobs", json={"kind": kind, "parameters": parameters})
        assert answer.status_code == 404, (kind, parameters, answer.text)
    for images, psf_id in (([anns["image_id"]], None), ([own], anns["psf_id"])):
        body = {"images": images, "psf_id": psf_id, "context": None if psf_id else anns["context"]}
        answer = bob.post("/v1/bulk", json=body)
        assert answer.status_code == 404, (body, answer.text)


def test_the_same_bytes_and_requests_of_two_owners_are_two(shared_service: Keyed, image_file: Path) -> None:
    carl, dora = shared_service.client("carl"), shared_service.client("dora")
    content = image_file.read_bytes() + bytes(2880)
    assert carl.post("/v1/images?filename=carls.fits", content=content).status_code == 201
    digest = hashlib.sha256(content).hexdigest()
    assert dora.get(f"/v1/images/{digest}").status_code == 404, "whoever knows the bytes knows no more"
    again = dora.post("/v1/images?filename=doras.fits", content=content)
    assert again.status_code == 201 and again.json()["filename"] == "doras.fits"
    assert carl.get(f"/v1/images/{digest}").json()["filename"] == "carls.fits"
    body = {"kind": "psf-build", "parameters": {"instrument_file": SMALL_INSTRUMENT, "size": 128}}
    jobs = [client.post("/v1/jobs", json=body) for client in (carl, dora, carl)]
    assert [job.status_code for job in jobs] == [202, 202, 200]
    assert jobs[0].json()["id"] == jobs[2].json()["id"] != jobs[1].json()["id"]


def test_an_administrator_may_act_for_an_owner_and_nobody_else_may(
    shared_service: Keyed, anns: dict[str, str]
) -> None:
    for_ann = {"X-Owner": "ann"}
    address = f"/v1/jobs/{anns['job_id']}"
    root = shared_service.client("root", *Scope)
    assert root.get(address).status_code == 404
    assert root.get(address, headers=for_ann).status_code == 200
    no_name = {"X-Owner": "a b"}
    assert "got 'a b'" in refusal(root.get(address, headers=no_name), 400, "bad-owner")
    assert shared_service.client("bob").get(address, headers=no_name).status_code == 403, (
        "the scope comes first"
    )
    bob, ann = shared_service.client("bob"), shared_service.client("ann")
    assert bob.get(address, headers=for_ann).status_code == 403
    assert ann.get(address, headers=for_ann).status_code == 200, "that is who asks anyway"
    reader = shared_service.client("root", Scope.ADMIN)
    assert reader.get(address, headers=for_ann).status_code == 403, "not without the scope to read"


# --- ids that are cut to their first digits --------------------------------------------------------------


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
    for digits in (8, 63, 64):
        assert api.get(f"/v1/psfs/{psf[:digits]}").json()["id"] == psf
    assert api.get(f"/v1/psfs/{psf[:9]}/file").content == psf_file.read_bytes()
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
