"""The first page in a browser."""

from __future__ import annotations

from playwright.sync_api import Page, expect

from tests.service.pages.browser.checks import good


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
    page.get_by_role("button", name="Upload").click()
    expect(page.get_by_role("alert")).to_contain_text('Expected a FITS file, which starts with "SIMPLE  ="')
