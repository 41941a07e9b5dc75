"""What holds for every request and every answer, before and after any route: by whom it was sent, how long it is,
what a browser may do with it.
"""

from __future__ import annotations

from urllib.parse import urlsplit

from fastapi import FastAPI
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http import problems
from service.http.access import Access
from service.http.uploads import LARGE

SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}


def install(app: FastAPI, access: Access, max_body_bytes: int) -> None:
    """Guard every request of the application."""
    app.add_middleware(_Guard, access=access, max_body_bytes=max_body_bytes)


class _Guard:
    def __init__(self, app: ASGIApp, access: Access, max_body_bytes: int) -> None:
        self._app, self._access, self._max_body_bytes = app, access, max_body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def kept(message: Message) -> None:
            if message["type"] == "http.response.start":
                _keep(MutableHeaders(scope=message), scope)
            await send(message)

        headers = Headers(scope=scope)
        try:
            self._check_host(headers)
            _check_origin(scope["method"], headers)
            if scope["path"] not in LARGE:
                receive = _bounded(headers, receive, self._max_body_bytes)
        except problems.Problem as problem:
            refusal = problems.answer(problem.status, problem.code, problem.detail)
            await refusal(scope, receive, kept)
            return
        await self._app(scope, receive, kept)

    def _check_host(self, headers: Headers) -> None:
        """A name that is not the service's own is how a page elsewhere reaches an open service: it makes its own
        name stand for a loopback address, and the browser takes both for one site (DNS rebinding).
        """
        hosts = self._access.hosts
        if hosts is None:
            return
        sent = headers.get("host", "")
        if _host_name(sent) not in hosts:
            raise problems.Problem(
                421,
                "host-not-served",
                f"expected a name of this service in the address; got {sent[:80]!r} "
                "(HELIOPSF_ALLOWED_HOSTS adds names)",
            )


def _check_origin(method: str, headers: Headers) -> None:
    """A page of another site may send forms here without asking, and a browser adds what it knows of HTTP Basic."""
    if method in SAFE_METHODS:
        return
    site, origin = headers.get("sec-fetch-site"), headers.get("origin")
    if site is not None:
        foreign = site not in ("same-origin", "none")
    else:  # an older browser, or no browser at all
        foreign = origin is not None and urlsplit(origin).netloc.lower() != headers.get("host", "").lower()
    if foreign:
        raise problems.Problem(
            403,
            "cross-site",
            "expected a request by a program, or by a page of this service; got one by another site's",
        )


def _host_name(sent: str) -> str:
    """The host in a Host header, in small letters, without its port and the brackets of IPv6."""
    try:
        return urlsplit(f"//{sent}").hostname or ""
    except ValueError:
        return ""


def _bounded(headers: Headers, receive: Receive, most: int) -> Receive:
    """The body as far as a request that is no file may be long."""
    declared = headers.get("content-length", "")
    too_large = f"expected a request of at most {most} bytes; got more"
    if declared.isdecimal() and int(declared) > most:
        raise problems.Problem(413, "too-large", too_large)
    got = 0

    async def bounded() -> Message:
        nonlocal got
        message = await receive()
        got += len(message.get("body", b""))
        if got > most:
            raise HTTPException(413, too_large)  # the one exception that reading a body lets through
        return message

    return bounded


def _keep(headers: MutableHeaders, scope: Scope) -> None:
    """What browsers are told of every answer; a route's own word goes before."""
    for name, value in problems.SECURITY_HEADERS.items():
        headers.setdefault(name, value)
    if "etag" in headers:
        headers.add_vary_header("Authorization")
    else:
        headers.setdefault("Cache-Control", "no-store")
    allowance = scope.get("state", {}).get("allowance")
    if allowance is not None:
        for name, value in allowance.headers.items():
            headers.setdefault(name, value)
