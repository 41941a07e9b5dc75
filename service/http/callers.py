"""Identifies the caller of a request and checks its scopes. Each route names the scope that it needs.

A program sends its key in ``Authorization``: as a bearer token, or as the password of HTTP Basic (with any user
name), which clients of the Virtual Observatory support. A browser sends the cookie of its session. The session began
with a key (``/login``), and allows what this key allows. If a request has both a key and a cookie, the key counts. An
open service needs no key; everything in it belongs to one owner.

A browser adds the cookie by itself, so a page of another site could try to use the cookie. Three rules prevent this:

- The cookie has ``SameSite=Strict``: browsers do not send it with requests that another site causes.
- ``service.http.guard`` refuses every change whose ``Sec-Fetch-Site`` or ``Origin`` names another site.
- If a change by cookie has neither of the two headers, the request must contain the form token of the session, which
  only pages of this service know: in the header ``X-Form-Token``. Pages also accept the field ``form_token`` of a form
  (``service.pages.login``). All other routes, UWS included, look at headers alone and read no body for this check.
"""

from __future__ import annotations

import base64
import hmac
import re
from collections.abc import Callable, Coroutine, Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Any, get_type_hints

from fastapi import Depends, Request, Response, Security
from fastapi.concurrency import run_in_threadpool
from fastapi.params import Security as SecurityParameter
from fastapi.routing import APIRoute
from fastapi.security import HTTPBearer, SecurityScopes
from fastapi.security.http import HTTPBase

from service.http.guard import BULK, SAFE_METHODS, JsonRequest, cookie_name
from service.http.problems import Problem, problem
from service.http.rates import Bucket, Turns
from service.http.state import Shared, State, state_of
from workers.catalogue.access import OWNER, OWNER_RULE, KeyRefused, Scope, SessionRow
from workers.catalogue.catalogue import ListedRow
from workers.catalogue.database import several_ids_fit
from workers.catalogue.tables import (
    DEFAULT_OWNER,
    BulkRow,
    ImageRow,
    JobRow,
    KeyRow,
    ProductRow,
    PsfRow,
    ReportRow,
    TransitRow,
)
from workers.contract.requests import SHORT_ID
from workers.lookup import no_such

ACT_FOR = "X-Owner"  # names the owner that an administrator acts for
FORM_TOKEN = "X-Form-Token"  # noqa: S105  # the name of a header
# The parts of addresses that are ids: the table, the name of the thing, and the digits of a whole id.
IDS: dict[str, tuple[type[ListedRow], str, int]] = {
    "image_id": (ImageRow, "image", 64),
    "transit_id": (TransitRow, "transit", 64),
    "psf_id": (PsfRow, "psf", 64),
    "other_id": (PsfRow, "psf", 64),
    "product_id": (ProductRow, "product", 64),
    "report_id": (ReportRow, "report", 64),
    "job_id": (JobRow, "job", 32),
    "bulk_id": (BulkRow, "bulk", 32),
}
_SHORT = re.compile(SHORT_ID)
BEARER, BASIC = 'Bearer realm="heliopsf"', 'Basic realm="heliopsf", charset="UTF-8"'


@dataclass(frozen=True)
class Caller:
    """The sender of a request. ``owner`` owns everything that the request reads and makes; ``scopes`` are the scopes of
    the key.
    """

    owner: str
    scopes: frozenset[Scope]
    name: str  # for logs: the id of the key, or the address
    account: str  # what limits count by: the owner of the key, or the address in a service without keys
    session: str | None = None  # the id of the browser's session, if a cookie let the request in


# The two ways to send a key, for the OpenAPI description; ``_caller`` checks the key of every request.
_AS_BEARER = HTTPBearer(scheme_name="bearer", description="a key, hpsf_ID_SECRET", auto_error=False)
_AS_PASSWORD = HTTPBase(
    scheme="basic", scheme_name="basic", description="any user name, a key as the password", auto_error=False
)


def _caller(
    request: Request,
    needed: SecurityScopes,
    state: Shared,
    _bearer: Annotated[object, Depends(_AS_BEARER)],
    _basic: Annotated[object, Depends(_AS_PASSWORD)],
) -> Caller:
    """The caller of a request. Raises ``Problem`` if the key lacks a scope that the route needs, or if the caller
    reached a limit.
    """
    let_in: Caller | None = getattr(request.state, "let_in", None)  # set by KeyFirst
    return let_in or admit(request, state, needed.scopes)


