"""The page of a product in a browser.
Jobs in a browser: followed live to their product, and failed."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from astropy.io import fits
from playwright.sync_api import APIResponse, Browser, Page, Route, expect
from sqlalchemy import create_engine, delete

from tests.conftest import write_image
from tests.service.pages.browser.checks import good
from tests.service.pages.browser.conftest import LONG_MS, MARK, NOT_RELOADED, Site, Submit, logged_in
from tests.service.pages.browser.products import Looked, made
from tests.whole.stack import wait_for
from workers.catalogue.tables import ImageRow
from workers.settings import Settings


@pytest.fixture
def product(site: Site, tmp_path: Path, request: pytest.FixtureRequest) -> Looked:
    """A product of an image of the test's own."""
    return made(site.client, tmp_path, (64, 72), OBSERVER=request.node.name[:60])


def test_the_page_of_a_product_from_its_numbers_to_a_rerun(
    page: Page, browser: Browser, site: Site, product: Looked
) -> None:
    row = site.client.get(f"/v1/products/{product.id}")
    page.goto(product.page)
    main = page.locator("main")
    expect(main).to_contain_text(f"{row['details']['bright_change_pct']:+.3g} %")
    expect(main).to_contain_text("richardson-lucy")
    psf = page.get_by_role("link", name="psf 0.0.0").first
    assert psf.get_attribute("href") == f"/psfs/{row['psf_id']}"
    again = page.get_by_role("link", name="Deconvolve again with other options")
    href = f"/images/{product.image_id}?psf_id={row['psf_id']}&method=richardson-lucy&steps=5"
    assert again.get_attribute("href") == href
    expect(page.locator(".lineage")).to_contain_text(f"image {product.image_id[:12]}")
    page.get_by_label("Search the header").fill("dcnvmeth")
    expect(page.locator("#header tbody tr")).to_have_count(1)
    for name, file in (
        ("Download FITS", product.file),
        ("Original upload", product.file.parent / "sun.fits"),
    ):
        with page.expect_download() as download:
            page.get_by_role("link", name=name).click()
        assert Path(download.value.path()).read_bytes() == file.read_bytes()

    with browser.new_context(java_script_enabled=False, base_url=site.client.server) as context:
        plain = logged_in(context, site).new_page()
        plain.goto(product.page)
        expect(plain.locator("#viewer noscript img, #viewer img.picture").first).to_be_visible()
        expect(plain.locator("#viewer-body")).to_be_hidden()
        plain.get_by_role("button", name="Rerun and compare").click()
        expect(plain).to_have_url(re.compile("/jobs/"))
        job = plain.url.rpartition("/")[2]
    wait_for(lambda: bool(site.client.get(f"/v1/jobs/{job}")["result"]), "the rerun ends")
    page.reload()
    expect(main).to_contain_text("The new product is the same file, bit for bit.")


