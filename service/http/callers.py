"""Identifies the caller of a request and checks its scopes. Each route names the scope that it needs.

A request sends its key in ``Authorization``: as a bearer token, or as the password of HTTP Basic (with any user
name), which browsers and clients of the Virtual Observatory support. An open service needs no key; everything
in it belongs to one owner.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
from collections.abc import Callable, Coroutine, Iterable
from dataclasses import dataclass
from typing import Annotated, Any, get_type_hints
from weakref import WeakValueDictionary

from fastapi import Depends, Request, Response, Security
from fastapi.concurrency import run_in_threadpool
from fastapi.openapi.models import HTTPBase, HTTPBearer
from fastapi.params import Security as SecurityParameter
from fastapi.routing import APIRoute
from fastapi.security import SecurityScopes
from fastapi.security.base import SecurityBase

from service.http import short_ids
from service.http.bodies import BULK, JsonRequest
from service.http.problems import Problem
from service.http.rates import Bucket
from service.http.state import Shared, State, state_of
from workers.catalogue.keys import OWNER, KeyRefused, Scope
from workers.catalogue.tables import DEFAULT_OWNER

ACT_FOR = "X-Owner"  # names the owner that an administrator acts for
CHALLENGE = {"WWW-Authenticate": 'Bearer realm="heliopsf", Basic realm="heliopsf", charset="UTF-8"'}


@dataclass(frozen=True)
class Caller:
    """The sender of a request. ``owner`` owns everything that the request reads and makes; ``scopes`` are the scopes of the key."""

    owner: str
    scopes: frozenset[Scope]
    name: str  # for rate limits and logs: the id of the key, or the address


class _Scheme(SecurityBase):
    """A way to send a key, for the OpenAPI description."""

    def __init__(self, name: str, model: HTTPBase) -> None:
        self.scheme_name, self.model = name, model

    async def __call__(self) -> None:
        """Do nothing: ``_caller`` checks the key of every request."""


_AS_BEARER = _Scheme("bearer", HTTPBearer(description="a key, hpsf_ID_SECRET"))
_AS_PASSWORD = _Scheme("basic", HTTPBase(scheme="basic", description="any user name, a key as the password"))


def _caller(
    request: Request,
    needed: SecurityScopes,
    state: Shared,
    _bearer: Annotated[None, Depends(_AS_BEARER)],
    _basic: Annotated[None, Depends(_AS_PASSWORD)],
) -> Caller:
    """The caller of a request. Raises ``Problem`` if its key does not have a scope that the route needs, or if it reached its rate limit."""
    let_in: Caller | None = getattr(request.state, "let_in", None)  # set by KeyFirst
    return let_in or _admit(request, state, needed.scopes)


def _admit(request: Request, state: State, scopes: Iterable[str]) -> Caller:
    caller = _let_in(request, state)
    request.state.caller = caller
    state.requests.open(caller.name)
    request.state.at_end = lambda: state.requests.close(caller.name)  # called by service.http.guard
    for scope in map(Scope, scopes):
        if scope not in caller.scopes:
            raise Problem(
                403,
                "scope-missing",
                f"expected a key with the scope '{scope}'; this key has {', '.join(sorted(caller.scopes))}",
            )
        reading = scope in (Scope.READ, Scope.ADMIN)
        bucket = Bucket.READS if reading else Bucket.SUBMISSIONS
        request.state.allowance = state.rates.take(bucket, caller.name)
    # Parameters of the path are read after this dependency, so every route gets whole ids.
    short_ids.complete(request, state, caller.owner)
    return caller


def _let_in(request: Request, state: State) -> Caller:
    address = request.client.host if request.client is not None else "unknown"
    if not state.access.keys:
        return Caller(DEFAULT_OWNER, frozenset(Scope), address)
    try:
        row = state.catalogue.keys.check(_sent_key(request))
    except KeyRefused as refused:
        state.rates.take(Bucket.READS, address)  # this limits attempts to guess keys
        raise Problem(401, refused.code, refused.message, headers=CHALLENGE) from refused
    caller = Caller(row.owner, frozenset(map(Scope, row.scopes)), row.id)
    owner = request.headers.get(ACT_FOR)
    if owner is None or owner == caller.owner:
        return caller
    if Scope.ADMIN not in caller.scopes or not OWNER.fullmatch(owner):
        raise Problem(403, "scope-missing", f"{ACT_FOR}: expected a key with the scope '{Scope.ADMIN}'")
    return Caller(owner, caller.scopes, caller.name)


def _sent_key(request: Request) -> str:
    """The key in a request. Raises ``KeyRefused`` if there is none."""
    way, _, sent = request.headers.get("Authorization", "").partition(" ")
    sent = sent.strip()
    if way.lower() == "bearer" and sent:
        return sent
    if way.lower() == "basic" and sent:
        try:
            return base64.b64decode(sent, validate=True).decode().partition(":")[2]
        except (binascii.Error, UnicodeDecodeError) as error:
            raise KeyRefused("bad-key", "expected HTTP Basic as base64 of user:key") from error
    raise KeyRefused(
        "no-key", "expected a key: 'Authorization: Bearer hpsf_...', or as the password of Basic"
    )


class KeyFirst(APIRoute):
    """A route with a JSON body. It checks the caller before it reads the body; FastAPI alone does it afterwards.

    An owner sends one bulk run at a time, because its body may be large.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler of the route. Raises TypeError if the endpoint has no parameter for its caller."""
        handle = super().get_route_handler()
        scopes = _scopes_of(self.endpoint)
        turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

        async def answer(request: Request) -> Response:
            caller = await run_in_threadpool(_admit, request, state_of(request), scopes)
            request.state.let_in = caller
            reading = JsonRequest(request.scope, request.receive)
            if self.path != BULK or self.methods != {"POST"}:
                return await handle(reading)
            async with turns.setdefault(caller.owner, asyncio.Lock()):
                return await handle(reading)

        return answer


def _scopes_of(endpoint: Callable[..., Any]) -> list[str]:
    """The scopes that the caller of an endpoint needs, from the annotation of the parameter."""
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
