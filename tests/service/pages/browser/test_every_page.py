"""Every page with real contents: in light and dark, on a phone, and at a zoom of 200 %.

The pages of a service with keys (login, keys) are visited by ``test_login``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import BrowserType, Page, expect

from psfcore.transit.archive import pack
from tests.conftest import write_image, write_psf
from tests.service.pages.browser.checks import good
from tests.service.pages.browser.conftest import Watch
from tests.service.pages.browser.products import COORDINATES, made
from tests.service.pages.gap_report import GAP_ID, keep_gap_report, settings_of
from tests.transit_files import write_simulated, write_transit
from tests.whole.stack import Stack

UNSERVED = "unserved.test"
LONG_NAME = "solo_L2_eui-hrieuv174-image_20220401T103005920_pseudolinear_"
# Each page and a text of its contents.
PAGES = {
    "home": "Your latest products",
    "image": "Products of this image",
    "jobs": "Deconvolution",
    "job": "All parameters",
    "product": "Rerun and compare",
    "psfs": "other",
    "psf": "Reject: delete this draft",
    "psf's products": "Version of the PSF then",
    "comparison": "Ratio of the mean weights",
    "transits": "mercury.tar",
    "transit": "003.fits",
    "rerun": "bit for bit",
    "bulks": "mixed",
    "bulk": "Failures by reason",
    "failures": "already-deconvolved",
    "login": "needs no login",
    "keys": "keys are not used",
}


@pytest.fixture(scope="module")
def addresses(site: Stack, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The address of each page, after its contents were made."""
    folder, client = tmp_path_factory.mktemp("contents"), site.client
    product = made(site, folder, (96, 128), errors=True, **COORDINATES)
    psf_id = client.product(product.id)["psf_id"]
    write_psf(folder / "other.fits", scale=0.5)
    other = client.upload_psf(folder / "other.fits", name="other")["id"]
    client.compare_psfs(psf_id, other)
    rerun = client.rerun("product", product.id)
    write_image(folder / "done before.fits", PSFID="0" * 64)
    write_image(folder / "fresh.fits", seed=31)
    images = [client.upload_image(folder / name)["id"] for name in ("done before.fits", "fresh.fits")]
    run = client.submit_bulk(images=images, psf_id=psf_id, name="mixed")
    client.wait_for_bulk(run["id"])
    pack(write_transit(folder / "mercury", images=4), folder / "mercury.tar")
    transit = client.upload_transit(folder / "mercury.tar")["id"]
    job = next(one for one in client.jobs() if one["kind"] == "psf-tables")
    return {
        "home": "/",
        "image": f"/images/{product.image_id}",
        "jobs": "/jobs",
        "job": f"/jobs/{job['id']}",
        "product": product.page,
        "psfs": "/psfs",
        "psf": f"/psfs/{psf_id}",
        "psf's products": f"/psfs/{psf_id}/products",
        "comparison": f"/psfs/{psf_id}/vs/{other}",
        "transits": "/transits",
        "transit": f"/transits/{transit}",
        "rerun": f"/reports/{rerun['id']}",
        "bulks": "/bulk",
        "bulk": f"/bulk/{run['id']}",
        "failures": f"/bulk/{run['id']}/failures",
        "login": "/login",
        "keys": "/keys",
    }


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_good_in_every_way_to_look_at_it(page: Page, addresses: dict[str, str], name: str) -> None:
    page.goto(addresses[name])
    expect(page.locator("main")).to_contain_text(PAGES[name])
    expect(page.get_by_role("heading", level=1)).to_have_count(1)
    good(page)


