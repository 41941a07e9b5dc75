"""What every page must fulfil."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, NamedTuple

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, TimeoutError


class View(NamedTuple):
    """How a person looks at a page. width, height: of the window, CSS px. scale: device pixels for one CSS px.
    rules: whether the rules of accessibility are checked too, which depend on the scheme and on the layout."""

    scheme: Literal["light", "dark"]
    width: int
    height: int
    scale: int = 1
    rules: bool = True


# A window of 1280 px at a zoom of 200 % is 640 CSS px wide, and one CSS px is two pixels of the screen.
VIEWS = {
    "light": View("light", 1280, 900),
    "dark on a phone": View("dark", 390, 844),
    "zoom of 200 %": View("dark", 640, 450, 2, rules=False),
}


def good(page: Page) -> None:
    """No violation of accessibility rules and no horizontal scrolling: in light and dark, on a phone, and at a zoom of
    200 %."""
    before = page.viewport_size
    assert before is not None
    for name, view in VIEWS.items():
        with seen_as(page, view):
            if view.rules:
                report = Axe().run(page)
                assert report.violations_count == 0, f"{page.url}, {name}: {report.generate_report()}"
            fits(page, view.width)
    page.emulate_media(color_scheme="light")
    page.set_viewport_size(before)


def fits(page: Page, width: int) -> None:
    """No part of the page is beyond its window, as soon as its plots have been drawn again."""
    try:
        page.wait_for_function("(width) => document.documentElement.scrollWidth <= width", arg=width)
    except TimeoutError as late:
        now = page.evaluate("document.documentElement.scrollWidth")
        raise AssertionError(f"{page.url}: in a window of {width} px the page is {now} px wide") from late


@contextmanager
def seen_as(page: Page, view: View) -> Iterator[None]:
    """Show the page in this way."""
    page.emulate_media(color_scheme=view.scheme)
    page.set_viewport_size({"width": view.width, "height": view.height})
    # Playwright gives a scale only to new contexts. This one lasts as long as the session with the browser.
    devtools = page.context.new_cdp_session(page)
    size = {"width": view.width, "height": view.height, "deviceScaleFactor": view.scale, "mobile": False}
    devtools.send("Emulation.setDeviceMetricsOverride", size)
    try:
        assert page.evaluate("[innerWidth, devicePixelRatio]") == [view.width, view.scale]
        yield
    finally:
        devtools.detach()
