"""The pages of bulk runs, by plain forms: start, progress, results, reasons of failures, and whose they are.
The form of a bulk run of files in a folder, by plain forms: the check before the start, the layout, and errors."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.pages import bulk as bulk_pages
from tests.conftest import write_image, write_psf
from tests.service.conftest import upload, work_through_bulks
from tests.service.keyed import keyed
from workers.catalogue.access import Scope
from workers.contract.bulk import FIELDS
from workers.settings import Settings

FEW = {"method": {"name": "richardson-lucy", "steps": 2}}
HOSTILE = "<script>alert(1)</script>.fits"


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


def test_a_run_from_the_form_uses_its_method_and_steps_for_a_limited_number_of_images(
    api: TestClient, psf_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uploaded(api, tmp_path, 2)
    page = api.get("/bulk").text
    usual = dict(re.findall(r'<option value="([a-z-]+)">\1, usually (\d+) steps</option>', page))
    assert next(iter(usual)) == "richardson-lucy" and usual["linear"] == "5" and 'max="1000"' in page
    monkeypatch.setattr(bulk_pages, "MOST_STARTED", 1)
    assert "the newest 1 of your images that have no product" in api.get("/bulk").text
    forms = (
        ({}, {"name": "richardson-lucy", "steps": 20}),
        ({"method": "linear", "steps": ""}, {"name": "linear", "steps": 5}),
        ({"method": "basic-iterative", "steps": "7"}, {"name": "basic-iterative", "steps": 7}),
    )
    for number, (fields, expected) in enumerate(forms):
        place = started(api, psf_id, name=str(number), **fields)
        run = api.get(f"/v1{place}").json()
        assert run["images"]["total"] == 1
        method = run["request"]["parameters"]["method"]
        assert {key: method[key] for key in expected} == expected
        assert f"<dd>{expected['name']}, {expected['steps']} steps</dd>" in api.get(place).text


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


def test_failures_are_grouped_by_reason_with_an_example(
    api: TestClient, psf_id: str, work: Callable[[], None], tmp_path: Path
) -> None:
    archive = tmp_path / "archive" / "mixed"
    archive.mkdir()
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
    assert api.post(f"{place}/delete").status_code == 409
    work()
    page = api.get(place).text
    assert "The products stay." in page
    (product,) = re.findall(r'href="/products/(\w+)"', page)
    assert api.delete(f"/v1/products/{product}").status_code == 204
    page = api.get(place).text
    assert product not in page and "product deleted" in page
    answer = api.post(f"{place}/delete", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/bulk")
    assert "quiet Sun" not in api.get("/bulk").text and "No run yet." in api.get("/bulk").text
    gone = api.get(place)
    assert gone.status_code == api.post(f"{place}/delete").status_code == 404
    assert "There is no such bulk run here. It was deleted" in gone.text


def test_a_wrong_form_says_what_was_expected(api: TestClient, tmp_path: Path) -> None:
    uploaded(api, tmp_path, 1)
    unknown = {"choice": f"psf:{'0' * 64}"}
    for fields, told in (
        ({}, "choose one"),
        ({"choice": "psf:abc"}, "PSF: "),
        (unknown, "There is no such PSF here"),
        ({"choice": "context:none"}, "none"),
        (unknown | {"name": "two\nlines"}, "Name: "),
        (unknown | {"steps": "1001"}, "Steps: Input should be less than or equal to 1000"),
        (unknown | {"method": "magic"}, "Method: expected name to be one of richardson-lucy"),
    ):
        refused = api.post("/bulk/start", data=fields)
        assert refused.status_code in (404, 409, 422) and told in refused.text, fields
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
        for address in ("start", "check", "files"):
            assert reader.post(f"/bulk/{address}", data={"choice": f"psf:{psf}"}).status_code == 403
        place = started(ann, psf)
        assert place not in bob.get("/bulk").text and place in reader.get("/bulk").text
        assert 'action="/bulk' not in reader.get(place).text
        assert bob.get(place).status_code == bob.get(f"{place}/failures").status_code == 404
        for change in ("cancel", "delete"):
            assert bob.post(f"{place}/{change}").status_code == 404
            assert reader.post(f"{place}/{change}").status_code == 403
        assert ann.get(f"/v1{place}").json()["phase"] == "RUNNING"


# --- files in a folder -----------------------------------------------------------------------------------


LAYOUT = "{telescop}/{date:%Y/%m/%d}/{stem}_sharp.fits"


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Two images, and a file that is none."""
    root = tmp_path / "archive"
    root.mkdir()
    for number in range(2):
        write_image(root / f"{number}.fits", seed=number, **{"DATE-BEG": "2021-03-01T12:00:00"})
    (root / "letter.fits").write_text("Dear archive,\n" * 300)
    return root


