"""The page of a product in a browser."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect
from sqlalchemy import create_engine, delete

from tests.service.pages.browser.conftest import Site, Watch, logged_in
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


def test_a_deleted_product_leaves_its_image(page: Page, site: Site, product: Looked, watch: Watch) -> None:
    page.goto(product.page)
    page.get_by_text("Delete this product").click()
    page.get_by_role("button", name="Delete", exact=True).click()
    expect(page).to_have_url(f"{site.client.server}/images/{product.image_id}")
    watch.allowed.append("404")
    page.goto(product.page)
    expect(page.get_by_role("alert")).to_be_visible()


def test_a_product_whose_image_was_deleted_is_shown_alone(page: Page, site: Site, product: Looked) -> None:
    engine = create_engine(Settings(data_dir=site.data, database_url=None).catalogue_url)
    with engine.begin() as connection:
        connection.execute(delete(ImageRow).where(ImageRow.id == product.image_id))
    engine.dispose()
    page.goto(product.page)
    expect(page.locator("main")).to_contain_text("The uploaded image was deleted")
    shown_alone(page)


def test_a_product_whose_upload_is_lost_is_shown_alone(page: Page, site: Site, product: Looked) -> None:
    remove_file(site, product.image_id)
    page.goto(product.page)
    expect(page.get_by_role("alert")).to_contain_text("The file of the uploaded image is lost")
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


def remove_file(site: Site, digest: str) -> None:
    """Lose a stored file."""
    [stored] = (site.data / "blobs").rglob(f"{digest}*")
    stored.unlink()


def test_a_lost_file_is_told(page: Page, site: Site, product: Looked) -> None:
    remove_file(site, site.client.get(f"/v1/products/{product.id}")["sha256"])
    page.goto(product.page)
    expect(page.get_by_role("alert")).to_contain_text("The file of this product is lost.")
    expect(page.locator("#viewer")).to_have_count(0)
    expect(page.locator("img.picture")).to_be_visible()
    assert Axe().run(page).violations_count == 0