def admit(request: Request, state: State, scopes: Iterable[str], form_token: str | None = None) -> Caller:
    """Return the caller of a request, and count the request against the caller's limits. This function waits for the
    database, so call it in a thread.

    Parameters
    ----------
    scopes
        The scopes that the key of the caller must have.
    form_token
        The form token that the request contains; default: the token in the header.

    Raises
    ------
    Problem
        Status 401 without a valid key or session, 403 if a scope or the form token is missing, and 429 if the caller
        has reached a limit.
    """
    caller = _let_in(request, state, form_token or request.headers.get(FORM_TOKEN, ""))
    request.state.caller = caller
    state.requests.open(caller.account)
    request.state.at_end = lambda: state.requests.close(caller.account)  # called by service.http.guard
    for scope in map(Scope, scopes):
        if scope not in caller.scopes:
            raise Problem(
                403,
                "scope-missing",
                f"expected a key with the scope '{scope}'; this key has {', '.join(sorted(caller.scopes))}: use "
                "another key, or ask the operator",
            )
        reading = scope in (Scope.READ, Scope.ADMIN)
        bucket = Bucket.READS if reading else Bucket.SUBMISSIONS
        request.state.allowance = state.rates.take(bucket, caller.account)
    # Parameters of the path are read after this dependency, so every route gets whole ids.
    _complete_ids(request, state, caller.owner)
    request.state.admitted()  # set by service.http.guard
    return caller


def _complete_ids(request: Request, state: State, owner: str) -> None:
    """Replace each shortened id in the path of the request by the whole id: its first digits stand for an id.

    Raises ``Problem`` 404 if the owner has nothing whose id begins with these digits, and 409 with the candidates if
    the owner has several.
    """
    path = request.scope["path_params"]
    for part, text in path.items():
        if part not in IDS or not _SHORT.fullmatch(text):
            continue
        table, thing, digits = IDS[part]
        if len(text) >= digits:
            continue
        fitting = state.catalogue.ids_from(table, text, owner)
        if not fitting:
            raise problem(no_such(thing, text, shortened=True))
        if len(fitting) > 1:
            raise problem(several_ids_fit(text, fitting), candidates=fitting)
        path[part] = fitting[0]


def address_of(request: Request) -> str:
    """The address of a client. The limits on requests without a valid key are counted for each address."""
    return request.client.host if request.client is not None else "unknown"


def session_token(request: Request) -> str | None:
    """The token in the cookie of the session; None without this cookie. ``service.http.guard`` let no other cookie
    through.
    """
    return request.cookies.get(cookie_name(request.url.scheme))


def still_let_in(state: State, caller: Caller) -> bool:
    """Whether a caller's key, and the session if there is one, are valid now. Event streams check this repeatedly."""
    if not state.access.keys:
        return True
    if caller.session is not None:
        return state.catalogue.sessions.is_open(caller.session)
    return state.catalogue.keys.is_good(caller.name)


def _let_in(request: Request, state: State, form_token: str) -> Caller:
    if not state.access.keys:
        address = address_of(request)
        return Caller(DEFAULT_OWNER, frozenset(Scope), address, address)
    try:
        session, row = _session_and_key(request, state)
    except KeyRefused as refused:
        state.rates.take(Bucket.READS, address_of(request))  # this limits attempts to guess keys
        raise Problem(401, refused.code, refused.message, headers=_challenge(request)) from refused
    caller = Caller(row.owner, frozenset(map(Scope, row.scopes)), row.id, row.owner)
    if session is not None:
        _check_form_token(request, session, form_token)
        request.state.form_token = session.form_token  # the forms of pages contain it
        caller = replace(caller, session=session.id)
    owner = request.headers.get(ACT_FOR)
    if owner is None or owner == caller.owner:
        return caller
    if Scope.ADMIN not in caller.scopes:
        raise Problem(403, "scope-missing", f"{ACT_FOR}: expected a key with the scope '{Scope.ADMIN}'")
    if not OWNER.fullmatch(owner):
        raise Problem(
            400, "bad-owner", f"{ACT_FOR}: expected the name of an owner ({OWNER_RULE}); got {owner[:80]!r}"
        )
    return replace(caller, owner=owner)


