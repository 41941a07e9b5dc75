"""Files that the browser itself refuses or checks, before they are sent."""

from __future__ import annotations

from pathlib import Path

from playwright.sync_api import Page, expect

from tests.transit_files import write_transit


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
        page.get_by_role("button", name="Upload").click()
        expect(page.get_by_role("alert")).to_contain_text(f"{name} {reason}")
    assert sent == []


def test_the_check_of_a_folder_says_what_was_checked(page: Page, tmp_path: Path) -> None:
    folder = write_transit(tmp_path / "mercury", images=3)
    with (folder / "001.fits").open("r+b") as file:
        file.truncate(3000)  # its content is checked by the service
    page.goto("/transits")
    page.set_input_files("#folder", folder)
    expect(page.locator("#upload-said")).to_contain_text("transit.json is correct, and its 4 files are there")
