"""The way of a person who has read nothing: an image, its page, its job, its product."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.conftest import write_image, write_psf
from tests.service.pages.browser.checks import good
from tests.service.pages.browser.conftest import LONG_MS, Site
from tests.transit_files import write_transit

MOST_TABS = 60


@pytest.fixture
def image_file(tmp_path: Path) -> Path:
    write_image(tmp_path / "sun.fits", shape=(128, 96), seed=11)
    return tmp_path / "sun.fits"


@pytest.fixture
def psf_id(site: Site, tmp_path: Path) -> str:
    write_psf(tmp_path / "psf.fits", size=64)
    identity: str = site.client.upload_psf(tmp_path / "psf.fits")["id"]
    return identity


def test_options_are_checked_when_they_change(page: Page, site: Site, image_file: Path, psf_id: str) -> None:
    image = site.client.upload_image(image_file)["id"]
    method = {"name": "richardson-lucy", "steps": 2}
    site.client.wait(site.client.submit("deconvolve", image_id=image, psf_id=psf_id, method=method))
    page.goto(f"/images/{image}?psf_id={psf_id}&steps=2")
    go, checked = page.locator("#go"), page.locator("#checked")
    expect(go).to_have_text("Open the product")
    page.locator("input[name=steps]").fill("4")
    page.locator("input[name=steps]").press("Tab")
    expect(go).to_have_text("Start")
    page.locator("input[name=error_draws]").fill("8")
    page.locator("input[name=error_draws]").press("Tab")
    expect(checked).to_have_class("good")  # the noise of this camera is measured in the image
    page.get_by_label("Photon gain (DN)").fill("4")
    page.get_by_label("Photon gain (DN)").press("Tab")
    expect(checked).not_to_have_class("good")
    expect(go).to_have_text("Check and start")
    page.get_by_label("Read noise (DN)").fill("1.5")
    page.get_by_label("Read noise (DN)").press("Tab")
    expect(checked).to_have_class("good")
    go.click()
    expect(page).to_have_url(re.compile("/products/[0-9a-f]{64}"), timeout=LONG_MS)
    product = site.client.product(page.url.rpartition("/")[2])
    assert product["details"]["parameters"]["noise"] == {"photon_gain_dn": 4.0, "read_noise_dn": 1.5}
    page.get_by_role("link", name="Deconvolve again with other options").click()
    expect(page.get_by_label("Read noise (DN)")).to_have_value("1.5")
    expect(page.locator("input[name=error_draws]")).to_have_value("8")
    expect(go).to_have_text("Open the product")


def test_a_dropped_file_is_sent(page: Page, image_file: Path) -> None:
    page.goto("/")
    sent = list(image_file.read_bytes())
    page.evaluate(
        """(bytes) => {
            const transfer = new DataTransfer();
            transfer.items.add(new File([new Uint8Array(bytes)], "dropped.fits"));
            document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, bubbles: true }));
        }""",
        sent,
    )
    expect(page.get_by_role("heading", level=1)).to_have_text(re.compile("sun.fits|dropped.fits"))


def test_several_files_are_sent_one_after_the_other_and_deconvolved(
    page: Page, site: Site, tmp_path: Path
) -> None:
    """A letter among them is refused, an image of an unknown telescope is told so, and the others are started."""
    known = {"DETECTOR": "HRI_EUV", "WAVELNTH": 174, "CDELT1": 0.492, "CDELT2": 0.492}
    write_image(tmp_path / "known.fits", seed=41, **known)
    write_image(tmp_path / "unknown.fits", seed=42)
    (tmp_path / "letter.fits").write_text("Dear editor")
    page.goto("/")
    page.set_input_files("#file", [tmp_path / f"{name}.fits" for name in ("letter", "known", "unknown")])
    lines = page.locator("#files li")
    expect(lines).to_contain_text(
        ["is not a FITS file", "known.fits: started", "unknown.fits: No PSF for TEST is known here."]
    )
    good(page)
    started = {one["parameters"]["image_id"]: one["id"] for one in site.client.jobs() if not one["ended_at"]}
    image_id = hashlib.sha256((tmp_path / "known.fits").read_bytes()).hexdigest()
    assert list(started) == [image_id]
    site.client.cancel(started[image_id])


def test_a_psf_is_uploaded_where_the_page_says_that_none_is_known(
    page: Page, image_file: Path, tmp_path: Path
) -> None:
    write_psf(tmp_path / "mine.fits", size=64, scale=0.9)
    page.goto("/")
    page.set_input_files("#file", image_file)
    expect(page.locator("#checked")).to_have_class("error")
    expect(page.locator("#checked")).to_contain_text("No PSF for TEST is known here.")
    expect(page.locator("#go")).to_be_disabled()
    good(page)
    page.get_by_label("Upload a PSF").set_input_files(tmp_path / "mine.fits")
    expect(page).to_have_url(re.compile("[?]psf_id=[0-9a-f]{64}$"))
    expect(page.locator("#checked")).to_have_class("good")
    expect(page.locator("#go")).to_have_text("Start")
    picture = page.get_by_role("img", name="The image as it was uploaded")
    assert picture.evaluate("(one) => [one.naturalWidth, one.naturalHeight]") == [96, 128]


def test_a_psf_of_another_channel_is_offered_only_when_it_is_allowed(
    page: Page, site: Site, tmp_path: Path
) -> None:
    aia = {"TELESCOP": "SDO/AIA", "CDELT1": 0.6, "CDELT2": 0.6}
    write_image(tmp_path / "a.fits", seed=51, WAVELNTH=193, **aia)
    write_psf(tmp_path / "p.fits", size=64, scale=0.8)
    image = site.client.upload_image(tmp_path / "a.fits")["id"]
    psf = site.client.upload_psf(tmp_path / "p.fits", instrument="aia_171", channel="171")["id"]
    page.goto(f"/images/{image}")
    page.get_by_text("Options").click()
    offer = page.locator(f"option[value='{psf}']")
    expect(offer).to_be_disabled()
    page.get_by_label("Allow a PSF of another telescope").check()
    expect(offer).to_be_enabled()
    page.locator("select[name=psf_id]").select_option(psf)
    expect(page.locator("#checked")).to_have_class("good")


def test_a_file_that_is_no_image_is_refused_before_it_is_sent(page: Page) -> None:
    page.goto("/")
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if request.method == "POST" else None)
    for name, content, reason in (
        ("letter.fits", b"Dear editor", "is not a FITS file"),
        ("empty.fits", b"", "is empty"),
        ("binary.fits", bytes(range(0x80, 0xA0)), "is not a FITS file"),
    ):
        page.set_input_files("#file", {"name": name, "mimeType": "application/fits", "buffer": content})
        expect(page.locator("#files li")).to_contain_text(
            [f"{name} {reason}"]
        )  # and none of the earlier files
    assert sent == []


def test_a_folder_is_checked_and_then_sent(page: Page, tmp_path: Path) -> None:
    folder = write_transit(tmp_path / "mercury", images=3)
    page.goto("/transits")
    (folder / "001.fits").rename(tmp_path / "001.fits")
    page.set_input_files("#folder", folder)
    expect(page.get_by_label("What the check found")).to_contain_text("001.fits is missing in the folder")
    (tmp_path / "001.fits").rename(folder / "001.fits")
    page.set_input_files("#folder", folder)
    expect(page).to_have_url(re.compile("/transits/[0-9a-f]{64}$"), timeout=20_000)
    expect(page.get_by_role("heading", level=1)).to_have_text("mercury.tar")


def tab_to(page: Page, place: Locator) -> None:
    """Press the tabulator key until a place has the focus."""
    for _ in range(MOST_TABS):
        page.keyboard.press("Tab")
        if place.evaluate("(one) => one === document.activeElement"):
            return
    raise AssertionError(f"{place} was not reached in {MOST_TABS} steps")


def test_the_keyboard_alone_leads_from_a_file_to_a_blinked_product(
    page: Page, image_file: Path, psf_id: str
) -> None:
    page.goto("/")
    tab_to(page, page.locator("#file"))
    # The system's own dialog is no part of the page. A browser that showed pages for long does not always report it to
    # tests.
    page.locator("#file").evaluate(
        "(input) => input.addEventListener('click', (event) => { event.preventDefault(); window.asked = "
        "event.isTrusted; })"
    )
    page.keyboard.press("Space")
    assert page.evaluate("window.asked"), "the key opens the dialog"
    page.set_input_files("#file", image_file)
    expect(page).to_have_url(re.compile("/images/[0-9a-f]{64}$"))
    psfs = page.locator("select[name=psf_id]")
    tab_to(page, psfs)
    for _ in range(psfs.locator("option").count()):
        if psfs.input_value() == psf_id:
            break
        page.keyboard.press("ArrowDown")
    expect(psfs).to_have_value(psf_id)
    tab_to(page, page.locator("input[name=steps]"))
    page.keyboard.type("3")
    tab_to(page, page.locator("#go"))
    expect(page.locator("#go")).to_have_text("Start")
    page.keyboard.press("Enter")
    expect(page).to_have_url(re.compile("/products/[0-9a-f]{64}"), timeout=LONG_MS)
    expect(page.locator("#zoom")).to_contain_text("%")
    modes = page.locator("#mode")
    tab_to(page, modes)
    for _ in range(modes.locator("option").count()):
        if modes.input_value() == "blink":
            break
        page.keyboard.press("ArrowDown")
    expect(modes).to_have_value("blink")
    tab_to(page, page.locator("#canvas"))
    shown = page.locator("#tag-left")
    # The tag of the new mode is written with the next picture.
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    first = shown.inner_text()
    assert first in ("before", "after")
    page.keyboard.press("b")
    expect(shown).to_have_text("after" if first == "before" else "before")
    page.keyboard.press("b")
    expect(shown).to_have_text(first)
