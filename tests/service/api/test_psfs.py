"""PSFs over HTTP: uploads, versions and their status, validity, contexts, lists, deletion, and products of superseded
PSFs. PSFs have limits of their own: larger than those of images."""

from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from fastapi.testclient import TestClient
from httpx import Response

from psfcore.fits.blocks import FitsLimits
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.service.conftest import job_after, refusal, result_of, upload
from tests.service.keyed import Keyed
from workers.catalogue.access import Scope
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER
from workers.settings import Settings

SEEN = {"TELESCOP": "SOLO/EUI/HRI_EUV", "DETECTOR": "HRI_EUV", "WAVELNTH": 174.0}


@pytest.fixture
def psfs(api: TestClient, tmp_path: Path) -> list[str]:
    """Ids of three drafts of one series, uploaded, and of one of another."""
    ids = []
    for size, channel in ((32, "174"), (48, "174"), (64, "174"), (80, "304")):
        write_psf(tmp_path / f"p{size}.fits", size=size)
        query = {"name": f"p{size}", "instrument": "hri_euv", "channel": channel, "kind": "total"}
        content = (tmp_path / f"p{size}.fits").read_bytes()
        answer = api.post("/v1/psfs", params=query, content=content)
        assert answer.status_code == 201, answer.text
        ids.append(answer.json()["id"])
    return ids


def certify(api: TestClient, psf_id: str, version: str | None, *years: int | None, **more: Any) -> Response:
    times = [None if year is None else f"{year}-01-01T00:00:00Z" for year in years]
    given = dict(zip(("valid_from", "valid_to"), times, strict=False))
    return api.post(
        f"/v1/psfs/{psf_id}/status", json={"status": "certified", "version": version, **given, **more}
    )


def test_a_psf_is_certified_and_deprecated(api: TestClient, psfs: list[str]) -> None:
    first, second, *_ = psfs
    before = api.get(f"/v1/psfs/{first}/status").json()
    assert (before["status"], before["next_version"]) == ("draft", "1.0.0")
    assert before["may_become"] == ["certified"]
    assert before["series"] == "hri_euv/174/total" and before["history"] == []

    answer = certify(api, first, "1.0.0", 2020, None, reason="the first good one")
    assert answer.status_code == 200, answer.text
    said = answer.json()
    assert (said["status"], said["version"], said["valid_from"], said["valid_to"]) == (
        "certified", "1.0.0", "2020-01-01T00:00:00Z", None,
    )  # fmt: skip
    assert said["next_version"] == "1.1.0"
    seen = api.get(f"/v1/psfs/{first}").json()
    assert (seen["status"], seen["version"], seen["kind"]) == ("certified", "1.0.0", "total")

    detail = refusal(certify(api, second, "1.1.0", 2021, None), 409, "ranges-overlap")
    assert first in detail and "[2020-01-01T00:00:00Z, open)" in detail
    assert certify(api, second, "2.0.0", 2020, None, supersedes=[first], reason="better").status_code == 200
    old = api.get(f"/v1/psfs/{first}/status").json()
    assert (old["status"], old["successor"]) == ("deprecated", second)
    assert [(one["status_before"], one["status"], one["reason"]) for one in old["history"]] == [
        ("draft", "certified", "the first good one"),
        ("certified", "deprecated", "better"),
    ]
    assert all(one["by"] and one["at"] > 1e9 for one in old["history"])


GOOD = {"status": "certified", "version": "1.0.0"}
CHANGES: list[tuple[Any, int, str]] = [
    ({"status": "deprecated"}, 409, "wrong-transition"),
    ({"status": "certified"}, 422, "version-missing"),
    (GOOD | {"valid_from": "2021-13-01"}, 422, "bad-time"),
    (GOOD | {"valid_to": "9999-12-31T23:59:59.999999999"}, 422, "bad-time"),
    (GOOD | {"valid_from": "last year"}, 422, "invalid-request"),
    (GOOD | {"supersedes": ["x"]}, 422, "invalid-request"),
    (GOOD | {"kind": "A B"}, 422, "invalid-request"),
    (GOOD | {"approved_by": "me"}, 422, "invalid-request"),
]


