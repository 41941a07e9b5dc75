"""Logging in and out with a key, the visitors of pages, and the page of keys.

If keys are required, a visitor without a session is sent to the login page, and then back. The routes of pages have a
parameter ``PageReading``, ``PageSubmitting``, ``PageBulk``, ``PageCertifying`` or ``PageVisiting``. This parameter
replaces the parameter from ``service.http.callers`` that routes of the API have. There are two differences: without a
session the visitor is redirected, and the form token may also be a field of the form. The field is read only if no
header says from which site the request comes. The field is never read from a multipart form, because such a form may
contain a large file, which only the route may read.

On the page of keys, users list, make and revoke keys. It shows a new key only once.
"""

from __future__ import annotations

import time
from math import ceil
from typing import Annotated
from urllib.parse import urlencode

from fastapi import APIRouter, FastAPI, Form, Query, Request, Response, Security
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse
from fastapi.security import SecurityScopes

from service.api.keys import KeyId, MadeKey, NewKey, list_keys, make_key, revoke_key
from service.http.callers import BEARER, Caller, address_of, admit, names_its_site, session_token
from service.http.forms import URL_ENCODED, media_type_of
from service.http.guard import SAFE_METHODS, cookie_name
from service.http.paging import Cursor, Listing
from service.http.problems import Problem
from service.http.rates import Bucket
from service.http.state import Shared, State
from service.pages.forms import checked
from service.pages.rendering import page
from service.pages.sentences import of_error
from workers.catalogue.access import LABEL_LENGTH, MEANINGS, KeyRefused, Scope

DAY_S = 86_400
LONGEST_ADDRESS = 2000  # characters
ENDED = "Your login has ended. Log in again."
KEYS_PER_PAGE = 50
LIFETIMES_DAYS = (7, 30, 90, 365)

router = APIRouter(include_in_schema=False)
keys = APIRouter(prefix="/keys", include_in_schema=False)


class LoginNeeded(Exception):
    """A page needs a session, and the request has no valid session."""


def install(app: FastAPI) -> None:
    """Answer ``LoginNeeded`` with a redirect to the login page."""

    @app.exception_handler(LoginNeeded)
    def _login_needed(request: Request, _needed: LoginNeeded) -> Response:
        if request.method not in SAFE_METHODS:
            return RedirectResponse("/login", 303)
        here = f"{request.url.path}?{request.url.query}" if request.url.query else request.url.path
        login = f"/login?{urlencode({'next': here})}"
        # A person followed a link on another site. The browser then withholds the cookie, because it is
        # SameSite=Strict. Therefore the answer is a page that opens the login page: a second request, which has the
        # cookie.
        if request.headers.get("sec-fetch-site") == "cross-site":
            return page(request, "login.html", arriving=f"{login}&arrived=true")
        return RedirectResponse(login, 303)


async def _visitor(request: Request, needed: SecurityScopes, state: Shared) -> Caller:
    form_token = await _form_token(request)
    try:
        return await run_in_threadpool(admit, request, state, needed.scopes, form_token)
    except Problem as problem:
        if problem.status != 401 or "authorization" in request.headers:
            raise
        raise LoginNeeded from problem


PageVisiting = Annotated[Caller, Security(_visitor, scopes=[])]
PageReading = Annotated[Caller, Security(_visitor, scopes=[Scope.READ])]
PageSubmitting = Annotated[Caller, Security(_visitor, scopes=[Scope.SUBMIT])]
PageCertifying = Annotated[Caller, Security(_visitor, scopes=[Scope.CERTIFY])]
PageBulk = Annotated[Caller, Security(_visitor, scopes=[Scope.BULK])]


async def _form_token(request: Request) -> str | None:
    """The form token in the fields of a form; None if the form has no token or none is needed."""
    if request.method in SAFE_METHODS or names_its_site(request):
        return None
    if session_token(request) is None:
        return None
    if media_type_of(request) != URL_ENCODED:
        return None
    sent = (await request.form()).get("form_token")
    return sent if isinstance(sent, str) else None


# --- login and logout -------------------------------------------------------------------------------------


@router.get("/login")
def login_page(
    request: Request,
    state: Shared,
    next_address: Annotated[str, Query(alias="next")] = "",
    ended: bool = False,
    arrived: bool = False,
) -> Response:
    """The form for the key.

    Parameters
    ----------
    ended
        Whether a script found that the session has ended.
    arrived
        Whether the person followed a link on another site. If the session is open, the requested page is then opened at
        once.
    """
    valid, note = _session(request, state)
    if valid and arrived:
        return RedirectResponse(local_address(next_address), 303)
    return _form(request, state, next_address, note=note or (ENDED if ended else ""))


