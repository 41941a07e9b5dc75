"""The form of a bulk run of files in a folder, by plain forms: the check before the start, the layout, and errors."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.pages import bulk
from tests.conftest import write_image
from tests.service.conftest import upload, work_through_bulks
from tests.service.keyed import keyed
from workers.catalogue.access import Scope
from workers.contract.bulk import FIELDS
from workers.settings import Settings

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


def test_a_check_without_an_output_folder(api: TestClient, form: dict[str, str]) -> None:
    page = api.post("/bulk/check", data=form | {"folder": "", "only": "", "layout": ""}).text
    assert fact(page, "Images") == "3" and "<dt>Output</dt>" not in page
    hidden = _Fields(page).hidden
    assert not {"folder", "only", "layout"} & set(hidden)
    place = api.post("/bulk/files", data=hidden, follow_redirects=False).headers["location"]
    assert api.get(f"/v1{place}").json()["request"]["output"] is None


def test_a_wrong_form_is_shown_again_with_the_reason(
    subtests: pytest.Subtests, api: TestClient, form: dict[str, str], archive: Path
) -> None:
    for wrong, told in (
        ({"pattern": ""}, "Expected a pattern that names files"),
        ({"pattern": "/etc/*.fits"}, "Expected a path below"),
        ({"pattern": "{archive}/*.none"}, "found no files"),
        ({"layout": "{nothing}.fits"}, "Names of the files: expected the fields stem"),
        ({"layout": "../{stem}.fits"}, "no part of the path that begins with a full stop"),
        ({"folder": ""}, "Expected an output folder, because"),
        ({"folder": "/etc"}, "Expected an output folder below"),
        ({"choice": "nothing"}, "Expected a PSF or a context"),
        ({"choice": "psf:" + "0" * 64}, "There is no such PSF here"),
        ({"steps": "many"}, "Steps"),
        ({"name": "<script>alert(1)</script>" * 9}, "Name: "),
    ):
        with subtests.test(str((wrong, told))):
            wrong = {name: value.replace("{archive}", str(archive)) for name, value in wrong.items()}
            answer = api.post("/bulk/check", data=form | wrong)
            assert answer.status_code in (404, 422), answer.text
            alert = re.search(r'<div class="error" role="alert">(.*?)</div>', answer.text)
            assert alert is not None and told in unescape(alert[1]), answer.text
            values = _Fields(answer.text).values
            for name in ("pattern", "name", "folder", "layout"):
                assert values[name] == (form | wrong)[name], "nobody has to write it again"
            assert "<script>alert" not in answer.text
            assert runs(api) == []


def test_a_start_that_is_refused_shows_the_form_again(api: TestClient, form: dict[str, str]) -> None:
    answer = api.post("/bulk/files", data=form | {"layout": "{stem}.jpg"}, follow_redirects=False)
    assert answer.status_code == 422 and "a relative path that ends in .fits" in answer.text
    assert _Fields(answer.text).values["layout"] == "{stem}.jpg" and runs(api) == []


def test_many_refused_images_are_counted_and_some_are_shown(
    api: TestClient, form: dict[str, str], archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bulk, "MOST_REFUSED", 2)
    for number in range(3):
        (archive / f"<b>{number}.fits").write_text("Dear reader,\n" * 300)
    page = api.post("/bulk/check", data=form).text
    assert "The first 2 of 4." in page and page.count('<td class="id name">') == 2
    assert "<b>" not in page and "/&lt;b&gt;0.fits" in page


def test_a_check_that_comes_to_no_end_says_so(
    api: TestClient, form: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workers.bulk.dry_run.BUDGET_S", -1.0)
    page = api.post("/bulk/check", data=form).text
    assert fact(page, "Images") == "at least 0" and "The run may be larger." in page


def test_without_folders_the_page_says_what_is_missing(settings: Settings, psf_file: Path) -> None:
    without = settings.model_copy(update={"bulk_roots": "", "bulk_output_roots": ""})
    with TestClient(create_app(without)) as api:
        upload(api, psf_file, "/v1/psfs")
        page = api.get("/bulk", headers={"Accept": "text/html"}).text
        assert "HELIOPSF_BULK_ROOTS" in page and 'name="pattern"' not in page


def test_without_output_folders_the_form_has_no_output(settings: Settings, psf_file: Path) -> None:
    without = settings.model_copy(update={"bulk_output_roots": ""})
    with TestClient(create_app(without)) as api:
        upload(api, psf_file, "/v1/psfs")
        fields = _Fields(api.get("/bulk", headers={"Accept": "text/html"}).text)
        assert "pattern" in fields.values and not {"folder", "layout"} & set(fields.values)


def test_a_key_without_the_scope_bulk_neither_checks_nor_starts(settings: Settings, psf_file: Path) -> None:
    with keyed(settings) as service:
        reader = service.client("ann", Scope.READ, Scope.SUBMIT)
        reader.headers["Accept"] = "text/html"
        assert 'name="pattern"' not in reader.get("/bulk").text
        for place in ("/bulk/check", "/bulk/files"):
            assert reader.post(place, data={"pattern": "/x"}).status_code == 403


def test_without_folders_a_run_of_files_is_refused_with_the_reason(
    api: TestClient, settings: Settings, form: dict[str, str]
) -> None:
    with TestClient(
        create_app(settings.model_copy(update={"bulk_roots": "", "bulk_output_roots": ""})),
        raise_server_exceptions=False,
    ) as without:
        for address in ("/bulk/check", "/bulk/files"):
            for fields in (form, {}):
                answer = without.post(address, data=fields, headers={"Accept": "text/html"})
                assert answer.status_code == 422 and 'role="alert"' in answer.text, address
            assert "HELIOPSF_BULK_ROOTS" in without.post(address, data=form).text
