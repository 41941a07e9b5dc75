"""Identifies the visitor of a page. If keys are required, a visitor without a session is sent to the login page, and
then back.

The routes of pages have a parameter ``PageReading``, ``PageSubmitting``, ``PageBulk``, ``PageCertifying`` or
``PageVisiting``. This parameter replaces the parameter from ``service.http.callers`` that routes of the API have.
There are two differences: without a session the visitor is redirected, and the form token may also be a field of the
form. The field is read only if no header says from which site the request comes. The field is never read from a
multipart form, because such a form may contain a large file, which only the route may read.
"""

from __future__ import annotations

from typing import Annotated
from urllib.parse import urlencode

from fastapi import FastAPI, Request, Response, Security
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse
from fastapi.security import SecurityScopes

from service.http.callers import Caller, admit, cookie_name, names_its_site
from service.http.forms import media_type_of
from service.http.guard import SAFE_METHODS
from service.http.problems import Problem
from service.http.state import Shared
from service.pages.rendering import page
from workers.catalogue.access import Scope

FORM = "application/x-www-form-urlencoded"


class LoginNeeded(Exception):
    """A page needs a session, and the request has no valid session."""


def install(app: FastAPI) -> None:
    """Answer ``LoginNeeded`` with a redirect to the login page."""

    @app.exception_handler(LoginNeeded)
    def _login_needed(request: Request, _needed: LoginNeeded) -> Response:
        if request.method not in SAFE_METHODS:
            return RedirectResponse("/login", 303)
        login = f"/login?{urlencode({'next': _own_address(request)})}"
        if _came_by_link(request):
            return page(request, "arriving.html", address=f"{login}&arrived=true")
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
    if cookie_name(request) not in request.cookies:
        return None
    if media_type_of(request) != FORM:
        return None
    sent = (await request.form()).get("form_token")
    return sent if isinstance(sent, str) else None


def _came_by_link(request: Request) -> bool:
    """Whether a person followed a link on another site. The browser then withholds the cookie, because it is ``SameSite=Strict``.

    Therefore the answer is a page that opens the login page. That second request comes from a page of this service, so
    it has the cookie.
    """
    return request.headers.get("sec-fetch-site") == "cross-site"


def _own_address(request: Request) -> str:
    return f"{request.url.path}?{request.url.query}" if request.url.query else request.url.path
