"""The first page in a browser."""

from __future__ import annotations

from pathlib import Path

from playwright.sync_api import Page, expect

from tests.service.pages.browser.checks import good
from tests.transit_files import write_transit


def test_the_first_page_says_what_to_do(page: Page) -> None:
    page.goto("/")
    expect(page.get_by_role("heading", level=1)).to_have_text(
        "See the Sun without the smear of the telescope"
    )
    expect(page.get_by_label("Drop a FITS image")).to_be_visible()
    good(page)


def test_a_file_that_is_no_image_is_refused_before_it_is_sent(page: Page) -> None:
    page.goto("/")
    page.set_input_files("#file", {"name": "letter.fits", "mimeType": "text/plain", "buffer": b"Dear editor"})
    upload = page.get_by_role("button", name="Upload")
    upload.click()
    told = page.get_by_role("alert")
    no_fits = "is not a FITS file: a FITS file begins with SIMPLE. Choose another file."
    expect(told).to_have_text(f"letter.fits {no_fits}")
    for name, content, said in (
        ("empty.fits", b"", "empty.fits is empty. Choose another file."),
        ("binary.fits", bytes(range(0x80, 0xA0)), f"binary.fits {no_fits}"),
    ):
        page.set_input_files("#file", {"name": name, "mimeType": "application/fits", "buffer": content})
        upload.click()
        expect(told).to_have_text(said)


def test_the_check_of_a_folder_says_what_was_checked(page: Page, tmp_path: Path) -> None:
    folder = write_transit(tmp_path / "mercury", images=3)
    with (folder / "001.fits").open("r+b") as file:
        file.truncate(3000)  # its content is checked by the service
    page.goto("/transits")
    page.set_input_files("#folder", folder)
    said = page.locator("#upload-said")
    expect(said).to_contain_text("transit.json is correct, and its 4 files are there")
    expect(said).to_contain_text("The service checks the content of the files after the upload.")