def test_title_download_and_blink_need_no_scrolling(page: Page, product: Looked) -> None:
    for width, height in ((1366, 768), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        page.goto(product.page)
        expect(page.locator("#zoom")).to_contain_text("%")
        for place in (
            page.get_by_role("heading", level=1),
            page.get_by_role("link", name="Download FITS"),
            page.get_by_role("button", name="Blink"),
            page.locator("#canvas"),
        ):
            box = place.bounding_box()
            assert box is not None and box["y"] >= 0 and box["y"] + box["height"] <= height, (width, place)
        page.get_by_role("button", name="Blink").click()
        expect(page.locator("#tag-left")).to_have_text(re.compile("before|after"))


def test_a_product_whose_image_was_deleted_is_shown_alone(page: Page, site: Site, product: Looked) -> None:
    engine = create_engine(Settings(data_dir=site.data, database_url=None).catalogue_url)
    with engine.begin() as connection:
        connection.execute(delete(ImageRow).where(ImageRow.id == product.image_id))
    engine.dispose()
    page.goto(product.page)
    expect(page.locator("main")).to_contain_text("The uploaded image was deleted")
    shown_alone(page)


def shown_alone(page: Page) -> None:
    """The viewer shows the product, and nothing of the image before."""
    expect(page.locator("#zoom")).to_contain_text("%")
    assert page.locator("#mode option").all_text_contents() == ["after"]
    page.focus("#canvas")
    page.keyboard.press("b")  # there is nothing to blink with
    page.keyboard.press("Shift+ArrowLeft")
    expect(page.locator('[data-value="before"]')).to_have_text("not there")
    expect(page.locator('[data-value="after"]')).to_contain_text("DN/s")
    expect(page.locator("#change-row")).to_have_count(0)


# --- jobs ------------------------------------------------------------------------------------------------


# Keeps each step that the bar shows. The page goes to the product at any moment, so the steps are kept beyond the page.
KEEP_STEPS = """() => {
    const keep = () => {
        const bar = document.querySelector("#job progress");
        if (bar) sessionStorage.setItem(`step ${bar.value}`, "");
    };
    keep();
    new MutationObserver(keep).observe(document, { subtree: true, childList: true, attributes: true });
}"""
KEPT_STEPS = "Object.keys(sessionStorage).filter((key) => key.startsWith('step '))"


def test_a_job_is_followed_to_its_product_without_a_reload(page: Page, submit: Submit) -> None:
    job = submit("large", 141)
    listed = page.context.new_page()
    listed.goto("/jobs")
    listed.evaluate(MARK)
    row = listed.locator(f"[data-job='{job['id']}']")
    page.goto(f"/jobs/{job['id']}")
    page.evaluate(MARK)
    expect(page.locator("[data-part=phase]")).to_have_text("EXECUTING", timeout=LONG_MS)
    expect(page.locator("#job [data-part=progress]")).to_contain_text("of 141")
    expect(page.get_by_alt_text("The uploaded image")).to_be_visible()
    assert page.evaluate(NOT_RELOADED)
    page.evaluate(KEEP_STEPS)
    expect(page).to_have_url(re.compile("/products/[0-9a-f]{64}"), timeout=LONG_MS)
    assert len(page.evaluate(KEPT_STEPS)) > 1, "the bar moves"
    product = re.escape(urlsplit(page.url).path)
    expect(row.locator("[data-part=phase]")).to_have_text("COMPLETED")
    expect(row.get_by_role("link", name="open")).to_have_attribute("href", re.compile(f"^{product}$"))
    assert listed.evaluate(NOT_RELOADED)
    page.go_back()
    expect(page).to_have_url("about:blank")  # and not the job's page, which would lead on at once


def test_an_answer_later_than_a_newer_event_is_not_shown(page: Page, site: Site, submit: Submit) -> None:
    job = submit("large", 139)
    held: list[tuple[Route, APIResponse]] = []
    page.route(f"**/v1/jobs/{job['id']}", lambda route: held.append((route, route.fetch())))
    page.goto(f"/jobs/{job['id']}")
    phase = page.locator("[data-part=phase]")
    expect(phase).to_have_text("EXECUTING", timeout=LONG_MS)
    site.client.cancel(job["id"])
    expect(phase).to_have_text("ABORTED", timeout=LONG_MS)
    assert held[0][1].json()["phase"] in ("QUEUED", "EXECUTING")
    for route, answer in held:
        with page.expect_event("requestfinished", lambda request: request == route.request):  # noqa: B023
            route.fulfill(response=answer)
    expect(phase).to_have_text("ABORTED")


def test_a_failed_job_says_why_and_what_to_do(
    page: Page, site: Site, files: dict[str, str], tmp_path: Path
) -> None:
    write_image(tmp_path / "dark.fits", shape=(64, 64))
    with fits.open(tmp_path / "dark.fits", mode="update") as file:
        file[0].data[:] = float("nan")
    image = site.client.upload_image(tmp_path / "dark.fits")["id"]
    method = {"name": "linear", "steps": 7}
    job = site.client.submit("deconvolve", image_id=image, psf_id=files["psf"], method=method)
    page.goto(f"/jobs/{job['id']}")
    expect(page.locator("[data-part=phase]")).to_have_text("ERROR", timeout=LONG_MS)
    message = site.client.job(job["id"])["error"]["message"]
    expect(page.get_by_role("alert")).to_contain_text(message[1:])
    good(page)
    page.get_by_role("link", name="Change the request and start again").click()
    expect(page).to_have_url(re.compile(f"/images/{image}[?]psf_id={files['psf']}&method=linear&steps=7$"))
    expect(page.locator("select[name=method]")).to_have_value("linear")
    expect(page.locator("input[name=steps]")).to_have_value("7")
    page.goto("/jobs")
    row = page.locator(f"[data-job='{job['id']}']")
    expect(row).to_contain_text("dark.fits")
    expect(row).to_contain_text(message[1:])


def test_the_report_of_a_product_prints_on_one_sheet(page: Page, site: Site, product: Looked) -> None:
    row = site.client.get(f"/v1/products/{product.id}")
    page.goto(product.page)
    page.get_by_role("link", name="Report on one page").click()
    main = page.locator("main")
    for told in (
        product.image_id,
        row["psf_id"],
        row["sha256"],
        f"{row['details']['flux_change_pct']:+.3g} %",
    ):
        expect(main).to_contain_text(told)
    good(page)
    sheets = page.pdf(prefer_css_page_size=True)
    assert len(re.findall(rb"/Type\s*/Page\b", sheets)) == 1
    page.emulate_media(media="print")
    expect(page.get_by_role("navigation")).to_be_hidden()
