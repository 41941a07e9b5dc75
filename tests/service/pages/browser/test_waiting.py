"""Jobs that wait, and a service that is lost during an upload: on a service of this file's own, for which nobody
works."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.conftest import write_image
from tests.service.pages.browser.checks import good
from tests.service.pages.browser.conftest import MARK, NOT_RELOADED, Site, Submit, Watch
from tests.whole import stack as stacks
from tests.whole.stack import Stack, wait_for

UPLOAD_BYTES_PER_S = 200_000


@pytest.fixture(scope="module")
def lonely(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    with stacks.alone(tmp_path_factory.mktemp("lonely"), {"HELIOPSF_LEASE_S": "600"}) as running:
        yield running


@pytest.fixture(scope="module")
def site(lonely: Stack) -> Site:
    return Site(lonely.client, lonely.data)


def test_a_waiting_job_tells_its_place_and_starts_when_it_is_its_turn(
    page: Page, lonely: Stack, submit: Submit
) -> None:
    jobs = [submit("small", steps)["id"] for steps in (3, 4, 5)]
    catalogue = lonely.catalogue()
    first = catalogue.jobs.claim(jobs[0], "host:1")
    assert first is not None
    page.goto(f"/jobs/{jobs[2]}")
    page.evaluate(MARK)
    place = page.locator("#job [data-part=place]")
    expect(place).to_have_text("1 job starts before this one.")
    good(page)
    other = page.context.new_page()
    other.goto(f"/jobs/{jobs[1]}")
    expect(other.locator("#job [data-part=place]")).to_have_text("This job starts next.")
    other.get_by_role("button", name="Cancel the job").focus()
    other.keyboard.press("Enter")
    expect(other.locator("[data-part=phase]")).to_have_text("ABORTED")
    expect(other.get_by_role("link", name="Change the request and start again")).to_be_visible()
    good(other)
    expect(place).to_have_text("This job starts next.", timeout=20_000)
    other.goto(f"/jobs/{jobs[0]}")
    other.get_by_role("button", name="Cancel the job").click()
    wait_for(lambda: lonely.client.job(jobs[0])["cancel_requested"], "the job is to be cancelled")
    catalogue.jobs.abort(first)
    expect(other.locator("[data-part=phase]")).to_have_text("ABORTED")
    last = catalogue.jobs.claim(jobs[2], "host:1")
    assert last is not None
    expect(page.locator("[data-part=phase]")).to_have_text("EXECUTING", timeout=20_000)
    expect(place).to_be_hidden()
    assert page.evaluate(NOT_RELOADED)
    good(page)
    catalogue.jobs.requeue(last)
    catalogue.close()


def test_a_service_that_is_lost_during_an_upload_is_told_and_the_file_is_kept(
    page: Page, watch: Watch, lonely: Stack, tmp_path: Path
) -> None:
    watch.allowed += ["ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET", "ERR_EMPTY_RESPONSE", "ERR_FAILED"]
    write_image(tmp_path / "long.fits", shape=(1024, 1024), seed=77)
    page.goto("/")
    slowed = page.context.new_cdp_session(page)
    slowed.send("Network.enable")
    slow = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": UPLOAD_BYTES_PER_S}
    slowed.send("Network.emulateNetworkConditions", slow)
    page.set_input_files("#file", tmp_path / "long.fits")
    bar = page.locator("#sending-bar")
    wait_for(lambda: bar.evaluate("(bar) => bar.value > 0"), "a part was sent")
    assert lonely.server is not None
    lonely.server.kill()
    lonely.server.wait()
    expect(page.locator("#files li")).to_contain_text("ended before all of long.fits had arrived")
    expect(page.locator("#sending")).to_be_hidden()
    good(page)
    slowed.detach()
    lonely.start_server(int(lonely.client.server.rpartition(":")[2]))
    page.get_by_role("button", name="Upload").click()
    expect(page).to_have_url(re.compile("/images/[0-9a-f]{64}$"), timeout=20_000)