def test_invalid_changes_of_status_are_refused(api: TestClient, psfs: list[str]) -> None:
    here = f"/v1/psfs/{psfs[0]}/status"
    for body, status, code in CHANGES:
        refusal(api.post(here, json=body), status, code)
    now = api.get(here).json()
    assert now["status"] == "draft" and now["history"] == []
    refusal(api.post(f"/v1/psfs/{psfs[0]}/rerun"), 409, "not-made-here")
    told = api.get(f"/v1/psfs/{psfs[0]}/lineage").json()
    assert told["parents"] == [] and told["made"]["origin"] == "uploaded"


def test_lists_and_the_best_by_properties_and_validity(api: TestClient, psfs: list[str]) -> None:
    """What each property selects is tested in tests/workers/catalogue."""
    certify(api, psfs[0], "1.0.0", 2020, 2021)
    certify(api, psfs[1], "1.1.0", 2021, 2022)

    def ids(**query: str) -> list[str]:
        answer = api.get("/v1/psfs", params=query)
        assert answer.status_code == 200, answer.text
        return [item["id"] for item in answer.json()["items"]]

    api.post("/v1/contexts", json={"name": "c"})
    assert ids() == psfs[::-1] and ids(context="now") == psfs[1::-1]
    assert ids(name="p64") == [psfs[2]] and ids(channel="304") == [psfs[3]] and ids(instrument="aia") == []
    assert ids(channel="174", kind="total", status="certified") == ids(context="c") == psfs[1::-1]
    assert ids(version="1.0.0") == ids(valid_at="2020-12-31T23:59:59Z") == [psfs[0]]
    refusal(api.get("/v1/psfs", params={"context": "d"}), 404, "no-such-context")
    draft_at = {"valid_at": "2020-01-01", "status": "draft"}
    for query in ({"valid_at": "2020"}, {"status": "released"}, draft_at):
        assert api.get("/v1/psfs", params=query).status_code == 422, query
    first = api.get("/v1/psfs", params={"channel": "174", "limit": 2}).json()
    assert [item["id"] for item in api.get(first["next"]).json()["items"]] == [psfs[0]]

    line = {"instrument": "hri_euv", "channel": "174", "kind": "total"}
    one = api.get("/v1/psfs/best", params={**line, "valid_at": "2021-06-01T00:00"}).json()
    assert (one["psf"]["id"], one["context"], one["valid_at"]) == (psfs[1], None, "2021-06-01T00:00:00Z")
    several = api.get("/v1/psfs/best", params=line)
    detail = refusal(several, 409, "several-psfs-fit")
    assert {one["id"] for one in several.json()["candidates"]} == set(psfs[:2]) and psfs[0] in detail
    refusal(api.get("/v1/psfs/best", params={**line, "valid_at": "2030-01-01"}), 404, "no-psf-fits")


