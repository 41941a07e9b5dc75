"""Logging in and out in a browser, by requests; and the page of keys."""

from __future__ import annotations

import re
import time
from http.cookies import SimpleCookie
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import create_engine, update

from service.app import create_app
from service.pages.login import LONGEST_ADDRESS, local_address
from tests.service.conftest import upload
from tests.service.keyed import Keyed, bearer, keyed
from workers.catalogue.access import KeyRefused, Scope, SessionRow
from workers.settings import Settings

OWN_PAGE = {"Sec-Fetch-Site": "same-origin"}
PERSON = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}
COOKIE = "heliopsf_session"


def browser(service: Keyed, key: str | None = None, address: str = "http://testserver") -> TestClient:
    """A browser that follows no redirect; logged in if a key is given."""
    client = TestClient(
        service.api.app, base_url=address, raise_server_exceptions=False, follow_redirects=False
    )
    client.headers.update(PERSON)
    if key is not None:
        assert client.post("/login", data={"key": key}, headers=OWN_PAGE).status_code == 303
    return client


def form_token(client: TestClient) -> str:
    """The token in the forms of a page."""
    found = re.search(r'name="form_token" value="([\w-]{43})"', client.get("/keys").text)
    assert found is not None
    return found[1]


# The cookie -----------------------------------------------------------------------------------------


def test_a_login_sets_a_cookie_that_scripts_and_other_sites_cannot_use(service: Keyed) -> None:
    key = service.key("ann")
    for address, name, secure in (
        ("http://testserver", COOKIE, False),
        ("https://testserver", f"__Host-{COOKIE}", True),
    ):
        answer = browser(service, address=address).post(
            "/login", data={"key": f" {key}\n", "next": "/jobs?phase=QUEUED"}
        )
        assert answer.status_code == 303 and answer.headers["location"] == "/jobs?phase=QUEUED"
        (header,) = answer.headers.get_list("set-cookie")
        cookie = SimpleCookie(header)[name]
        assert re.fullmatch(r"[\w-]{43}", cookie.value) and cookie.value not in key
        assert cookie["httponly"] is True and cookie["samesite"] == "strict" and cookie["path"] == "/"
        assert bool(cookie["secure"]) == secure and cookie["domain"] == ""
        assert int(cookie["max-age"]) == 30 * 86_400, "as long as the session"
    short = browser(service).post("/login", data={"key": service.key("ann", lasts_s=3600)})
    assert 3590 < int(SimpleCookie(short.headers["set-cookie"])[COOKIE]["max-age"]) <= 3600
    assert answer.headers["Cache-Control"] == "no-store"


def test_the_cookie_of_http_is_none_over_https(service: Keyed) -> None:
    """Another host of the domain could have set it."""
    token = browser(service, service.key("ann")).cookies[COOKIE]
    over = browser(service, address="https://testserver")
    over.cookies.set(COOKIE, token)
    assert over.get("/v1/jobs").status_code == 401
    over.cookies.set(f"__Host-{COOKIE}", token)
    assert over.get("/v1/jobs").status_code == 200


def test_a_session_allows_what_its_key_allows(service: Keyed) -> None:
    reader = browser(service, service.key("ann", Scope.READ))
    assert reader.get("/v1/jobs").status_code == reader.get("/jobs").status_code == 200
    refused = reader.post("/v1/jobs", json={}, headers=OWN_PAGE)
    assert refused.status_code == 403 and "'submit'" in refused.json()["detail"]
    page = reader.post("/images/sample", headers=OWN_PAGE)
    assert page.status_code == 403 and page.headers["content-type"].startswith("text/html")


def test_a_key_in_the_request_counts_more_than_the_cookie(service: Keyed) -> None:
    client = browser(service, service.key("ann"))
    assert client.get("/v1/keys", headers=bearer(service.key("bob"))).json()["items"][0]["owner"] == "bob"
    assert client.get("/v1/jobs", headers=bearer("nonsense")).status_code == 401
    assert client.get("/jobs", headers=bearer("nonsense")).status_code == 401
    assert client.post("/v1/jobs", json={}, headers=bearer(service.key("bob"))).status_code == 422


