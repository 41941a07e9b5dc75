"""The pages of bulk runs, by plain forms: start, progress, results, reasons of failures, and whose they are."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.pages import bulk as bulk_pages
from tests.conftest import write_image, write_psf
from tests.service.conftest import upload, work_through_bulks
from tests.service.keyed import keyed
from workers.catalogue.access import Scope
from workers.settings import Settings

FEW = {"method": {"name": "richardson-lucy", "steps": 2}}
HOSTILE = "<script>alert(1)</script>.fits"


@pytest.fixture
def settings(settings: Settings, tmp_path: Path) -> Settings:
    (tmp_path / "archive").mkdir()
    return settings.model_copy(update={"bulk_roots": str(tmp_path / "archive")})


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        client.headers["Accept"] = "text/html"
        yield client


@pytest.fixture
def psf_id(api: TestClient, psf_file: Path) -> str:
    return upload(api, psf_file, "/v1/psfs")


@pytest.fixture
def work(settings: Settings, api: TestClient) -> Callable[[], None]:
    """Runs turns until no bulk run is at work."""
    return lambda: work_through_bulks(settings)


def uploaded(api: TestClient, folder: Path, count: int, first: int = 0) -> list[str]:
    found = []
    for number in range(first, first + count):
        write_image(folder / f"{number}.fits", seed=number)
        body = (folder / f"{number}.fits").read_bytes()
        answer = api.post("/v1/images", params={"filename": f"sun {number}.fits"}, content=body)
        found.append(answer.json()["id"])
    return found


def started(api: TestClient, psf_id: str, **fields: str) -> str:
    answer = api.post("/bulk/start", data={"choice": f"psf:{psf_id}", **fields}, follow_redirects=False)
    assert answer.status_code == 303, answer.text
    return str(answer.headers["location"])


def sources(page: str) -> list[int]:
    """The numbers of the images of a contact sheet, in its order."""
    return [int(number) for number in re.findall(r">sun (\d+)\.fits</a>", page)]


def test_a_run_of_all_images_without_a_product_is_started_followed_and_shown(
    api: TestClient, psf_id: str, work: Callable[[], None], tmp_path: Path
) -> None:
    first = uploaded(api, tmp_path, 3)
    assert "This run will deconvolve your 3 images that have no product." in api.get("/bulk").text
    place = started(api, psf_id, name="Rome <1>")
    page = api.get(place).text
    assert "Rome &lt;1&gt;" in page and "Rome <1>" not in page
    assert '<span data-part="done">0</span> of <span data-part="total">3</span>' in page
    assert '<meta http-equiv="refresh"' in page and "No image is done yet." in page
    assert "Rome &lt;1&gt;" in api.get("/bulk").text
    work()
    page = api.get(place).text
    assert '<span data-part="done">3</span>' in page and "refresh" not in page
    assert page.count('loading="lazy"') == 3
    for one in re.findall(r'<a href="(/products/\w+)"><img src="(/v1/products/\w+/thumbnail)"', page):
        assert one[1] == f"/v1{one[0]}/thumbnail" and api.get(one[1]).headers["Content-Type"] == "image/png"
    assert "There is no uploaded image without a product" in api.get("/bulk").text
    refused = api.post("/bulk/start", data={"choice": f"psf:{psf_id}"})
    assert refused.status_code == 409 and "upload other images first" in refused.text
    (newest,) = uploaded(api, tmp_path, 1, first=3)
    second = api.get(f"/v1{started(api, psf_id)}").json()
    assert second["images"]["total"] == 1 and newest not in first


def test_a_run_from_the_form_uses_its_method_and_steps(api: TestClient, psf_id: str, tmp_path: Path) -> None:
    uploaded(api, tmp_path, 1)
    page = api.get("/bulk").text
    usual = dict(re.findall(r'<option value="([a-z-]+)">\1, usually (\d+) steps</option>', page))
    assert next(iter(usual)) == "richardson-lucy" and usual["linear"] == "5" and 'max="200"' in page
    for number, (fields, expected) in enumerate(
        (
            ({}, {"name": "richardson-lucy", "steps": 20}),
            ({"method": "linear", "steps": ""}, {"name": "linear", "steps": 5}),
            ({"method": "basic-iterative", "steps": "7"}, {"name": "basic-iterative", "steps": 7}),
        )
    ):
        place = started(api, psf_id, name=str(number), **fields)
        method = api.get(f"/v1{place}").json()["request"]["parameters"]["method"]
        assert {key: method[key] for key in expected} == expected
        assert f"<dd>{expected['name']}, {expected['steps']} steps</dd>" in api.get(place).text


def test_a_run_from_the_form_takes_a_limited_number_of_images(
    api: TestClient, psf_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bulk_pages, "MOST_STARTED", 2)
    uploaded(api, tmp_path, 3)
    assert "the newest 2 of your images that have no product" in api.get("/bulk").text
    assert api.get(f"/v1{started(api, psf_id)}").json()["images"]["total"] == 2


def test_results_are_paged_worst_first_and_in_the_order_of_the_run(
    api: TestClient, psf_id: str, work: Callable[[], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bulk_pages, "PER_SHEET", 2)
    ids = uploaded(api, tmp_path, 5)
    made = api.post("/v1/bulk", json={"images": ids, "psf_id": psf_id, "parameters": FEW}).json()
    work()
    by_score = api.get(f"/v1/bulk/{made['id']}/results?order=worst").text
    worst = [ids.index(source) for source in re.findall(r'"source":"(\w+)"', by_score)]
    for order, expected in (("worst", worst), ("bulk", [0, 1, 2, 3, 4])):
        address: str | None = f"/bulk/{made['id']}?order={order}"
        seen, pages = [], 0
        while address is not None:
            page = api.get(address).text
            seen += sources(page)
            pages += 1
            found = re.search(r'href="([^"]+)">More results', page)
            address = found[1].replace("&amp;", "&") if found else None
        assert (seen, pages) == (expected, 3)
    assert api.get(f"/bulk/{made['id']}?cursor=MTIz").status_code == 422


def test_a_deleted_product_is_named_and_not_linked(
    api: TestClient, psf_id: str, work: Callable[[], None], tmp_path: Path
) -> None:
    uploaded(api, tmp_path, 1)
    place = started(api, psf_id)
    work()
    (product,) = re.findall(r'href="/products/(\w+)"', api.get(place).text)
    assert api.delete(f"/v1/products/{product}").status_code == 204
    page = api.get(place).text
    assert product not in page and "product deleted" in page


def test_failures_are_grouped_by_reason_with_an_example(
    api: TestClient, psf_id: str, work: Callable[[], None], tmp_path: Path
) -> None:
    archive = tmp_path / "archive"
    write_image(archive / "good.fits")
    (archive / HOSTILE.replace("/", "-")).write_text("Dear archive,\n" * 300)
    (archive / "zz.fits").write_text("Dear reader,\n" * 300)
    write_image(archive / os.fsdecode(b"Sonne\xf6.fits"))
    request = {"files": [{"glob": f"{archive}/*.fits"}], "psf_id": psf_id, "parameters": FEW}
    made = api.post("/v1/bulk", json=request).json()
    work()
    page = api.get(f"/bulk/{made['id']}").text
    rows = re.findall(
        r'<td class="number">(\d+)</td><td><code>([\w-]+)</code></td><td class="name">(.+?)</td>', page
    )
    assert [(count, code) for count, code, _ in rows] == [("2", "not-fits"), ("1", "path-not-utf-8")]
    assert rows[0][2].startswith("&lt;script&gt;alert(1)&lt;-script&gt;.fits: ")
    assert "<script>alert" not in page
    every = api.get(f"/bulk/{made['id']}/failures").text
    assert every.count("<code>not-fits</code>") == 2 and "<script>alert" not in every
    assert "&lt;script&gt;alert" in every


def test_a_run_is_paused_resumed_retried_and_cancelled_by_its_buttons(
    api: TestClient, psf_id: str, tmp_path: Path
) -> None:
    uploaded(api, tmp_path, 1)
    place = started(api, psf_id)

    def buttons() -> set[str]:
        shown = re.findall(rf'action="{place}/(\w+)"([^>]*)>', api.get(place).text)
        return {name for name, rest in shown if not rest.endswith("hidden")}

    assert buttons() == {"pause", "cancel"}
    for change, phase, then in (
        ("pause", "PAUSED", {"resume", "cancel", "delete"}),
        ("resume", "RUNNING", {"pause", "cancel"}),
        ("cancel", "CANCELLED", {"delete"}),
    ):
        answer = api.post(f"{place}/{change}", follow_redirects=False)
        assert (answer.status_code, answer.headers["location"]) == (303, place)
        assert api.get(f"/v1{place}").json()["phase"] == phase
        assert buttons() == then
    refused = api.post(f"{place}/retry")
    assert refused.status_code == 409 and "CANCELLED" in refused.text
    assert api.post(f"{place}/destroy").status_code == 422


def test_a_run_is_deleted_by_its_button(
    api: TestClient, psf_id: str, work: Callable[[], None], tmp_path: Path
) -> None:
    uploaded(api, tmp_path, 1)
    place = started(api, psf_id, name="quiet Sun")
    refused = api.post(f"{place}/delete")
    assert (
        refused.status_code == 409 and "this bulk run is in phase RUNNING: cancel it first." in refused.text
    )
    work()
    page = api.get(place).text
    assert "The products stay." in page
    (product,) = re.findall(r'href="/products/(\w+)"', page)
    answer = api.post(f"{place}/delete", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/bulk")
    assert "quiet Sun" not in api.get("/bulk").text and "No run yet." in api.get("/bulk").text
    assert api.get(f"/products/{product}").status_code == 200
    gone = api.get(place)
    assert gone.status_code == api.post(f"{place}/delete").status_code == 404
    assert "There is no such bulk run here. It was deleted" in gone.text


def test_a_wrong_form_says_what_was_expected(
    subtests: pytest.Subtests, api: TestClient, tmp_path: Path
) -> None:
    uploaded(api, tmp_path, 1)
    for fields, told in (
        ({}, "choose one"),
        ({"choice": "psf:abc"}, "PSF: "),
        ({"choice": f"psf:{'0' * 64}"}, "There is no such PSF here"),
        ({"choice": "context:none"}, "none"),
        ({"choice": f"psf:{'0' * 64}", "name": "two\nlines"}, "Name: "),
        ({"choice": f"psf:{'0' * 64}", "steps": "many"}, "Steps: Input should be a valid integer"),
        ({"choice": f"psf:{'0' * 64}", "steps": "201"}, "Steps: Input should be less than or equal to 200"),
        (
            {"choice": f"psf:{'0' * 64}", "method": "magic"},
            "Method: expected name to be one of richardson-lucy",
        ),
    ):
        with subtests.test(str((fields, told))):
            refused = api.post("/bulk/start", data=fields)
            assert refused.status_code in (404, 409, 422) and told in refused.text
            assert refused.headers["Content-Type"].startswith("text/html")
            assert api.get("/v1/bulk").json()["items"] == []


def test_nobody_sees_or_changes_the_run_of_another_owner(settings: Settings, tmp_path: Path) -> None:
    with keyed(settings) as service:
        ann, bob = service.client("ann"), service.client("bob")
        reader = service.client("ann", Scope.READ)
        write_psf(tmp_path / "psf.fits")
        psf = upload(ann, tmp_path / "psf.fits", "/v1/psfs")
        uploaded(ann, tmp_path, 1)
        assert "Your key does not allow bulk runs" in reader.get("/bulk").text
        assert reader.post("/bulk/start", data={"choice": f"psf:{psf}"}).status_code == 403
        place = started(ann, psf)
        assert place not in bob.get("/bulk").text and place in reader.get("/bulk").text
        assert 'action="/bulk' not in reader.get(place).text
        assert bob.get(place).status_code == bob.get(f"{place}/failures").status_code == 404
        for change in ("cancel", "delete"):
            assert bob.post(f"{place}/{change}").status_code == 404
            assert reader.post(f"{place}/{change}").status_code == 403
        assert ann.get(f"/v1{place}").json()["phase"] == "RUNNING"