def test_contexts_and_the_default(api: TestClient, psfs: list[str]) -> None:
    refusal(api.post("/v1/contexts", json={"name": "early"}), 409, "nothing-to-pin")
    certify(api, psfs[0], "1.0.0", 2020, None)
    made = api.post("/v1/contexts", json={"name": "early", "reason": "as delivered"})
    assert made.status_code == 201
    context = made.json()
    (pin,) = context["pins"]
    assert (pin["series"], pin["psf_id"], pin["version"]) == ("hri_euv/174/total", psfs[0], "1.0.0")
    assert (pin["valid_from"], pin["valid_to"]) == ("2020-01-01T00:00:00Z", None) and not pin["interpolated"]
    again = api.post("/v1/contexts", json={"name": "early"})
    assert again.status_code == 200 and again.json() == context
    pins = [{"psf_id": psfs[2], "valid_from": "2020-01-01", "valid_to": "2021-01-01"}, {"psf_id": psfs[3]}]
    refusal(api.post("/v1/contexts", json={"name": "early", "pins": pins}), 409, "name-taken")
    assert api.post("/v1/contexts", json={"name": "mine", "pins": pins}).status_code == 201
    assert api.get("/v1/contexts/early").json() == context
    assert [one["name"] for one in api.get("/v1/contexts").json()["items"]] == ["mine", "early"]
    refusal(api.get("/v1/contexts/late"), 404, "no-such-context")

    assert api.get("/v1/contexts/default").json() == {"context": None, "history": []}
    moved = api.put("/v1/contexts/default", json={"context": "mine", "reason": "go"}).json()
    assert moved["context"]["name"] == "mine"
    best = {"instrument": "hri_euv", "channel": "304"}
    assert api.get("/v1/psfs/best", params=best).json()["psf"]["id"] == psfs[3]
    refusal(api.get("/v1/psfs/best", params={**best, "context": "now"}), 404, "no-psf-fits")
    api.put("/v1/contexts/default", json={"context": None})
    history = api.get("/v1/contexts/default").json()["history"]
    assert [(one["context"], one["reason"]) for one in history] == [
        (None, ""),
        (moved["context"]["id"], "go"),
    ]
    refusal(api.put("/v1/contexts/default", json={"context": "late"}), 404, "no-such-context")
    for body in ({"name": "now"}, {"name": "a b"}, {}, {"name": "x", "pins": []}, {"name": "x", "of": 1}):
        assert api.post("/v1/contexts", json=body).status_code in (409, 422), body


def test_an_image_is_deconvolved_with_the_psf_of_its_time(
    api: TestClient, psfs: list[str], tmp_path: Path
) -> None:
    write_image(tmp_path / "i.fits", **SEEN, **{"DATE-BEG": "2020-06-01T00:00:00.000"})
    write_image(tmp_path / "far.fits", **SEEN, **{"DATE-BEG": "2030-06-01T00:00:00.000"})
    image, far = upload(api, tmp_path / "i.fits"), upload(api, tmp_path / "far.fits")

    def asked(image_id: str, **more: Any) -> Response:
        body = {"kind": "deconvolve", "parameters": {"image_id": image_id, **more}}
        return api.post("/v1/jobs", json=body)

    refusal(api.get(f"/v1/images/{image}/psf"), 404, "no-psf-fits")
    certify(api, psfs[0], "1.0.0", 2020, 2021)
    choice = api.get(f"/v1/images/{image}/psf").json()
    assert (choice["psf"]["id"], choice["valid_at"]) == (psfs[0], "2020-06-01T00:00:00Z")
    now = asked(image).json()["parameters"]
    assert (now["psf_id"], now["psf_recipe"], now["picked_for"]) == (psfs[0], None, "hri_euv")
    refusal(asked(far), 404, "no-psf-fits")
    api.post("/v1/contexts", json={"name": "c", "pins": [{"psf_id": psfs[2]}]})
    assert api.get(f"/v1/images/{far}/psf", params={"context": "c"}).json()["psf"]["id"] == psfs[2]
    assert asked(far, context="c").json()["parameters"]["psf_id"] == psfs[2]
    assert asked(far, context="c", psf_id=psfs[0]).status_code == 422


