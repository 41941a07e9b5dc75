"""Logging in with a real browser: the headers and cookies are its own."""

from __future__ import annotations

import re
import time
import uuid
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page, Route, expect
from sqlalchemy import create_engine, update

from tests.conftest import write_image, write_psf
from tests.service.pages.browser.checks import good
from tests.service.pages.browser.conftest import PLAIN_NAME, Site, Watch
from tests.whole.stack import Stack
from workers.catalogue.access import Scope, SessionRow
from workers.settings import Settings

ELSEWHERE = "http://elsewhere.test/"


@pytest.fixture(scope="module")
def site(keyed_stack: Stack) -> Site:
    """The shared service, seen by nobody in particular: the tests log in themselves."""
    return Site(keyed_stack.client, keyed_stack.data)


@pytest.fixture
def owner() -> str:
    return f"ann-{uuid.uuid4().hex[:8]}"


@pytest.fixture
def key(keyed_stack: Stack, owner: str) -> str:
    return keyed_stack.key(owner, Scope.READ, Scope.SUBMIT)


def log_in(page: Page, key: str) -> None:
    page.get_by_label("Your key").fill(key)
    page.get_by_role("button", name="Log in").click()


def test_a_person_logs_in_makes_a_key_and_logs_out(page: Page, owner: str, key: str) -> None:
    page.goto("/jobs?phase=ERROR")
    expect(page.get_by_role("heading", level=1)).to_have_text("Log in")
    good(page)
    log_in(page, key)
    expect(page).to_have_url(re.compile(r"/jobs\?phase=ERROR$"))
    page.get_by_role("link", name=owner).click()
    page.get_by_text("Make a key").click()
    good(page)
    page.get_by_label("Purpose").fill("for a script")
    page.get_by_role("button", name="Make the key").click()
    shown = page.get_by_label("Key", exact=True)
    expect(shown).to_have_value(re.compile(r"hpsf_[0-9a-f]{16}_[\w-]{43}"))
    page.set_viewport_size({"width": 390, "height": 844})
    assert shown.evaluate("(box) => box.scrollHeight <= box.clientHeight"), "no part of the key is cut"
    good(page)
    row = page.get_by_role("row").filter(has_text="for a script")
    row.get_by_text("Revoke", exact=True).click()
    row.get_by_role("button", name="Revoke").click()
    expect(page.get_by_role("row").filter(has_text="for a script")).to_contain_text("revoked")
    page.get_by_role("button", name="Log out").click()
    page.goto("/jobs")
    expect(page.get_by_role("heading", level=1)).to_have_text("Log in")


@pytest.mark.parametrize(
    ("address", "place", "button", "size"),
    [
        # A refusal that comes before the end of the file.
        ("/", "#file", "Upload", 2400),
        ("/psfs", "#psf-file", "Upload a whole PSF", 96),
    ],
)
def test_after_the_end_of_a_session_a_chosen_file_is_kept(
    page: Page,
    key: str,
    watch: Watch,
    keyed_stack: Stack,
    tmp_path: Path,
    address: str,
    place: str,
    button: str,
    size: int,
) -> None:
    watch.allowed += ["401", "ERR_CONNECTION"]
    if address == "/psfs":
        write_psf(tmp_path / "one.fits", size=size, scale=0.7)
    else:
        write_image(tmp_path / "one.fits", shape=(size, size), seed=size)
    page.goto(address)
    log_in(page, key)
    # Without its script the page would send the form itself and leave for the login: wait until the script has run.
    expect(page.get_by_role("button", name="Log out")).to_be_visible()
    page.wait_for_load_state("load")
    end_sessions(keyed_stack, key)
    page.set_input_files(place, tmp_path / "one.fits")
    if address == "/psfs":
        page.get_by_role("button", name=button).click()
    note = page.locator("#session-ended")
    expect(note).to_contain_text("Your login has ended", timeout=20_000)
    expect(page.get_by_role("alert")).to_have_count(1)
    good(page)
    with page.expect_popup() as opened:
        note.get_by_role("link", name="Log in in a new tab").click()
    other = opened.value
    expect(other.get_by_role("heading", level=1)).to_have_text("Log in")
    log_in(other, key)
    expect(other.get_by_role("button", name="Log out")).to_be_visible()
    other.close()
    page.get_by_role("button", name=button).click()
    expect(page).to_have_url(re.compile("/(images|psfs)/[0-9a-f]{64}$"), timeout=20_000)