def test_answers_that_caches_may_keep_depend_on_the_cookie(service: Keyed, psf_file: Path) -> None:
    key = service.key("ann")
    psf_id = upload(service.client("ann"), psf_file, "/v1/psfs")
    client = browser(service, key)
    downloaded = client.get(f"/v1/psfs/{psf_id}/file")
    assert downloaded.status_code == 200 and "ETag" in downloaded.headers
    for answer in (downloaded, client.get("/"), client.get("/jobs")):
        assert "Cookie" in answer.headers["Vary"].split(", ")


# Other sites ----------------------------------------------------------------------------------------

CHANGES = (
    ("POST", "/v1/jobs"),
    ("DELETE", "/v1/jobs/" + 32 * "0"),
    ("POST", f"/uws/jobs/{32 * '0'}/phase"),
    ("POST", "/images/sample"),
    ("POST", "/logout"),
)


def test_a_change_that_names_no_site_needs_the_form_token(service: Keyed) -> None:
    client, other = browser(service, service.key("ann")), browser(service, service.key("ann"))
    token, of_another = form_token(client), form_token(other)
    for method, address in CHANGES:
        for headers in ({}, {"X-Form-Token": "x" * 43}, {"X-Form-Token": of_another}):
            answer = client.request(method, address, headers=headers)
            assert answer.status_code == 403 and "form token" in answer.text, answer.text
        accepted = client.request(method, address, headers={"X-Form-Token": token})
        assert accepted.status_code != 403, accepted.text


def test_the_form_token_may_be_a_field_of_a_page_s_form(service: Keyed) -> None:
    client = browser(service, service.key("ann"))
    data = {"scopes": "read", "form_token": form_token(client)}
    assert client.post("/keys", data=data).status_code == 201
    assert client.post("/keys", data=data | {"form_token": "x"}).status_code == 403
    assert client.post("/keys", data={"scopes": "read"}).status_code == 403
    as_uws = client.post("/uws/jobs", data={"KIND": "deconvolve"} | data)
    assert as_uws.status_code == 403, "UWS looks at headers alone"
    for headers in (OWN_PAGE, {"Origin": "http://testserver"}):
        assert client.post("/keys", data={"scopes": "read"}, headers=headers).status_code == 201


# No window of the browser's own ---------------------------------------------------------------------


def test_basic_is_offered_to_programs_alone(service: Keyed) -> None:
    for headers, offered in (
        ({}, True),
        ({"Accept": "text/html, image/gif, image/jpeg, */*; q=0.2"}, True),  # Java's, as of TOPCAT
        (OWN_PAGE, False),
        (PERSON, False),
        ({"Cookie": f"{COOKIE}=ended"}, False),
    ):
        answer = service.api.get("/uws/jobs", headers=headers)
        assert answer.status_code == 401 and answer.headers["WWW-Authenticate"].startswith("Bearer")
        assert ("Basic" in answer.headers["WWW-Authenticate"]) == offered, headers


# Beginning and end ----------------------------------------------------------------------------------


def test_a_page_without_a_session_leads_to_the_login_and_back(service: Keyed) -> None:
    client = browser(service)
    answer = client.get("/jobs?phase=ERROR&cursor=a%26b")
    assert answer.status_code == 303
    assert answer.headers["location"] == "/login?next=%2Fjobs%3Fphase%3DERROR%26cursor%3Da%2526b"
    form = client.get(answer.headers["location"])
    assert form.status_code == 200 and 'value="/jobs?phase=ERROR&amp;cursor=a%26b"' in form.text
    assert client.post("/images/sample", headers=OWN_PAGE).headers["location"] == "/login"


NO_KEY = "This is not a key. Copy the whole key; it begins with hpsf_."