def test_products_of_a_superseded_psf_are_listed(
    api: TestClient, run_jobs: Callable[[], None], psfs: list[str], tmp_path: Path
) -> None:
    old, new, *_ = psfs
    certify(api, old, "1.0.0")
    for seed in range(3):
        write_image(tmp_path / f"{seed}.fits", seed=seed, **SEEN)
        image_id = upload(api, tmp_path / f"{seed}.fits")
        result_of(api, run_jobs, "deconvolve", image_id=image_id, method={"name": "linear", "steps": 1})
    assert api.get("/v1/affected").json()["items"] == []
    assert len(api.get(f"/v1/psfs/{old}/affected").json()["items"]) == 3

    api.post(f"/v1/psfs/{old}/status", json={"status": "deprecated", "reason": "wrong"})
    assert len(api.get("/v1/affected").json()["items"]) == 3
    assert api.get("/v1/affected", params={"superseded": True}).json()["items"] == []
    certify(api, new, "1.1.0")
    api.post(f"/v1/psfs/{old}/status", json={"status": "deprecated", "successor": new})
    seen: list[str] = []
    address: str | None = "/v1/affected?superseded=true&limit=2"
    while address:
        page = api.get(address).json()
        for item in page["items"]:
            assert (item["psf_id"], item["successor"], item["redo_with"]) == (old, new, new)
            assert item["psf_version"] == "1.0.0" and item["psf_status"] == "deprecated"
        seen += [item["product_id"] for item in page["items"]]
        address = page["next"]
    assert len(seen) == len(set(seen)) == 3
    certify(api, psfs[2], "2.0.0", supersedes=[new])
    items = api.get(f"/v1/psfs/{old}/affected", params={"limit": 1}).json()["items"]
    assert (items[0]["successor"], items[0]["redo_with"]) == (new, psfs[2])
    for place in ("nonsense", f"{new} soon {old}", f"{new}\x00 1.0 {old}", f"{new} nan {old}"):
        cursor = base64.urlsafe_b64encode(place.encode()).decode()
        assert api.get("/v1/affected", params={"cursor": cursor}).status_code == 422, place


def test_the_series_of_an_uploaded_psf_comes_from_its_file_or_the_request(
    api: TestClient, tmp_path: Path
) -> None:
    write_psf(tmp_path / "p.fits")
    content = (tmp_path / "p.fits").read_bytes()
    for query in ({"instrument": "A B"}, {"channel": ""}, {"kind": "-"}, {"kind": "x" * 41}):
        assert api.post("/v1/psfs", params=query, content=content).status_code == 422, query
    psf = api.post("/v1/psfs", content=content).json()
    assert (psf["instrument"], psf["channel"]) == (None, None)
    assert (psf["kind"], psf["status"]) == ("uploaded", "draft")
    refusal(certify(api, psf["id"], "1.0.0"), 409, "no-line")
    said = certify(api, psf["id"], "1.0.0", instrument="aia_3", channel="193", kind="total").json()
    assert said["series"] == "aia_3/193/total"


FEW = {"method": {"name": "richardson-lucy", "steps": 1}}


def used_bytes(catalogue: Catalogue) -> int:
    return catalogue.quotas.usage(DEFAULT_OWNER, 0).used_bytes


def blobs(settings: Settings) -> set[str]:
    return {path.name for path in (settings.data_dir / "blobs").rglob("*") if path.is_file()}


def test_an_image_is_refused_as_a_psf_and_nothing_of_it_stays(
    api: TestClient, catalogue: Catalogue, settings: Settings, tmp_path: Path
) -> None:
    write_image(tmp_path / "plain.fits")
    packed = fits.CompImageHDU(fits.getdata(tmp_path / "plain.fits"), fits.Header({"XPOSURE": 2.0}))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "packed.fits")
    for name in ("plain", "packed"):
        content = (tmp_path / f"{name}.fits").read_bytes()
        answer = api.post("/v1/psfs", content=content, headers={"Content-Type": "application/fits"})
        assert "expected" in refusal(answer, 422, "psf-sum")
    assert api.get("/v1/psfs").json()["items"] == []
    assert blobs(settings) == set() and used_bytes(catalogue) == 0
    assert list((settings.data_dir / "tmp").iterdir()) == []


