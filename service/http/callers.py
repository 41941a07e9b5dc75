"""Identifies the caller of a request and checks its scopes. Each route names the scope that it needs.

A request sends its key in ``Authorization``: as a bearer token, or as the password of HTTP Basic (with any user
name), which browsers and clients of the Virtual Observatory support. An open service needs no key; everything
in it belongs to one owner.
"""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request, Security
from fastapi.openapi.models import HTTPBase, HTTPBearer
from fastapi.security import SecurityScopes
from fastapi.security.base import SecurityBase

from service.http import short_ids
from service.http.problems import Problem
from service.http.rates import Bucket
from service.http.state import Shared, State
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
    caller = _let_in(request, state)
    request.state.caller = caller
    for scope in map(Scope, needed.scopes):
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


Reading = Annotated[Caller, Security(_caller, scopes=[Scope.READ])]
Submitting = Annotated[Caller, Security(_caller, scopes=[Scope.SUBMIT])]
Certifying = Annotated[Caller, Security(_caller, scopes=[Scope.CERTIFY])]
Bulk = Annotated[Caller, Security(_caller, scopes=[Scope.BULK])]
Administering = Annotated[Caller, Security(_caller, scopes=[Scope.ADMIN])]
