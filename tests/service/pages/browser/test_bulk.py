"""Bulk runs in a browser: started by the form, followed live, changed by the buttons, and shown as a contact sheet."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.conftest import write_image, write_psf
from tests.service.pages.browser.checks import good
from tests.service.pages.browser.conftest import Site
from tests.whole.stack import wait_for

LONG_MS = 120_000
MARK = "window.notReloaded = true"


@pytest.fixture(scope="module")
def psf_id(site: Site, tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("psf") / "psf.fits"
    write_psf(file, size=128)
    identity: str = site.client.upload_psf(file)["id"]
    return identity


def uploaded(site: Site, folder: Path, count: int, *, side: int, seed: int) -> list[str]:
    found = []
    for number in range(count):
        path = folder / f"sun {seed + number}.fits"
        write_image(path, shape=(side, side), seed=seed + number)
        found.append(str(site.client.upload_image(path)["id"]))
    return found


def test_a_run_started_by_the_form_is_followed_to_its_end_without_a_reload(
    page: Page, site: Site, psf_id: str, tmp_path: Path
) -> None:
    uploaded(site, tmp_path, 2, side=256, seed=500)
    page.goto("/bulk")
    page.get_by_label("PSF").first.select_option(f"psf:{psf_id}")
    page.get_by_label("Name").first.fill("quiet Sun")
    page.get_by_role("button", name="Start").first.focus()
    page.keyboard.press("Enter")
    expect(page).to_have_url(re.compile("/bulk/[0-9a-f]{32}$"))
    page.evaluate(MARK)
    # Among the images are those of other tests, one of which cannot be deconvolved.
    expect(page.locator("[data-part=phase]")).to_have_text(re.compile("^COMPLETED"), timeout=LONG_MS)
    assert int(page.locator("[data-part=total]").inner_text()) >= 2
    expect(page.locator("[data-part=left]")).to_have_text("none")
    expect(page.locator("[data-part=ended]")).to_contain_text("UTC")
    expect(page.get_by_role("button", name="Pause")).to_be_hidden()
    assert page.evaluate("window.notReloaded"), "the script showed all this"

    page.get_by_role("link", name="Show them").click()
    cards = page.locator(".sheet li")
    expect(cards).to_have_count(int(page.locator("[data-part=done]").inner_text()))
    picture = cards.locator("img").first
    picture.scroll_into_view_if_needed()
    wait_for(lambda: picture.evaluate("(one) => one.complete"), "the picture is loaded")
    assert max(picture.evaluate("(one) => [one.naturalWidth, one.naturalHeight]")) == 192
    expect(cards.locator("a").first).to_have_attribute("href", re.compile("^/products/[0-9a-f]{64}$"))
    good(page)
    page.goto("/bulk")
    expect(page.get_by_role("link", name="quiet Sun")).to_be_visible()


def test_a_run_is_deleted_and_other_tabs_see_it(page: Page, site: Site, psf_id: str, tmp_path: Path) -> None:
    images = uploaded(site, tmp_path, 2, side=256, seed=760)
    run = site.client.submit_bulk(images=images, psf_id=psf_id, name="not needed")
    site.client.pause_bulk(run["id"])
    line, same = page.context.new_page(), page.context.new_page()
    line.goto("/bulk")
    same.goto(f"/bulk/{run['id']}")
    for other in (line, same):
        other.evaluate(MARK)
    row = line.locator(f"[data-bulk='{run['id']}']")
    expect(row).to_be_visible()
    page.goto(f"/bulk/{run['id']}")
    page.get_by_text("Delete", exact=True).click()
    page.get_by_role("button", name="Delete the run").click()
    expect(page).to_have_url(re.compile("/bulk$"))
    expect(page.locator(f"[data-bulk='{run['id']}']")).to_have_count(0)
    expect(row).to_have_count(0)
    expect(same.locator("#lost")).to_have_text(re.compile("deleted"))
    expect(same.get_by_role("button", name="Resume")).to_be_hidden()
    assert line.evaluate("window.notReloaded") and same.evaluate("window.notReloaded")


def test_a_run_whose_images_fail_says_so_without_a_reload(
    page: Page, site: Site, psf_id: str, tmp_path: Path
) -> None:
    write_image(tmp_path / "product.fits", seed=740, PSFID="0" * 64)
    image = str(site.client.upload_image(tmp_path / "product.fits")["id"])
    busy = uploaded(site, tmp_path, 1, side=512, seed=741)
    method = {"name": "richardson-lucy", "steps": 100}
    before = site.client.submit_bulk(images=busy, psf_id=psf_id, name="before", method=method)
    run = site.client.submit_bulk(images=[image], psf_id=psf_id, name="all fail")
    page.goto(f"/bulk/{run['id']}")
    page.evaluate(MARK)
    site.client.wait_for_bulk(before["id"])
    phase = page.locator("[data-part=phase]")
    expect(phase).to_have_text("COMPLETED, 1 of 1 failed", timeout=LONG_MS)
    expect(phase).to_have_class("phase flawed")
    row = page.get_by_role("region", name="Failures by reason").locator("tbody tr")
    expect(row).to_contain_text("product.fits: This file is a product of heliopsf")
    assert page.evaluate("window.notReloaded"), "the script showed all this"
    shown = page.locator("#bulk").inner_text()
    page.reload()
    expect(row).to_have_count(1)
    assert page.locator("#bulk").inner_text() == shown
    page.goto("/bulk")
    line = page.locator(f"[data-bulk='{run['id']}'] [data-part=phase]")
    expect(line).to_have_text("COMPLETED, 1 of 1 failed")
    expect(line).to_have_class("phase flawed")
