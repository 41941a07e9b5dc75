"""Every page with real contents and long names: in light and dark, on a phone, at a zoom of 200 %, in windows of any
width.

The pages of the login and of keys are visited by ``test_login``.
"""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page, expect

from psfcore.transit.archive import pack
from tests.conftest import write_image, write_psf
from tests.service.pages.browser.checks import fits, good
from tests.service.pages.browser.conftest import UNSERVED, Site, Watch
from tests.service.pages.browser.products import COORDINATES, write_sun
from tests.service.pages.gap_report import GAP_ID, keep_gap_report, settings_of
from tests.transit_files import write_simulated, write_transit
from tests.whole.stack import Stack

NAME = "solo_L2_eui-hrieuv174-image_20220401T103005920_pseudolinear_"  # 60 characters without a space
WIDTHS = (320, 768, 1024)  # beside those that ``good`` looks at
BEYOND_THEIR_CARDS = """(all) => all.filter((one) => one.getBoundingClientRect().right >
    one.closest(".card").getBoundingClientRect().right + 1).map((one) => one.outerHTML.slice(0, 80))"""


@pytest.fixture(scope="module")
def pages(site: Site, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The address of each page, and a text of its contents, after the contents were made."""
    folder, client = tmp_path_factory.mktemp("contents"), site.client
    write_sun(folder / f"{NAME}.fits", (96, 128), **COORDINATES)
    write_image(folder / f"2{NAME}.fits", PSFID="0" * 64)
    write_image(folder / "fresh.fits", seed=31)
    for name, scale in (("one", 1.0), ("other", 0.5)):
        write_psf(folder / f"{name}.fits", scale=scale)
    psf = client.upload_psf(folder / "one.fits", name=NAME)["id"]
    other = client.upload_psf(folder / "other.fits", name="other")["id"]
    client.compare_psfs(psf, other)
    noise = {"noise": (4.0, 1.0), "error_draws": 2}
    product = client.deconvolve(folder / f"{NAME}.fits", folder / "o.fits", psf_id=psf, steps=2, **noise)
    rerun = client.rerun("product", product["id"])
    images = [client.upload_image(folder / name)["id"] for name in (f"2{NAME}.fits", "fresh.fits")]
    run = client.submit_bulk(images=images, psf_id=psf, name=NAME)["id"]
    client.wait_for_bulk(run)
    pack(write_transit(folder / "transit", images=4), folder / f"{NAME}.tar")
    transit = client.upload_transit(folder / f"{NAME}.tar")["id"]
    job = next(one["id"] for one in client.jobs() if one["kind"] == "psf-tables")
    return {
        "/": NAME,
        f"/images/{product['image_id']}?psf_id={psf}": NAME,
        "/jobs": NAME,
        f"/jobs/{job}": "All parameters",
        f"/products/{product['id']}": NAME,
        f"/products/{product['id']}/print": f"Deconvolution of {NAME}",
        "/psfs": NAME,
        f"/psfs/{psf}": NAME,
        f"/psfs/{psf}/products": NAME,
        f"/psfs/{psf}/vs/{other}": "Ratio of the mean weights",
        "/transits": NAME,
        f"/transits/{transit}": NAME,
        f"/reports/{rerun['id']}": "bit for bit",
        "/bulk": NAME,
        f"/bulk/{run}": NAME,
        f"/bulk/{run}/failures": "already-deconvolved",
    }


def test_every_page_is_good_and_no_wider_than_its_window(page: Page, pages: dict[str, str]) -> None:
    for address, text in pages.items():
        page.goto(address)
        expect(page.get_by_text(text).first).to_be_attached()
        expect(page.get_by_role("heading", level=1)).to_have_count(1)
        good(page)
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 800})
            fits(page, width)
            beyond = page.locator("main .card, main .card *").evaluate_all(BEYOND_THEIR_CARDS)
            assert beyond == [], f"{address} at {width} px: something is wider than its card"


def test_a_page_of_an_error_is_good(page: Page, watch: Watch) -> None:
    watch.allowed.append("404")
    answer = page.goto("/nowhere")
    assert answer is not None and answer.status == 404
    expect(page.get_by_role("alert")).to_contain_text("/nowhere")
    good(page)


def test_the_page_of_a_name_that_is_not_served_is_good(browser: Browser, open_stack: Stack) -> None:
    address = f"http://{UNSERVED}:{urlsplit(open_stack.client.server).port}/jobs"
    page = browser.new_page()
    refused: list[str] = []
    page.on("response", lambda answer: refused.append(answer.url) if answer.status != 200 else None)
    page.goto(address)
    expect(page.get_by_role("heading", level=1)).to_have_text("This host name is not served")
    good(page)
    assert refused == [address], "its style and pictures are there"
    page.close()


@pytest.mark.slow  # 20 s: it diagnoses a gap
def test_the_report_of_a_gap_is_good(page: Page, site: Site) -> None:
    report = keep_gap_report(settings_of(site.data), site.owner)
    page.goto(f"/reports/{GAP_ID}")
    # The page begins with "WHERE: a gap of".
    expect(page.locator("main")).to_contain_text(report["sentence"][2:16])
    good(page)


@pytest.mark.slow  # half a minute: it fits a PSF seven times
def test_the_pages_of_a_fit_and_of_its_cross_validation_are_good(
    page: Page, site: Site, tmp_path: Path
) -> None:
    psf = site.client.fit_psf(write_simulated(tmp_path / "simulated"))
    transit = psf["details"]["provenance"]["parameters"]["transit_id"]
    job = site.client.wait(site.client.submit("cross-validate", transit_id=transit, runs=2))
    for address, text in (
        (f"/psfs/{psf['id']}", "Fit to the transit"),
        (job["result"].removeprefix("/v1"), "6 fits with held-out blocks"),
        (f"/transits/{transit}", psf["id"][:12]),
    ):
        page.goto(address)
        expect(page.locator("main")).to_contain_text(text)
        good(page)