@pytest.fixture
def settings(settings: Settings, archive: Path, tmp_path: Path) -> Settings:
    out = tmp_path / "out"
    out.mkdir()
    return settings.model_copy(update={"bulk_roots": str(archive), "bulk_output_roots": str(out)})


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        client.headers["Accept"] = "text/html"
        yield client


@pytest.fixture
def form(api: TestClient, archive: Path, tmp_path: Path, psf_file: Path) -> dict[str, str]:
    """A form that is filled in."""
    psf_id = upload(api, psf_file, "/v1/psfs")
    return {
        "pattern": f"{archive}/*.fits", "choice": f"psf:{psf_id}", "name": "Rome", "method": "richardson-lucy",
        "steps": "2", "folder": str(tmp_path / "out"), "only": "1", "layout": LAYOUT,
    }  # fmt: skip


class _Fields(HTMLParser):
    """The fields of the forms of a page: which have labels, and what describes them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.labels = 0
        self.unlabelled: list[str] = []
        self.described: list[str] = []
        self.ids: list[str] = []
        self.values: dict[str, str] = {}
        self.hidden: dict[str, str] = {}
        self.feed(page)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attributes}
        self.labels += tag == "label"
        self.ids += [given["id"]] if "id" in given else []
        self.described += given.get("aria-describedby", "").split()
        if tag not in ("input", "select", "textarea"):
            return
        if given.get("type") == "hidden":
            self.hidden[given["name"]] = given["value"]
            return
        self.values[given["name"]] = given.get("value", "")
        if not self.labels:
            self.unlabelled.append(given["name"])

    def handle_endtag(self, tag: str) -> None:
        self.labels -= tag == "label"


def fact(page: str, name: str) -> str:
    """The value of a fact of a page, without markup."""
    found = re.search(rf"<dt>{name}</dt><dd>(.*?)</dd>", page)
    assert found is not None, name
    return unescape(re.sub("<.*?>", "", found[1]))


def runs(api: TestClient) -> list[dict[str, object]]:
    return list(api.get("/v1/bulk").json()["items"])


def test_the_form_names_the_folders_and_the_fields_of_a_layout(
    api: TestClient, form: dict[str, str], archive: Path, tmp_path: Path
) -> None:
    page = api.get("/bulk").text
    fields = _Fields(page)
    assert fields.unlabelled == [] and set(fields.described) <= set(fields.ids)
    assert len(set(fields.ids)) == len(fields.ids)
    assert set(form) <= set(fields.values)
    assert f"<code>{archive}</code>" in page and f"<code>{tmp_path / 'out'}</code>" in page
    assert all(f"<code>{{{name}}}</code>" in page for name in FIELDS)


def test_a_check_says_what_the_run_then_does(
    api: TestClient, form: dict[str, str], settings: Settings, tmp_path: Path
) -> None:
    page = api.post("/bulk/check", data=form).text
    assert runs(api) == [] and list((tmp_path / "out").iterdir()) == [], "nothing was started or written"
    estimate = {
        "files": [{"glob": form["pattern"]}], "psf_id": form["choice"][4:],
        "parameters": {"method": {"name": "richardson-lucy", "steps": 2}},
        "output": {"folder": form["folder"], "only": True, "layout": LAYOUT},
    }  # fmt: skip
    expected = api.post("/v1/bulk/estimate", json=estimate).json()
    assert fact(page, "Images") == "3" == str(expected["images"])
    assert expected["complete"] and 'class="good"' in page
    assert fact(page, "Examined") == "3 of 3 images; 1 would be refused"
    assert fact(page, "Memory").startswith(f"at most {expected['memory_mib']} MiB")
    assert fact(page, "Time").endswith("with 1 worker process")
    example = fact(page, "Output").removeprefix("for example ")
    assert example == expected["example_output"]
    assert re.fullmatch(rf"{tmp_path}/out/[\w-]+/2021/03/01/[01]_sharp\.fits", example)
    refused = re.search(r'<td class="id name">(.*?)</td><td class="name">(.*?)</td>', page)
    assert refused is not None and refused[1].endswith("letter.fits") and "not a FITS file" in refused[2]

    started = api.post("/bulk/files", data=_Fields(page).hidden, follow_redirects=False)
    assert started.status_code == 303
    run = api.get(f"/v1{started.headers['location']}").json()
    assert run["request"]["output"] == estimate["output"] and run["name"] == "Rome"
    page = api.get(started.headers["location"]).text
    said = {
        "Files": form["pattern"],
        "Method": "richardson-lucy, 2 steps",
        "Output": f"{form['folder']} only",
        "Names": LAYOUT,
    }
    assert {name: fact(page, name).strip() for name in said} == said
    assert fact(page, "PSF").startswith("uploaded 0.0.0")
    work_through_bulks(settings)
    done = api.get(f"/v1{started.headers['location']}").json()["images"]
    assert (done["total"], done["done"], done["failed"]) == (3, 2, 1)
    assert Path(example).is_file(), "the product is where the check said"


def test_a_wrong_form_is_shown_again_with_the_reason(
    api: TestClient, form: dict[str, str], archive: Path
) -> None:
    for wrong, told in (
        ({"pattern": ""}, "Expected a pattern that names files"),
        ({"pattern": "/etc/*.fits"}, "Expected a path below"),
        ({"pattern": "{archive}/*.none"}, "found no files"),
        ({"layout": "{nothing}.fits"}, "Names of the files: expected the fields stem"),
        ({"folder": ""}, "Expected an output folder, because"),
        ({"folder": "/etc"}, "Expected an output folder below"),
        ({"choice": "nothing"}, "Expected a PSF or a context"),
        ({"steps": "many"}, "Steps"),
        ({"name": "<script>alert(1)</script>" * 9}, "Name: "),
    ):
        wrong = {name: value.replace("{archive}", str(archive)) for name, value in wrong.items()}
        place = "/bulk/files" if "layout" in wrong else "/bulk/check"  # a start is refused as a check is
        answer = api.post(place, data=form | wrong)
        assert answer.status_code in (404, 422), answer.text
        alert = re.search(r'<div class="error" role="alert">(.*?)</div>', answer.text)
        assert alert is not None and told in unescape(alert[1]), answer.text
        values = _Fields(answer.text).values
        for name in ("pattern", "name", "folder", "layout"):
            assert values[name] == (form | wrong)[name], "nobody has to write it again"
        assert "<script>alert" not in answer.text
    assert runs(api) == []


def test_without_output_or_folders_the_page_says_what_is_missing(
    api: TestClient, form: dict[str, str], settings: Settings
) -> None:
    plain = form | {"folder": "", "only": "", "layout": ""}
    hidden = _Fields(api.post("/bulk/check", data=plain).text).hidden
    assert not {"folder", "only", "layout"} & set(hidden)
    place = api.post("/bulk/files", data=hidden, follow_redirects=False).headers["location"]
    assert api.get(f"/v1{place}").json()["request"]["output"] is None
    no_output, nothing = {"bulk_output_roots": ""}, {"bulk_output_roots": "", "bulk_roots": ""}
    for roots in (no_output, nothing):
        changed = create_app(settings.model_copy(update=roots))
        with TestClient(changed, headers={"Accept": "text/html"}) as without:
            page = without.get("/bulk").text
            fields = set(_Fields(page).values)
            assert ("pattern" in fields) == (roots is no_output) and not {"folder", "layout"} & fields
            assert ("HELIOPSF_BULK_ROOTS" in page) == (roots is nothing)
            refused = without.post("/bulk/check", data=form)
            assert refused.status_code == 422 and "HELIOPSF_BULK_" in refused.text


def test_a_check_that_comes_to_no_end_says_so(
    api: TestClient, form: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workers.bulk.dry_run.BUDGET_S", -1.0)
    page = api.post("/bulk/check", data=form).text
    assert fact(page, "Images") == "at least 0" and "The run may be larger." in page
