"""Checks every request before its route (host, origin, length), and sets the security headers of every answer."""

from __future__ import annotations

from urllib.parse import urlsplit

from fastapi import FastAPI, Request, Response
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http import problems
from service.http.access import Access
from service.http.bodies import BodyLimits

SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
# Style sheets, scripts and pictures of pages. These files contain no data of owners, and the page of a
# refusal needs them.
FOR_EVERYBODY = "/static/"


def install(app: FastAPI, access: Access, bodies: BodyLimits, as_page: problems.AsPage) -> None:
    """Guard every request of the application. as_page: makes the page of a refusal, for browsers."""
    app.add_middleware(_Guard, access=access, bodies=bodies, as_page=as_page)


class _Guard:
    def __init__(self, app: ASGIApp, access: Access, bodies: BodyLimits, as_page: problems.AsPage) -> None:
        self._app, self._access, self._bodies, self._as_page = app, access, bodies, as_page

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
            if scope["method"] not in SAFE_METHODS or not scope["path"].startswith(FOR_EVERYBODY):
                self._check_host(headers)
            _check_origin(scope["method"], headers)
        except problems.Problem as problem:
            await self._refusal(Request(scope), problem)(scope, receive, kept)
            return
        # Nobody reads the body of a request that changes nothing. A stream of events receives only to notice
        # that its client has disconnected, so no limit may end the stream.
        if scope["method"] not in SAFE_METHODS:
            receive = self._bodies.received(scope["path"], headers, receive)
        try:
            await self._app(scope, receive, kept)
        finally:
            at_end = scope.get("state", {}).get("at_end")
            if at_end is not None:
                at_end()

    def _refusal(self, request: Request, problem: problems.Problem) -> Response:
        if problems.wants_page(request):
            return self._as_page(request, problem.status, problem.code, problem.detail, {})
        return problems.document(problem.status, problem.code, problem.detail)

    def _check_host(self, headers: Headers) -> None:
        """Refuse a request whose Host header does not contain a host name of this service. This prevents DNS rebinding.

        In DNS rebinding, a web page of another site makes its own host name resolve to a loopback address. The browser
        then treats the page and the service as one site, so the page could use a service that needs no key.
        """
        hosts = self._access.hosts
        if hosts is None:
            return
        sent = headers.get("host", "")
        if _host_name(sent) not in hosts:
            raise problems.Problem(
                421,
                "host-not-served",
                f"expected a host name of this service; got {sent[:80]!r}: use another address, or add the name to "
                "HELIOPSF_ALLOWED_HOSTS",
            )


def _check_origin(method: str, headers: Headers) -> None:
    """Refuse changes that a web page of another site requests, because the browser would add its stored HTTP Basic password or cookie."""
    if method in SAFE_METHODS:
        return
    site, origin = headers.get("sec-fetch-site"), headers.get("origin")
    if site is not None:
        foreign = site not in ("same-origin", "none")
    else:  # an older browser, or a program
        foreign = origin is not None and urlsplit(origin).netloc.lower() != headers.get("host", "").lower()
    if foreign:
        raise problems.Problem(
            403,
            "cross-site",
            "expected a request from a program or from a page of this service; got a request from a page of another site: "
            "open the page of this service in the browser, and send the form there",
        )


def _host_name(sent: str) -> str:
    """The host in a Host header: lower case, without its port and the brackets of IPv6."""
    try:
        return urlsplit(f"//{sent}").hostname or ""
    except ValueError:
        return ""


def _keep(headers: MutableHeaders, scope: Scope) -> None:
    """Add the headers that every answer has. Headers that the route has set are not replaced."""
    for name, value in problems.SECURITY_HEADERS.items():
        headers.setdefault(name, value)
    if "etag" in headers:
        headers.add_vary_header("Authorization")
        headers.add_vary_header("Cookie")
    else:
        headers.setdefault("Cache-Control", "no-store")
    allowance = scope.get("state", {}).get("allowance")
    if allowance is not None:
        for name, value in allowance.headers.items():
            headers.setdefault(name, value)
