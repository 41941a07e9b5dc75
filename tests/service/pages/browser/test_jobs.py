"""Jobs in a browser: followed live to their product, and failed."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import urlsplit

from astropy.io import fits
from playwright.sync_api import Page, expect

from tests.conftest import write_image
from tests.service.pages.browser.checks import good
from tests.service.pages.browser.conftest import LONG_MS, MARK, NOT_RELOADED, Site, Submit

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
