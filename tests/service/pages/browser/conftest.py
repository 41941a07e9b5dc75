"""A real browser, and the service that it visits. Each test fails on a violation of the policy, on a request to another
host, and on an error in the console."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import (
    Browser,
    BrowserContext,
    BrowserType,
    ConsoleMessage,
    Page,
    Playwright,
    Request,
    sync_playwright,
)

from service.client.http import Client
from tests.chromium import chromium
from tests.conftest import write_image, write_psf
from tests.whole.stack import Stack, wait_for
from workers.catalogue.tables import DEFAULT_OWNER

collect_ignore_glob = [] if chromium() else ["test_*.py"]  # tests/chromium.py says so in one line
# A name that the service does not serve, and one that browsers do not take for this machine, so HTTP is not secure
# there.
UNSERVED, PLAIN_NAME = "unserved.test", "sun.test"
# WebGL2 in software, as on machines without a graphics card.
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


LONG_MS = 120_000
MARK, NOT_RELOADED = "window.notReloaded = true", "window.notReloaded"
Submit = Callable[..., dict[str, Any]]


@dataclass(frozen=True)
class Site:
    """A service as one of its owners sees it. data: the folder of its files."""

    client: Client
    data: Path
    owner: str = DEFAULT_OWNER
    key: str | None = None


@pytest.fixture(scope="session")
def browser_type_launch_args() -> dict[str, object]:
    """Start the machine's Chromium, which finds this machine at both names."""
    names = ", ".join(f"MAP {name} 127.0.0.1" for name in (UNSERVED, PLAIN_NAME))
    return {
        "executable_path": chromium(),
        "args": [*SOFTWARE_GL, "--disable-quic", f"--host-resolver-rules={names}"],
    }


@pytest.fixture(scope="package")
def playwright() -> Iterator[Playwright]:
    """The driver. It ends with this folder: while it lasts, an event loop runs in the thread of the tests, and no other
    test can run one."""
    with sync_playwright() as running:
        yield running


@pytest.fixture(scope="package")
def browser_type(playwright: Playwright) -> BrowserType:
    return playwright.chromium


@pytest.fixture(scope="package")
def browser(browser_type: BrowserType, browser_type_launch_args: dict[str, object]) -> Iterator[Browser]:
    browser = browser_type.launch(**browser_type_launch_args)  # type: ignore[arg-type]
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def site(keyed_stack: Stack) -> Iterator[Site]:
    """The shared service, for an owner of the module's own."""
    owner = f"browser-{uuid.uuid4().hex[:12]}"
    key = keyed_stack.key(owner)
    with Client(keyed_stack.client.server, key=key) as client:
        yield Site(client, keyed_stack.data, owner, key)


@pytest.fixture(scope="module")
def base_url(site: Site) -> str:
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


def logged_in(context: BrowserContext, site: Site) -> BrowserContext:
    """The context with a session of the site's owner, if the site needs a login."""
    if site.key is not None:
        answer = context.request.post("/login", form={"key": site.key}, max_redirects=0)
        assert answer.status == 303, answer.text()
    return context


@pytest.fixture
def context(browser: Browser, site: Site) -> Iterator[BrowserContext]:
    """A context of the service that the module visits, logged in."""
    context = browser.new_context(base_url=site.client.server)
    yield logged_in(context, site)
    context.close()


@pytest.fixture
def watch(context: BrowserContext, site: Site) -> Iterator[Watch]:
    """Watches all pages of the context; the test fails if one did what none may do."""
    watch = Watch(urlsplit(site.client.server).netloc)

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


@pytest.fixture(scope="module")
def files(site: Site, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Ids of a large image, a small one, and a PSF."""
    folder = tmp_path_factory.mktemp("files")
    write_image(folder / "large.fits", shape=(1024, 1024))
    write_image(folder / "small.fits", shape=(128, 128), seed=2)
    write_psf(folder / "psf.fits", size=128)
    upload = site.client.upload_image
    return {
        "large": upload(folder / "large.fits")["id"],
        "small": upload(folder / "small.fits")["id"],
        "psf": site.client.upload_psf(folder / "psf.fits")["id"],
    }


@pytest.fixture
def submit(site: Site, files: dict[str, str]) -> Iterator[Submit]:
    """Submits a deconvolution (image, steps, further parameters); whatever runs at the end of a test is cancelled."""
    made = []

    def submitted(image: str, steps: int, **more: Any) -> dict[str, Any]:
        method = {"name": "richardson-lucy", "steps": steps}
        asked = {"image_id": files[image], "psf_id": files["psf"], "method": method, **more}
        job = site.client.submit("deconvolve", **asked)
        made.append(job["id"])
        return job

    yield submitted
    for job in made:
        site.client.cancel(job)
    wait_for(lambda: all(site.client.job(job)["ended_at"] for job in made), "the jobs have ended")