@router.post("/login")
def log_in(
    request: Request,
    state: Shared,
    key: Annotated[str, Form()] = "",
    next_address: Annotated[str, Form(alias="next")] = "",
) -> Response:
    """Begin a session, and go to the requested page. Every refused key counts against the rate limit of the client's
    address.
    """
    if not state.access.keys:
        return RedirectResponse(local_address(next_address), 303)
    try:
        row = state.catalogue.keys.check(key.strip())
    except KeyRefused as refused:
        state.rates.take(Bucket.READS, address_of(request))
        return _form(request, state, next_address, error=of_error(refused.code, refused.message))
    state.rates.take(Bucket.SUBMISSIONS, row.owner)
    _close(request, state)
    state.catalogue.sessions.sweep()
    lasts_s = state.settings.session_days * DAY_S
    if row.expires_at is not None:
        lasts_s = min(lasts_s, row.expires_at - time.time())
    answer = RedirectResponse(local_address(next_address), 303)
    _set_cookie(request, answer, state.catalogue.sessions.open(row, lasts_s), ceil(lasts_s))
    return answer


@router.post("/logout")
def log_out(request: Request, _caller: PageVisiting, state: Shared) -> Response:
    """End the session."""
    _close(request, state)
    answer = RedirectResponse("/login", 303)
    _set_cookie(request, answer, "", 0)
    return answer


def local_address(sent: str) -> str:
    """The address of a page of this service; "/" if the text could lead a browser to another site, or to the login
    page.
    """
    elsewhere = not sent.startswith("/") or sent.startswith("//") or "\\" in sent
    if elsewhere or not sent.isprintable() or len(sent) > LONGEST_ADDRESS:
        return "/"
    return "/" if sent.partition("?")[0] in ("/login", "/logout") else sent


def _form(request: Request, state: State, next_address: str, *, note: str = "", error: str = "") -> Response:
    return page(
        request,
        "login.html",
        status=401 if error else 200,
        headers={"WWW-Authenticate": BEARER} if error else None,
        arriving="",
        next=local_address(next_address),
        note=note,
        error=error,
        needed=state.access.keys,
    )


def _session(request: Request, state: State) -> tuple[bool, str]:
    """Whether the browser has an open session, and the note about it for the login page (empty without a cookie)."""
    token = session_token(request)
    if token is None or not state.access.keys:
        return False, ""
    try:
        _, key = state.catalogue.sessions.find(token)
    except KeyRefused as refused:
        state.rates.take(Bucket.READS, address_of(request))
        return (
            False,
            ENDED if refused.code == "session-ended" else f"Your login has ended: {refused.message}.",
        )
    return True, f"You are logged in as {key.owner}. You can log in with another key."


def _close(request: Request, state: State) -> None:
    token = session_token(request)
    if token is not None:
        state.catalogue.sessions.close(token)


def _set_cookie(request: Request, answer: Response, token: str, lasts_s: int) -> None:
    answer.set_cookie(
        cookie_name(request.url.scheme),
        token,
        max_age=lasts_s,
        path="/",
        secure=request.url.scheme == "https",
        httponly=True,
        samesite="strict",
    )


# --- keys -----------------------------------------------------------------------------------------------


@keys.get("")
def key_list(
    request: Request,
    caller: PageReading,
    state: Shared,
    owner: Annotated[str, Query(max_length=64)] = "",
    cursor: Cursor = None,
) -> Response:
    """The keys of the caller. An administrator may name another owner."""
    if not state.access.keys:
        return page(request, "keys.html", used=False)
    return _keys_page(request, caller, state, owner, cursor)


@keys.post("")
def make(
    request: Request,
    response: Response,
    caller: PageSubmitting,
    state: Shared,
    scopes: Annotated[list[str] | None, Form()] = None,
    label: Annotated[str, Form()] = "",
    lasts_days: Annotated[str, Form()] = "",
    owner: Annotated[str, Form()] = "",
) -> Response:
    """Make a key, and show it."""
    if not scopes:
        raise Problem(
            422,
            "invalid-request",
            "expected at least one scope of the list: go back and choose what the key allows",
        )
    asked = {"scopes": scopes, "label": label[:LABEL_LENGTH]}
    body = checked(NewKey, asked | {"lasts_days": lasts_days or None, "owner": owner or None})
    made = make_key(body, response, caller, state)
    return _keys_page(request, caller, state, made.owner, made=made)


@keys.post("/{key_id}/revoke")
def revoke(
    key_id: KeyId,
    caller: PageSubmitting,
    state: Shared,
    and_made: Annotated[bool, Form()] = False,
) -> Response:
    """Revoke a key, and show the list."""
    row = revoke_key(key_id, caller, state, and_made)
    return RedirectResponse("/keys" if row.owner == caller.owner else f"/keys?owner={row.owner}", 303)


def _keys_page(
    request: Request,
    caller: Caller,
    state: State,
    owner: str,
    cursor: str | None = None,
    made: MadeKey | None = None,
) -> Response:
    found = list_keys(Listing(request, KEYS_PER_PAGE, cursor), caller, state, owner or None)
    admin = Scope.ADMIN in caller.scopes
    return page(
        request,
        "keys.html",
        status=200 if made is None else 201,
        used=True,
        keys=found.items,
        next=found.next,
        made=made,
        owner=owner or caller.owner,
        admin=admin,
        may_make=Scope.SUBMIT in caller.scopes,
        own_id=caller.name,
        scopes=[(scope, MEANINGS[scope]) for scope in Scope if admin or scope in caller.scopes],
        chosen=(Scope.READ, Scope.SUBMIT),
        lifetimes=LIFETIMES_DAYS,
        label_length=LABEL_LENGTH,
    )