def test_a_draft_is_deleted_with_its_files_and_its_bytes(
    api: TestClient, catalogue: Catalogue, settings: Settings, psf_file: Path, run_jobs: Callable[[], None]
) -> None:
    psf_id = upload(api, psf_file, "/v1/psfs")
    body = {"kind": "psf-tables", "parameters": {"psf_id": psf_id}}
    job = catalogue.jobs.get(job_after(api, run_jobs, "psf-tables", psf_id=psf_id)["id"])
    assert job is not None
    assert api.get(f"/v1/psfs/{psf_id}/preview").status_code == 200 and len(blobs(settings)) == 3
    deleted = api.delete(f"/v1/psfs/{psf_id}")
    assert deleted.status_code == 200 and deleted.json()["id"] == psf_id
    refusal(api.get(f"/v1/psfs/{psf_id}"), 404, "no-such-psf")
    refusal(api.delete(f"/v1/psfs/{psf_id}"), 404, "no-such-psf")
    assert blobs(settings) == set() and used_bytes(catalogue) == 0
    assert upload(api, psf_file, "/v1/psfs") == psf_id
    again = api.post("/v1/jobs", json=body).json()
    assert again["phase"] == "QUEUED", "the tables are made again"


def test_a_psf_that_was_built_here(api: TestClient, run_jobs: Callable[[], None]) -> None:
    """Sent again it keeps its id; deleted, it is built again."""
    body = {"kind": "psf-build", "parameters": {"instrument_file": SMALL_INSTRUMENT, "size": 64}}
    built = result_of(api, run_jobs, "psf-build", instrument_file=SMALL_INSTRUMENT, size=64)
    address = f"/v1/psfs/{built['id']}"
    file = api.get(f"{address}/file").content
    again = api.post("/v1/psfs", content=file)
    assert again.status_code == 200 and again.json()["id"] == built["id"]
    renamed = api.post("/v1/psfs", params={"name": "mine"}, content=file)
    assert renamed.status_code == 201 and renamed.json()["id"] != built["id"]
    assert api.delete(address).status_code == 200
    assert api.post("/v1/jobs", json=body).status_code == 202
    run_jobs()
    assert api.get(address).status_code == 200


def test_only_the_owner_deletes_and_only_with_the_scope(
    service: Keyed, settings: Settings, psf_file: Path
) -> None:
    ada, bob = service.client("ada"), service.client("bob")
    psf_id = upload(ada, psf_file, "/v1/psfs")
    assert upload(bob, psf_file, "/v1/psfs") == psf_id
    refusal(service.client("ada", Scope.READ).delete(f"/v1/psfs/{psf_id}"), 403, "scope-missing")
    assert service.api.delete(f"/v1/psfs/{psf_id}").status_code == 401
    assert ada.delete(f"/v1/psfs/{psf_id}").status_code == 200
    assert ada.get(f"/v1/psfs/{psf_id}").status_code == 404
    kept = bob.get(f"/v1/psfs/{psf_id}/file")
    assert kept.status_code == 200 and kept.content == psf_file.read_bytes()
    assert bob.delete(f"/v1/psfs/{psf_id}").status_code == 200
    assert blobs(settings) == set()


# --- large PSFs -----------------------------------------------------------------------------------------


def test_a_psf_may_be_larger_than_the_largest_image(
    api: TestClient,
    settings: Settings,
    run_jobs: Callable[[], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_psf(tmp_path / "psf.fits", size=1024)
    write_image(tmp_path / "i.fits")
    assert settings.max_pixels < 1024**2 < settings.max_psf_pixels
    assert settings.max_upload_bytes < (tmp_path / "psf.fits").stat().st_size < settings.max_psf_bytes
    sent = (tmp_path / "psf.fits").read_bytes()
    refusal(api.post("/v1/images", content=sent), 413, "too-large")
    image_id, psf_id = upload(api, tmp_path / "i.fits"), upload(api, tmp_path / "psf.fits", "/v1/psfs")
    result_of(api, run_jobs, "deconvolve", image_id=image_id, psf_id=psf_id, **FEW)
    write_psf(tmp_path / "larger.fits", size=1026)
    monkeypatch.setattr(Settings, "psf_limits", FitsLimits(max_pixels=1024**2))
    refusal(api.post("/v1/psfs", content=(tmp_path / "larger.fits").read_bytes()), 422, "too-many-pixels")
