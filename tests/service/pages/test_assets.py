"""The files that pages load: where they come from, who uses them, and how much a page weighs."""

from __future__ import annotations

import gzip
import hashlib
import re
import tomllib
from importlib.resources import files
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.pages import assets
from service.pages.rendering import templates
from tests.conftest import write_image
from tests.service.conftest import upload, work_through_bulks
from tests.workers.jobs import run_job
from workers.catalogue.catalogue import Catalogue
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings

PAGES = Path(str(files("service.pages")))
VENDOR = PAGES / "vendor"
TEMPLATES = templates()
# Budgets of a page, gzipped: bytes. ALL: without pictures.
HTML, CSS, OWN_SCRIPTS, ALL, PICTURES = 15_000, 10_000, 40_000, 90_000, 90_000
FEW = {"method": {"name": "richardson-lucy", "steps": 2}}


def packages() -> list[dict[str, object]]:
    return list(tomllib.loads((VENDOR / "vendor.toml").read_text("utf-8"))["package"])


def vendored() -> dict[str, str]:
    """The hash of each file of another project, by its name, as vendor.toml says."""
    return {name: digest for one in packages() for name, digest in dict(one["sha256"]).items()}  # type: ignore[call-overload]


# Where the files come from --------------------------------------------------------------------------


def test_files_of_others_are_as_they_came_and_nothing_else_lies_beside_them() -> None:
    found = {one.name: hashlib.sha256(one.read_bytes()).hexdigest() for one in VENDOR.iterdir()}
    found.pop("vendor.toml")
    assert found == vendored()


def test_a_package_of_others_names_its_version_licence_and_origin() -> None:
    for package in packages():
        assert re.fullmatch(r"\d+\.\d+\.\d+", str(package["version"])), package
        assert re.fullmatch(r"sha512-[A-Za-z0-9+/]{86}==", str(package["integrity"])), package
        assert package["licence"] in ("MIT", "BSD-3-Clause", "Apache-2.0"), package
        assert any("LICENSE" in name for name in dict(package["sha256"])), "its licence comes with it"  # type: ignore[call-overload]


# Who uses them --------------------------------------------------------------------------------------


def imported_by(name: str) -> set[str]:
    """The scripts that a script imports, at once or later."""
    text = assets.assets()[name].read_text("utf-8")
    return set(re.findall(r'(?:from|import)\s*\(?\s*"\./([\w.-]+)"', text))


def named_by(template: str) -> set[str]:
    """The files that a template names, with those of the templates that it extends or imports."""
    text = TEMPLATES[template]
    parts = re.findall(r"{%-?\s*(?:extends|from|include|import)\s+['\"]([\w./-]+)['\"]", text)
    return set(re.findall(r"asset\('([\w.-]+)'\)", text)).union(*map(named_by, parts))


def loaded_by(template: str) -> set[str]:
    """All files that the page of a template loads, with the scripts that its scripts import."""
    found, left = set(), named_by(template)
    while left:
        found |= left
        left = {name for one in left if one.endswith(".js") for name in imported_by(one)} - found
    return found


def test_each_file_is_used_by_a_page() -> None:
    used = set[str]().union(*map(loaded_by, TEMPLATES))
    there = {path.name for path in (PAGES / "static").iterdir()}
    assert there - used == set()
    of_reference = {"swagger-ui.css", "swagger-ui-bundle.js"}  # of the package fastapi-swagger
    assert used - there - set(vendored()) == of_reference, "no page names a file that is not there"


# How much a page weighs -----------------------------------------------------------------------------


def test_the_scripts_and_styles_of_a_page_are_light() -> None:
    of_others = set(vendored())
    for template in TEMPLATES.keys() - {"docs.html"}:  # Swagger UI alone is larger
        size = {name: len(gzip.compress(assets.assets()[name].read_bytes())) for name in loaded_by(template)}
        for suffix, most in ((".css", CSS), (".js", OWN_SCRIPTS)):
            own = [size[name] for name in size.keys() - of_others if name.endswith(suffix)]
            assert sum(own) <= most, template
        pictures = sum(size[name] for name in size if name.endswith(".jpg"))
        assert pictures <= PICTURES, template
        assert sum(size.values()) - pictures + HTML <= ALL, template


@pytest.fixture
def filled(api: TestClient, settings: Settings, psf_file: Path, tmp_path: Path) -> TestClient:
    """A service with a list of jobs that fills a page, a product, and a bulk run with done and failed images."""
    psf_id = upload(api, psf_file, "/v1/psfs")
    ids = []
    for number in range(4):
        write_image(tmp_path / f"{number}.fits", shape=(64, 64), seed=number)
        ids.append(upload(api, tmp_path / f"{number}.fits"))
    write_image(tmp_path / "product.fits", PSFID="0" * 64)
    ids.append(upload(api, tmp_path / "product.fits"))
    asked = {"image_id": ids[0], "psf_id": psf_id, **FEW}
    api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": asked})
    catalogue = Catalogue(settings.catalogue_url)
    runner = Runner(settings, catalogue, Store(settings.data_dir))
    for row in catalogue.jobs.of_kind("deconvolve"):
        run_job(runner, catalogue, row.id)
    api.post("/v1/bulk", json={"images": ids, "psf_id": psf_id, "parameters": FEW})
    work_through_bulks(settings)
    for steps in range(3, 60):
        method = {"name": "richardson-lucy", "steps": steps}
        api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": asked | {"method": method}})
    catalogue.close()
    api.headers["Accept"] = "text/html"
    return api


def links(page: str) -> set[str]:
    """The pages that a page links to."""
    found = {
        address.partition("#")[0].replace("&amp;", "&") for address in re.findall(r'href="(/[^"]*)"', page)
    }
    return {address for address in found if not address.startswith(("/v1/", "/static/", "/docs"))}


def test_every_page_that_links_lead_to_is_light_and_holds_no_inline_script_or_style(
    filled: TestClient,
) -> None:
    left, seen = {"/", "/login", "/keys"}, dict[str, str]()
    while left:
        address = left.pop()
        answer = filled.get(address)
        seen[address] = answer.text
        assert answer.status_code == 200, address
        assert len(gzip.compress(answer.content)) <= HTML, address
        assert answer.headers["Content-Type"].startswith("text/html"), address
        assert re.findall(r"<script(?![^>]* src=)", answer.text) == [], address
        assert re.findall(r"<style|<[^>]+\s(?:style|on\w+)=", answer.text) == [], address
        left |= links(answer.text) - seen.keys()
    for kind in ("/images/", "/jobs/", "/products/", "/bulk/"):
        assert any(address.startswith(kind) for address in seen), kind
    assert any("/failures" in address for address in seen)
