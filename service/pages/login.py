"""Logging in with a key, and logging out."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import RedirectResponse

from service.http.callers import BEARER, address_of, cookie_name
from service.http.rates import Bucket
from service.http.state import Shared, State
from service.pages.parts.sentences import of_error
from service.pages.rendering import page
from service.pages.visitors import PageVisiting
from workers.catalogue.access import KeyRefused

DAY_S = 86_400
# The longest time that browsers keep a cookie. The service decides when the session ends, and can say so to a browser that
# still has the cookie.
COOKIE_S = 400 * DAY_S
LONGEST_ADDRESS = 2000  # characters
ENDED = "Your login has ended. Log in again."

router = APIRouter(include_in_schema=False)


@router.get("/login")
def login_page(
    request: Request,
    state: Shared,
    next_address: Annotated[str, Query(alias="next")] = "",
    ended: bool = False,
    arrived: bool = False,
) -> Response:
    """The form for the key. ended: a script found that the session has ended.

    arrived: the person followed a link on another site. If the session is open, the requested page is opened at once.
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
    address."""
    if not state.access.keys:
        return RedirectResponse(local_address(next_address), 303)
    try:
        row = state.catalogue.keys.check(key.strip())
    except KeyRefused as refused:
        state.rates.take(Bucket.READS, address_of(request))
        return _form(request, state, next_address, error=of_error(refused.code, refused.message))
    state.rates.take(Bucket.SUBMISSIONS, row.id)
    _close(request, state)
    state.catalogue.sessions.sweep()
    token = state.catalogue.sessions.open(row, state.settings.session_days * DAY_S)
    answer = RedirectResponse(local_address(next_address), 303)
    _set_cookie(request, answer, token, COOKIE_S)
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
    page."""
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
        next=local_address(next_address),
        note=note,
        error=error,
        needed=state.access.keys,
    )


def _session(request: Request, state: State) -> tuple[bool, str]:
    """Whether the browser has an open session, and the note about it for the login page (empty without a cookie)."""
    token = request.cookies.get(cookie_name(request))
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
    token = request.cookies.get(cookie_name(request))
    if token is not None:
        state.catalogue.sessions.close(token)


def _set_cookie(request: Request, answer: Response, token: str, lasts_s: int) -> None:
    answer.set_cookie(
        cookie_name(request),
        token,
        max_age=lasts_s,
        path="/",
        secure=request.url.scheme == "https",
        httponly=True,
        samesite="strict",
    )