def _session_and_key(request: Request, state: State) -> tuple[SessionRow | None, KeyRow]:
    """The session of a request, and the key of the request or session. Raises ``KeyRefused``.

    The session is None if the request has an Authorization header or no session cookie.
    """
    token = session_token(request)
    if token is None or "authorization" in request.headers:
        return None, state.catalogue.keys.check(_sent_key(request))
    return state.catalogue.sessions.find(token)


def names_its_site(request: Request) -> bool:
    """Whether a request says from which site it comes. If so, ``service.http.guard`` has already checked the site."""
    return "sec-fetch-site" in request.headers or "origin" in request.headers


def _check_form_token(request: Request, session: SessionRow, sent: str) -> None:
    if request.method in SAFE_METHODS or names_its_site(request):
        return
    if not hmac.compare_digest(sent.encode(), session.form_token.encode()):
        raise Problem(
            403,
            "form-token-missing",
            f"expected the form token of your session in the field form_token or the header {FORM_TOKEN}, because "
            "the request does not say from which site it comes; got none or another one: load the page again, and "
            "send the form from there",
        )


def _challenge(request: Request) -> dict[str, str]:
    """The header that lists the ways to send a key. For a page it does not list Basic: the browser would open its own
    window and ask for a password.

    Browsers accept XHTML when a person opens an address. Clients of the Virtual Observatory that are written in Java
    accept ``text/html`` but not XHTML; for them the header must list Basic.
    """
    page = (
        request.headers.get("sec-fetch-site") == "same-origin"
        or session_token(request) is not None
        or "application/xhtml+xml" in request.headers.get("accept", "")
    )
    return {"WWW-Authenticate": BEARER if page else f"{BEARER}, {BASIC}"}


def _sent_key(request: Request) -> str:
    """The key in a request. Raises ``KeyRefused`` if there is none."""
    way, _, sent = request.headers.get("Authorization", "").partition(" ")
    sent = sent.strip()
    if way.lower() == "bearer" and sent:
        return sent
    if way.lower() == "basic" and sent:
        try:
            return base64.b64decode(sent, validate=True).decode().partition(":")[2]
        except ValueError as error:  # no base64, or no UTF-8
            raise KeyRefused("bad-key", "expected HTTP Basic as base64 of user:key") from error
    raise KeyRefused(
        "no-key",
        "expected a key: 'Authorization: Bearer hpsf_...', or as the password of Basic; in a browser, log in at /login",
    )


class KeyFirst(APIRoute):
    """A route with a JSON body. It checks the caller before it reads the body; FastAPI alone would read the body first.

    The bulk runs that one owner submits are read one after the other, because their bodies may be large.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler of the route. Raises TypeError if the endpoint has no parameter for its caller."""
        handle = super().get_route_handler()
        scopes = _scopes_of(self.endpoint)
        turns = Turns()

        async def answer(request: Request) -> Response:
            caller = await run_in_threadpool(admit, request, state_of(request), scopes)
            request.state.let_in = caller
            reading = JsonRequest(request.scope, request.receive)
            if self.path not in BULK or self.methods != {"POST"}:
                return await handle(reading)
            async with turns.of(caller.owner):
                return await handle(reading)

        return answer


def _scopes_of(endpoint: Callable[..., object]) -> list[str]:
    """The scopes that an endpoint requires, read from the annotation of its parameter for the caller."""
    for annotation in get_type_hints(endpoint, include_extras=True).values():
        for mark in getattr(annotation, "__metadata__", ()):
            if isinstance(mark, SecurityParameter) and mark.dependency is _caller:
                return list(mark.scopes or ())
    raise TypeError(
        f"expected a parameter of {endpoint.__name__} for its caller, such as `caller: Submitting`; got none"
    )


Reading = Annotated[Caller, Security(_caller, scopes=[Scope.READ])]
Submitting = Annotated[Caller, Security(_caller, scopes=[Scope.SUBMIT])]
Certifying = Annotated[Caller, Security(_caller, scopes=[Scope.CERTIFY])]
Bulk = Annotated[Caller, Security(_caller, scopes=[Scope.BULK])]
Administering = Annotated[Caller, Security(_caller, scopes=[Scope.ADMIN])]