@pytest.fixture(scope="module")
def long_addresses(site: Stack, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Pages that show a name of 60 characters without a space."""
    folder, client = tmp_path_factory.mktemp("long"), site.client
    write_image(folder / f"{LONG_NAME}.fits", seed=91)
    write_image(folder / f"2{LONG_NAME}.fits", seed=92, PSFID="0" * 64)
    write_psf(folder / "psf.fits", size=66)
    psf_id = client.upload_psf(folder / "psf.fits", name=LONG_NAME)["id"]
    product = client.deconvolve(folder / f"{LONG_NAME}.fits", folder / "o.fits", psf_id=psf_id, steps=2)
    again = client.upload_image(folder / f"2{LONG_NAME}.fits")["id"]
    run = client.submit_bulk(images=[again, product["image_id"]], psf_id=psf_id, name=LONG_NAME)
    client.wait_for_bulk(run["id"])
    pack(write_transit(folder / "transit", images=5), folder / f"{LONG_NAME}.tar")
    transit = client.upload_transit(folder / f"{LONG_NAME}.tar")["id"]
    return [
        "/",
        "/jobs",
        f"/images/{product['image_id']}?psf_id={psf_id}",
        f"/products/{product['id']}",
        "/psfs",
        f"/psfs/{psf_id}",
        f"/psfs/{psf_id}/products",
        "/bulk",
        f"/bulk/{run['id']}",
        f"/bulk/{run['id']}/failures",
        "/transits",
        f"/transits/{transit}",
    ]


@pytest.mark.parametrize("width", [320, 390, 768, 1024, 1280])
def test_a_long_name_makes_no_page_wider_than_its_window(
    page: Page, long_addresses: list[str], width: int
) -> None:
    page.set_viewport_size({"width": width, "height": 800})
    for address in long_addresses:
        page.goto(address)
        expect(page.get_by_text(LONG_NAME).first).to_be_attached()
        assert page.evaluate("document.documentElement.scrollWidth") <= width, address
        beyond = page.locator("main .card, main .card *").evaluate_all(
            "(all) => all.filter((one) => one.getBoundingClientRect().right > "
            "(one.closest('.card').getBoundingClientRect().right) + 1).map((one) => one.outerHTML.slice(0, 80))"
        )
        assert beyond == [], f"{address}: something is wider than its card"


@pytest.mark.parametrize(
    ("address", "status", "told"),
    [
        ("/nowhere", 404, "Nothing is at /nowhere."),
        (f"/products/{'0' * 64}", 404, "There is no such product here."),
        ("/images/short", 422, "/images/short is not the address of a page."),
    ],
)
def test_a_page_of_an_error_is_good(page: Page, watch: Watch, address: str, status: int, told: str) -> None:
    watch.allowed.append(str(status))
    answer = page.goto(address)
    assert answer is not None and answer.status == status
    expect(page.get_by_role("alert")).to_contain_text(told)
    good(page)


def test_the_page_of_a_name_that_is_not_served_is_good(
    browser_type: BrowserType, browser_type_launch_args: dict[str, Any], site: Stack
) -> None:
    rule = f"--host-resolver-rules=MAP {UNSERVED} 127.0.0.1"
    options = browser_type_launch_args | {"args": [*browser_type_launch_args["args"], rule]}
    with browser_type.launch(**options) as browser:
        page = browser.new_page()
        refused: list[str] = []
        page.on("response", lambda answer: refused.append(answer.url) if answer.status != 200 else None)
        address = f"http://{UNSERVED}:{urlsplit(site.client.server).port}/jobs"
        page.goto(address)
        expect(page.get_by_role("heading", level=1)).to_have_text("This host name is not served")
        expect(page.get_by_role("alert")).to_contain_text("use another address")
        good(page)
        assert refused == [address], "its style and pictures are there"


@pytest.mark.slow  # 20 s: it diagnoses a gap
def test_the_report_of_a_gap_is_good(page: Page, site: Stack) -> None:
    said: dict[str, Any] = keep_gap_report(settings_of(site.data))
    page.goto(f"/reports/{GAP_ID}")
    expect(page.locator("main")).to_contain_text(said["sentence"][:16])
    good(page)


@pytest.mark.slow  # half a minute: it fits a PSF seven times
def test_the_pages_of_a_fit_and_of_its_cross_validation_are_good(
    page: Page, site: Stack, tmp_path: Path
) -> None:
    folder = write_simulated(tmp_path / "simulated")
    psf = site.client.fit_psf(folder)
    transit = psf["details"]["provenance"]["parameters"]["transit_id"]
    job = site.client.wait(site.client.submit("cross-validate", transit_id=transit, runs=2))
    for address, told in (
        (f"/psfs/{psf['id']}", "Fit to the transit"),
        (job["result"].removeprefix("/v1"), "6 fits with held-out blocks"),
        (f"/transits/{transit}", psf["id"][:12]),
    ):
        page.goto(address)
        expect(page.locator("main")).to_contain_text(told)
        good(page)
