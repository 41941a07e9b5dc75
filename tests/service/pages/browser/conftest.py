"""A real browser, and a service that it visits. Each test fails on a violation of the policy, on a request to another host,
and on an error in the console."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Request

from tests.whole import stack as stacks
from tests.whole.stack import Missing, Stack

VARIABLE = "HELIOPSF_CHROMIUM"
CANDIDATES = ("chromium", "chromium-browser", "google-chrome")
# WebGL2 in software, as on machines without a graphics card.
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture(scope="session")
def browser_type_launch_args(browser_type_launch_args: dict[str, object]) -> dict[str, object]:
    """Start the machine's Chromium. If the variable names one, its absence is an error and not a skip."""
    named = os.environ.get(VARIABLE)
    path = named or next(filter(None, map(shutil.which, CANDIDATES)), None)
    if path is None:
        pytest.skip(f"no Chromium on this machine: install it, or name one in {VARIABLE}")
    return browser_type_launch_args | {"executable_path": path, "args": [*SOFTWARE_GL, "--disable-quic"]}


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """An open service with an embedded worker."""
    with ExitStack() as resources:
        try:
            yield resources.enter_context(stacks.embedded(tmp_path_factory.mktemp("site")))
        except Missing as missing:
            pytest.skip(str(missing))


@pytest.fixture(scope="session")
def base_url(site: Stack) -> str:
    """The address that ``page.goto("/...")`` starts with."""
    return site.client.server


class Watch:
    """What a page did that no page may do. allowed: parts of console errors that a test expects."""

    def __init__(self, host: str) -> None:
        self._host = host
        self.found: list[str] = []
        self.allowed: list[str] = []

    def console(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning") and not any(part in message.text for part in self.allowed):
            self.found.append(f"console {message.type}: {message.text}")

    def request(self, request: Request) -> None:
        parts = urlsplit(request.url)
        if parts.scheme not in ("blob", "data") and parts.netloc != self._host:
            self.found.append(f"request to another host: {request.url}")

    def error(self, error: Exception) -> None:
        self.found.append(f"uncaught: {error}")


@pytest.fixture
def context(browser: Browser, base_url: str) -> Iterator[BrowserContext]:
    """A context of the service that the module visits. The plugin's own would keep the address of the first module."""
    context = browser.new_context(base_url=base_url)
    yield context
    context.close()


@pytest.fixture
def watch(context: BrowserContext, base_url: str) -> Iterator[Watch]:
    """Watches all pages of the context; the test fails if one did what none may do."""
    watch = Watch(urlsplit(base_url).netloc)

    def follow(page: Page) -> None:
        page.on("console", watch.console)
        page.on("request", watch.request)
        page.on("pageerror", watch.error)

    context.on("page", follow)
    yield watch
    assert watch.found == []


@pytest.fixture
def page(watch: Watch, context: BrowserContext) -> Page:
    """A page of a watched browser."""
    return context.new_page()