@pytest.mark.usefixtures("one_minute")
def test_a_wrong_key_is_refused_with_the_reason_and_counted(settings: Settings) -> None:
    with keyed(settings, reads_per_minute=3) as service:
        expired = service.key("ann", lasts_s=-1)
        client = browser(service)
        for key, told in (("nonsense", NO_KEY), (expired, "has expired"), ("", NO_KEY)):
            answer = client.post("/login", data={"key": key, "next": "/jobs"}, headers=OWN_PAGE)
            assert answer.status_code == 401 and told in answer.text and 'value="/jobs"' in answer.text
            assert answer.headers["WWW-Authenticate"] == 'Bearer realm="heliopsf"'
            assert "set-cookie" not in answer.headers and expired not in answer.text
        assert client.post("/login", data={"key": "nonsense"}, headers=OWN_PAGE).status_code == 429
        assert browser(service, service.key("ann")).cookies, "a good key is still accepted"


def test_logging_out_and_a_new_login_end_the_session_before(service: Keyed) -> None:
    client, other = browser(service, service.key("ann")), browser(service, service.key("ann"))
    token = client.cookies[COOKIE]
    answer = client.post("/logout", headers=OWN_PAGE)
    assert answer.status_code == 303 and answer.headers["location"] == "/login"
    assert not client.cookies
    client.cookies.set(COOKIE, token)
    assert client.get("/v1/jobs").status_code == 401, "the cookie alone is worth nothing any more"
    token = other.cookies[COOKIE]
    other.post("/login", data={"key": service.key("bob")}, headers=OWN_PAGE)
    assert other.get("/v1/keys").json()["items"][0]["owner"] == "bob"
    with pytest.raises(KeyRefused, match="ended"):
        service.catalogue.sessions.find(token)


def test_an_ended_session_is_told_on_the_login_page(service: Keyed, settings: Settings) -> None:
    client = browser(service, service.key("ann"))
    assert "You are logged in as ann" in client.get("/login").text
    engine = create_engine(settings.catalogue_url)
    with engine.begin() as connection:
        connection.execute(update(SessionRow).values(expires_at=time.time() - 1))
    engine.dispose()
    answer = client.get("/jobs")
    assert answer.status_code == 303 and "Your login has ended" in client.get(answer.headers["location"]).text
    api = client.get("/v1/jobs")
    assert api.status_code == 401 and api.json()["type"] == "urn:heliopsf:session-ended"
    assert "Your login has ended" in browser(service).get("/login?ended=1").text
    assert "has ended" not in browser(service).get("/login").text


def test_a_revoked_key_ends_its_sessions_at_once(service: Keyed) -> None:
    key = service.key("ann")
    client = browser(service, key)
    assert client.get("/jobs").status_code == 200
    service.catalogue.keys.revoke(key.split("_")[1])
    answer = client.get("/jobs")
    assert answer.status_code == 303
    assert "was revoked" in client.get(answer.headers["location"]).text
    assert client.get("/v1/jobs").json()["type"] == "urn:heliopsf:key-revoked"


def test_a_login_leads_to_the_page_that_was_asked_for_and_nowhere_else(service: Keyed) -> None:
    for page in ("/", "/jobs", "/jobs?phase=ERROR&a=//b", "/psfs/a/vs/b", "/login-help"):
        assert local_address(page) == page
    for sent in (
        "//evil.example",
        "///evil.example",
        "/\\evil.example",
        "\\/evil.example",
        "https://evil.example",
        "http:evil.example",
        "javascript:alert(1)",
        "evil.example",
        "",
        " /jobs",
        "/\t/evil.example",
        "/\n/evil.example",
        "/jobs\r\nSet-Cookie: a=b",
        "/jobs\x00",
        "/\u2028/evil.example",
        "/login",
        "/login?next=/jobs",
        "/logout",
        "/" + "a" * LONGEST_ADDRESS,
    ):
        assert local_address(sent) == "/", sent
    data = {"key": service.key("ann"), "next": "//evil.example"}
    assert browser(service).post("/login", data=data, headers=OWN_PAGE).headers["location"] == "/"
    assert "evil" not in browser(service).get("/login", params={"next": "//evil.example"}).text


def test_a_link_on_another_site_finds_the_session(service: Keyed) -> None:
    """The browser sends no cookie with the first request; a page of this service asks again."""
    client, stranger = browser(service, service.key("ann")), browser(service)
    first = stranger.get("/jobs?phase=ERROR", headers={"Sec-Fetch-Site": "cross-site"})
    assert first.status_code == 200 and "set-cookie" not in first.headers
    (again,) = re.findall(r'content="0; url=([^"]+)"', first.text)
    address = again.replace("&amp;", "&")
    arrived = client.get(address, headers=OWN_PAGE)
    assert arrived.status_code == 303 and arrived.headers["location"] == "/jobs?phase=ERROR"
    assert stranger.get(address, headers=OWN_PAGE).status_code == 200, "the form, if there is no session"


