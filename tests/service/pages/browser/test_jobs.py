"""Jobs in a browser: followed live in many tabs by one stream, cancelled, failed, and while the service is killed."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import psutil
import pytest
from astropy.io import fits
from playwright.sync_api import BrowserContext, Page, Request, expect

from tests.conftest import write_image, write_psf
from tests.service.pages.browser.checks import good
from tests.service.pages.browser.conftest import Watch
from tests.whole import stack as stacks
from tests.whole.stack import Stack, wait_for

LONG_MS = 120_000
TABS = 20
UPLOAD_BYTES_PER_S = 200_000
# Each noise realisation takes as long as one deconvolution.
LONG = {"error_draws": 16, "noise": {"photon_gain_dn": 1.0, "read_noise_dn": 1.0}}
MARK = "window.notReloaded = true"
NOT_RELOADED = "window.notReloaded"
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


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """A service of this file's own, because a test kills it."""
    with stacks.embedded(tmp_path_factory.mktemp("jobs")) as running:
        yield running


@pytest.fixture(scope="session")
def base_url(site: Stack) -> str:
    return site.client.server


@pytest.fixture(scope="module")
def files(site: Stack, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
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
def submit(site: Stack, files: dict[str, str]) -> Iterator[Any]:
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


def streams_open(site: Stack) -> int:
    """The number of streams of events that the service sends, by its metrics."""
    text = site.client._answer("GET", "/metrics").text
    (found,) = re.findall(r"^heliopsf_event_streams (\S+)$", text, flags=re.MULTILINE)
    return int(float(found))


def step(page: Page) -> int:
    """The step of the bar of a job."""
    return int(page.locator("#job progress").evaluate("(bar) => bar.value"))


def test_a_job_is_followed_to_its_product_without_a_reload(page: Page, submit: Any) -> None:
    job = submit("large", 41)
    listed = page.context.new_page()
    listed.goto("/jobs")
    listed.evaluate(MARK)
    row = listed.locator(f"[data-job='{job['id']}']")
    page.goto(f"/jobs/{job['id']}")
    page.evaluate(MARK)
    expect(page.locator("[data-part=phase]")).to_have_text("EXECUTING", timeout=LONG_MS)
    expect(page.locator("#job [data-part=progress]")).to_contain_text("of 41")
    assert page.evaluate(NOT_RELOADED)
    page.evaluate(KEEP_STEPS)
    expect(page).to_have_url(re.compile("/products/[0-9a-f]{64}"), timeout=LONG_MS)
    assert len(page.evaluate(KEPT_STEPS)) > 1, "the bar moves"
    product = re.escape(urlsplit(page.url).path)
    expect(row.locator("[data-part=phase]")).to_have_text("COMPLETED")
    expect(row.get_by_role("link", name="open")).to_have_attribute("href", re.compile(f"^{product}$"))
    assert listed.evaluate(NOT_RELOADED)
    good(listed)
    page.go_back()
    expect(page).to_have_url("about:blank")  # and not the job's page, which would lead on at once


def test_the_page_of_a_job_in_progress_is_good(page: Page, submit: Any) -> None:
    job = submit("large", 200)
    page.goto(f"/jobs/{job['id']}")
    expect(page.locator("#job [data-part=progress]")).to_contain_text("of 200", timeout=LONG_MS)
    good(page)


def test_a_waiting_job_tells_its_place_and_starts_when_it_is_its_turn(page: Page, submit: Any) -> None:
    jobs = [submit("large", steps, **LONG) for steps in (198, 199, 200)]
    page.goto(f"/jobs/{jobs[2]['id']}")
    page.evaluate(MARK)
    place = page.locator("#job [data-part=place]")
    expect(place).to_have_text("1 job starts before this one.", timeout=LONG_MS)
    good(page)
    other = page.context.new_page()
    other.goto(f"/jobs/{jobs[1]['id']}")
    expect(other.locator("#job [data-part=place]")).to_have_text("This job starts next.")
    other.get_by_role("button", name="Cancel the job").focus()
    other.keyboard.press("Enter")
    expect(other.locator("[data-part=phase]")).to_have_text("ABORTED")
    expect(other.get_by_role("link", name="Change the request and start again")).to_be_visible()
    good(other)
    expect(place).to_have_text("This job starts next.", timeout=20_000)
    other.goto(f"/jobs/{jobs[0]['id']}")
    other.get_by_role("button", name="Cancel the job").click()
    expect(other.locator("[data-part=phase]")).to_have_text("ABORTED", timeout=LONG_MS)
    expect(page.locator("[data-part=phase]")).to_have_text("EXECUTING", timeout=LONG_MS)
    expect(place).to_be_hidden()
    assert page.evaluate(NOT_RELOADED)


def test_a_failed_job_says_why_and_what_to_do(
    page: Page, site: Stack, files: dict[str, str], tmp_path: Path
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
    told = f"{message[:1].upper()}{message[1:]}."
    expect(page.get_by_role("alert")).to_have_text(told)
    good(page)
    page.get_by_role("link", name="Change the request and start again").click()
    expect(page).to_have_url(re.compile(f"/images/{image}[?]psf_id={files['psf']}&method=linear&steps=7$"))
    expect(page.locator("select[name=method]")).to_have_value("linear")
    expect(page.locator("input[name=steps]")).to_have_value("7")
    page.goto("/jobs")
    row = page.locator(f"[data-job='{job['id']}']")
    expect(row).to_contain_text("dark.fits")
    expect(row).to_contain_text(told)


@pytest.mark.slow  # half a minute: it runs real jobs
def test_the_page_continues_after_the_service_was_killed(
    page: Page, watch: Watch, site: Stack, submit: Any
) -> None:
    watch.allowed += ["ERR_CONNECTION_REFUSED", "ERR_INCOMPLETE_CHUNKED_ENCODING", "ERR_CONNECTION_RESET"]
    job = submit("large", 150)
    page.goto(f"/jobs/{job['id']}")
    page.evaluate(MARK)
    expect(page.locator("#job [data-part=progress]")).to_contain_text("of 150", timeout=LONG_MS)
    wait_for(lambda: step(page) > 1, "the job is at work")
    assert site.server is not None
    processes = [psutil.Process(site.server.pid), *site.worker_processes()]
    for process in processes:
        process.kill()
    psutil.wait_procs(processes, timeout=10)
    lost = page.locator("#lost")
    expect(lost).to_contain_text("The service does not answer.", timeout=20_000)
    page.get_by_role("button", name="Cancel the job").click()
    expect(lost).to_contain_text("Nothing is lost: wait a moment, then try again.")
    expect(page).to_have_url(re.compile(f"/jobs/{job['id']}$"))
    good(page)
    site.start_server(int(site.client.server.rpartition(":")[2]))
    expect(lost).to_be_hidden(timeout=20_000)
    expect(page.locator("[data-part=attempts]")).to_have_text("2", timeout=LONG_MS)
    expect(page.locator("[data-part=phase]")).to_have_text("EXECUTING")
    wait_for(lambda: step(page) > 1, "the bar moves again")
    assert page.evaluate(NOT_RELOADED)


def test_a_service_that_is_lost_during_an_upload_is_told_and_the_file_is_kept(
    page: Page, watch: Watch, site: Stack, tmp_path: Path
) -> None:
    watch.allowed += ["ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET", "ERR_EMPTY_RESPONSE", "ERR_FAILED"]
    write_image(tmp_path / "long.fits", shape=(1024, 1024), seed=77)
    page.goto("/")
    page.set_input_files("#file", tmp_path / "long.fits")
    slowed = page.context.new_cdp_session(page)
    slowed.send("Network.enable")
    slow = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": UPLOAD_BYTES_PER_S}
    slowed.send("Network.emulateNetworkConditions", slow)
    page.get_by_role("button", name="Upload").click()
    bar = page.locator("#sending-bar")
    wait_for(lambda: bar.evaluate("(bar) => bar.value > 0"), "a part was sent")
    assert site.server is not None
    site.server.kill()
    site.server.wait()
    told = page.get_by_role("alert")
    expect(told).to_contain_text("The connection to the service ended before all of long.fits had arrived")
    expect(told).to_contain_text("The file is still chosen: send it again.")
    expect(page.locator("#sending")).to_be_hidden()
    good(page)
    slowed.detach()
    site.start_server(int(site.client.server.rpartition(":")[2]))
    page.get_by_role("button", name="Upload").click()
    expect(page).to_have_url(re.compile("/images/[0-9a-f]{64}$"), timeout=20_000)


@pytest.mark.slow  # half a minute: it runs real jobs
def test_twenty_tabs_share_one_stream_and_another_tab_takes_over(
    context: BrowserContext, watch: Watch, site: Stack, submit: Any
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