def end_sessions(stack: Stack, key: str) -> None:
    """End the sessions of a key, as time does."""
    engine = create_engine(Settings(data_dir=stack.data, database_url=None).catalogue_url)
    with engine.begin() as connection:
        of_key = SessionRow.key_id == key.split("_")[1]
        connection.execute(update(SessionRow).where(of_key).values(expires_at=time.time() - 1))
    engine.dispose()


def test_a_page_of_another_site_can_link_and_cannot_change(browser: Browser, base_url: str, key: str) -> None:
    context = browser.new_context(base_url=base_url)
    page = context.new_page()
    page.goto("/login")
    log_in(page, key)
    expect(page.get_by_role("button", name="Log out")).to_be_visible()
    forms = "".join(
        f'<form method="post" action="{base_url}{address}" id="{name}"><button>{name}</button></form>'
        for name, address in (("leave", "/logout"), ("make", "/keys"), ("sample", "/images/sample"))
    )

    def foreign(route: Route) -> None:
        link = f'<a href="{base_url}/jobs?phase=QUEUED">to the jobs</a>'
        route.fulfill(content_type="text/html", body=f"<!doctype html><title>x</title>{link}{forms}")

    context.route(ELSEWHERE, foreign)
    for name in ("leave", "make", "sample"):
        page.goto(ELSEWHERE)
        with page.expect_response(lambda answer: answer.request.method == "POST") as answered:
            page.get_by_role("button", name=name).click()
        assert answered.value.status == 403, name
    page.goto(ELSEWHERE)
    page.get_by_role("link", name="to the jobs").click()
    expect(page).to_have_url(re.compile(r"/jobs\?phase=QUEUED$"))
    expect(page.get_by_role("button", name="Log out")).to_be_visible()
    context.close()


def test_forms_work_over_http_where_browsers_do_not_name_the_site(
    browser: Browser, base_url: str, key: str
) -> None:
    """There is no Sec-Fetch-Site, and Origin is all that tells the service's own forms from those of others."""
    address = f"http://{PLAIN_NAME}:{urlsplit(base_url).port}"
    page = browser.new_page(base_url=address)
    sent: list[dict[str, str]] = []
    page.on(
        "request", lambda request: sent.append(request.all_headers()) if request.method == "POST" else None
    )
    page.goto("/login")
    log_in(page, key)
    page.get_by_role("button", name="Log out").click()
    expect(page.get_by_role("heading", level=1)).to_have_text("Log in")
    assert len(sent) == 2 and all("sec-fetch-site" not in headers for headers in sent)
    assert {headers["origin"] for headers in sent} == {address}
    page.close()


def test_the_first_page_of_a_new_person_shows_the_sample_before_and_after(page: Page, key: str) -> None:
    page.goto("/login")
    log_in(page, key)
    divider = page.get_by_role("slider", name="Divider between before and after")
    after = page.get_by_alt_text("The sample image after the deconvolution")
    expect(after).to_have_css("clip-path", "inset(0px 0px 0px 50%)")
    good(page)
    divider.press("Home")  # the keyboard
    expect(after).to_have_css("clip-path", "inset(0px 0px 0px 0%)")
    page.locator("#sample .halves").click(position={"x": 5, "y": 100})  # the pointer
    assert 0 < float(divider.input_value()) < 5
    page.get_by_role("button", name="Use this sample").click()
    expect(page.get_by_role("heading", level=1)).to_have_text("sample.fits")
    page.goto("/")
    expect(page.locator("#sample")).to_have_count(0)