def test_an_open_service_needs_no_login(settings: Settings) -> None:
    with TestClient(create_app(settings), follow_redirects=False) as api:
        assert "needs no login" in api.get("/login?next=/jobs").text
        answer = api.post("/login", data={"key": "x", "next": "/jobs"})
        assert answer.status_code == 303 and answer.headers["location"] == "/jobs"
        assert "set-cookie" not in answer.headers
        assert api.get("/jobs").status_code == 200
        assert api.post("/logout").headers["location"] == "/login"
        assert "needs no login" in api.get("/login").text
        assert "keys are not used" in api.get("/keys").text
        assert api.post("/keys", data={"scopes": "read"}).status_code == 409


# --- keys -----------------------------------------------------------------------------------------------


def test_a_key_is_made_shown_once_and_revoked(service: Keyed) -> None:
    own = service.key("ann")
    client = browser(service, own)
    data = {"scopes": ["read", "submit"], "label": "cluster <1>", "lasts_days": "30", "owner": "ann"}
    answer = client.post("/keys", data=data, headers=OWN_PAGE)
    assert answer.status_code == 201 and answer.headers["Cache-Control"] == "no-store"
    (key,) = re.findall(r">(hpsf_[^<]+)</textarea>", answer.text)
    assert "cluster &lt;1&gt;" in answer.text and "cluster <1>" not in answer.text
    assert service.api.get("/v1/jobs", headers=bearer(key)).status_code == 200
    listed = client.get("/keys").text
    identity = key.split("_")[1]
    assert identity in listed and key.split("_", 2)[2] not in listed and "your login" in listed
    revoked = client.post(f"/keys/{identity}/revoke", headers=OWN_PAGE)
    assert revoked.status_code == 303 and revoked.headers["location"] == "/keys"
    assert service.api.get("/v1/jobs", headers=bearer(key)).status_code == 401
    made = client.post("/keys", data={"scopes": "read"}, headers=OWN_PAGE)
    (other,) = re.findall(r">(hpsf_[^<]+)</textarea>", made.text)
    client.post(f"/keys/{own.split('_')[1]}/revoke", data={"and_made": "true"}, headers=OWN_PAGE)
    assert client.get("/keys").headers["location"].startswith("/login"), "the key of the login"
    assert service.api.get("/v1/jobs", headers=bearer(other)).status_code == 401


def test_what_cannot_be_made_is_told_on_a_page(service: Keyed) -> None:
    client = browser(service, service.key("ann"))
    for data, told in (
        ({}, "at least one scope"),
        ({"scopes": "read", "lasts_days": "soon"}, "Lifetime: "),
        ({"scopes": "read", "owner": "A B"}, "Owner: "),
        ({"scopes": "admin"}, "scopes of your own key"),
        ({"scopes": "read", "owner": "bob"}, "your own name"),
    ):
        answer = client.post("/keys", data=data, headers=OWN_PAGE)
        assert answer.status_code in (403, 422) and told in answer.text
        assert answer.headers["content-type"].startswith("text/html")
        assert len(service.catalogue.keys.all()) == 1


def test_an_administrator_sees_and_makes_keys_of_others(service: Keyed) -> None:
    service.key("ann")
    client = browser(service, service.key("root", *Scope))
    everybody = client.get("/keys?owner=*").text
    assert "<td>ann</td>" in everybody and "<td>root</td>" in everybody
    made = client.post("/keys", data={"scopes": "bulk", "owner": "ann"}, headers=OWN_PAGE)
    assert made.status_code == 201 and "Keys of ann" in made.text
    owned = {row.owner: row.scopes for row in service.catalogue.keys.page("ann", limit=1)}
    assert owned == {"ann": ["bulk"]}
    assert browser(service, service.key("bob")).get("/keys?owner=ann").status_code == 403
