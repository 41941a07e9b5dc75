"""Pages that follow a job while the service is killed, and many tabs at a time: on a service of this file's own."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

import httpx
import psutil
import pytest
from playwright.sync_api import BrowserContext, Page, Request, expect

from tests.service.pages.browser.checks import good
from tests.service.pages.browser.conftest import LONG_MS, MARK, NOT_RELOADED, Site, Submit, Watch
from tests.whole import stack as stacks
from tests.whole.stack import Stack, wait_for

pytestmark = pytest.mark.slow  # half a minute each: they run real jobs
TABS = 20
# Each noise realisation takes as long as one deconvolution.
LONG = {"error_draws": 16, "noise": {"photon_gain_dn": 1.0, "read_noise_dn": 1.0}}


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    with stacks.embedded(tmp_path_factory.mktemp("jobs")) as running:
        yield running


@pytest.fixture(scope="module")
def site(stack: Stack) -> Site:
    return Site(stack.client, stack.data)


def streams_open(site: Site) -> int:
    """The number of streams of events that the service sends, by its metrics."""
    text = httpx.get(f"{site.client.server}/metrics", timeout=60).text
    (count,) = re.findall(r"^heliopsf_event_streams (\S+)$", text, flags=re.MULTILINE)
    return int(float(count))


def done(page: Page) -> float:
    """The share of a job that its bar shows as done."""
    return float(page.locator("#job progress").evaluate("(bar) => bar.position"))


def test_the_page_continues_after_the_service_was_killed(
    page: Page, watch: Watch, site: Site, stack: Stack, submit: Submit
) -> None:
    watch.allowed += ["ERR_CONNECTION_REFUSED", "ERR_INCOMPLETE_CHUNKED_ENCODING", "ERR_CONNECTION_RESET"]
    job = submit("large", 150, **LONG)
    page.goto(f"/jobs/{job['id']}")
    page.evaluate(MARK)
    expect(page.locator("#job [data-part=progress]")).to_contain_text("of 150", timeout=LONG_MS)
    wait_for(lambda: done(page) > 0, "the job is at work")
    assert stack.server is not None
    processes = [psutil.Process(stack.server.pid), *stack.worker_processes()]
    for process in processes:
        process.kill()
    psutil.wait_procs(processes, timeout=10)
    lost = page.locator("#lost")
    expect(lost).to_contain_text("The service does not answer.", timeout=20_000)
    page.get_by_role("button", name="Cancel the job").click()
    expect(lost).to_contain_text("Nothing is lost: wait a moment, then try again.")
    expect(page).to_have_url(re.compile(f"/jobs/{job['id']}$"))
    good(page)
    stack.start_server(int(site.client.server.rpartition(":")[2]))
    expect(lost).to_be_hidden(timeout=20_000)
    expect(page.locator("[data-part=attempts]")).to_have_text("2", timeout=LONG_MS)
    expect(page.locator("[data-part=phase]")).to_have_text("EXECUTING")
    wait_for(lambda: done(page) > 0, "the bar moves again")
    assert page.evaluate(NOT_RELOADED)


def test_twenty_tabs_share_one_stream_and_another_tab_takes_over(
    context: BrowserContext, watch: Watch, site: Site, submit: Submit
) -> None:
    asked: list[Request] = []
    context.on("request", lambda request: asked.append(request) if _of_stream(request) else None)
    wait_for(lambda: streams_open(site) == 0, "the streams of earlier tests have ended")
    job = submit("large", 197, **LONG)
    wait_for(lambda: site.client.job(job["id"])["progress"]["step"] > 1, "the job is at work")
    tabs = []
    for number in range(TABS):
        tab = context.new_page()
        tab.goto("/jobs" if number % 2 else f"/jobs/{job['id']}")
        tabs.append(tab)
    begun = time.monotonic()
    told = [_progress(tab, job["id"]) for tab in tabs]
    for tab, before in zip(tabs, told, strict=True):
        wait_for(lambda: _progress(tab, job["id"]) != before, "every tab shows progress", 20)  # noqa: B023
    assert tabs[-1].evaluate("fetch('/healthz').then((answer) => answer.status)") == 200
    assert time.monotonic() - begun < 30
    assert (streams_open(site), len(asked)) == (1, 1)
    (leader,) = [tab for tab in tabs if asked[0].frame.page == tab]
    followers = [tab for tab in tabs if tab != leader]
    with context.expect_event("request", _of_stream):
        leader.close()
    assert asked[1].frame.page in followers
    wait_for(lambda: streams_open(site) == 1, "one stream again")
    told = [_progress(tab, job["id"]) for tab in followers]
    for tab, before in zip(followers, told, strict=True):
        wait_for(lambda: _progress(tab, job["id"]) != before, "every tab shows progress again", 20)  # noqa: B023
    assert len(asked) == 2


def _progress(tab: Page, job_id: str) -> str:
    return tab.locator(f"[data-job='{job_id}'] [data-part=progress]").inner_text()


def _of_stream(request: Request) -> bool:
    return urlsplit(request.url).path == "/v1/events"
