"""Checks every request before its route (host, origin, address, size of the body), and sets the security headers of
every answer.

A header costs time before any key is known. Therefore a long Cookie header is refused, and of the others only the
cookie of the session goes on: FastAPI parses the cookies of every request with Python's library, whose time grew with
the square of their length before Python 3.11.10 and 3.12.6 (CVE-2024-7592).

A body costs memory and time before its content is known. Therefore its size is bounded while it arrives, and the values
in JSON are counted before Python makes objects of these values. The proxy in front of the server bounds the time.

All requests are answered in rounds of one event loop, and each needs several rounds. Therefore the requests with one
key begin one after the other, and of the bodies of one owner one piece arrives in a round: it stays short if one owner
sends very much at once.

``check_text`` checks every string of a request: this module calls it for the address and for JSON, and the code that
reads a form calls it for the form. The interfaces of the Virtual Observatory check theirs themselves, and answer errors
in another form.
"""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from urllib.parse import unquote, urlsplit

from fastapi import FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.forms import FORM, URL_ENCODED
from service.http.problems import FOR_PROGRAMS, SECURITY_HEADERS, AsPage, Problem, answer
from service.http.rates import Turns
from service.http.state import Access
from workers.settings import Settings

SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
# Style sheets, scripts and pictures of pages. These files contain no data of owners, and the page of a
# refusal needs them.
FOR_EVERYBODY = "/static/"
BULK = frozenset({"/v1/bulk", "/v1/bulk/estimate"})  # the only addresses at which large JSON is expected
# Addresses that limit the size of a body themselves: UPLOADS because it may contain files, UWS_FORMS of a multipart
# form, so that a client that sends a file is told what to do instead.
UPLOADS = re.compile(r"(/v1)?/(images|psfs|transits)|/v1/uploads/.*", re.DOTALL)
UWS_FORMS = re.compile(r"/uws/jobs(/[^/]+/parameters)?")
# The largest request, a bulk run of 100,000 uploaded images, has one list and one value for each image. Python makes a
# list or an object for each bracket, and pydantic may report an error for each member of an object.
MOST_OF = {b"[": 25_000, b"{": 25_000, b":": 25_000, b",": 200_000}
VO = ("/uws", "/vo/")
COOKIE_BYTES = 4096
MOST_ACCOUNTS = 10_000  # of which it is known whose key it is
SESSION_COOKIE = "heliopsf_session"
# NUL, which PostgreSQL cannot store, and halves of surrogate pairs, which UTF-8 cannot encode.
NO_TEXT = re.compile("[\0\ud800-\udfff]")


def install(app: FastAPI, access: Access, settings: Settings, as_page: AsPage) -> None:
    """Guard every request of the application. ``as_page`` makes the page of a refusal, for browsers."""
    app.add_middleware(_Guard, access=access, settings=settings, as_page=as_page)


class _Guard:
    def __init__(self, app: ASGIApp, access: Access, settings: Settings, as_page: AsPage) -> None:
        self._app, self._access, self._settings, self._as_page = app, access, settings, as_page
        self._begin, self._pieces = Turns(), Turns()
        self._accounts: dict[int, str] = {}  # by the hash of a key that was good

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
            _keep_own_cookie(scope, headers)  # first, because the page of a refusal reads the cookie too
            if scope["method"] not in SAFE_METHODS or not scope["path"].startswith(FOR_EVERYBODY):
                self._check_host(headers)
            _check_origin(scope["method"], headers)
            _check_framing(headers)
            if not scope["path"].startswith(VO):
                check_text(scope["path"], unquote(scope["query_string"].decode("latin-1")))
            _check_form(scope["path"], headers)
        except Problem as problem:
            await answer(Request(scope), problem, self._as_page)(scope, receive, kept)
            return
        # Nobody reads the body of a request that changes nothing. A stream of events receives only to notice
        # that its client has disconnected, so no limit may end the stream.
        if scope["method"] not in SAFE_METHODS:
            receive = self._limited(scope["path"], headers, receive)
        try:
            await self._in_turn(scope, receive, kept)
        finally:
            at_end = scope.get("state", {}).get("at_end")
            if at_end is not None:
                at_end()

    async def _in_turn(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request as soon as it is the turn of its owner, or of its key if that is new here.

        The turn ends when the request is admitted (``service.http.callers.admit``), reads its body, or has an answer. A
        request without a key does not wait.
        """
        headers, state = Headers(scope=scope), scope.setdefault("state", {})
        key, turn = hash(headers.get("authorization") or headers.get("cookie")), ExitStack()
        if "authorization" in headers or "cookie" in headers:
            lock = self._begin.of(self._accounts.get(key, f"key {key}"))
            await lock.acquire()
            turn.callback(lock.release)
        state["admitted"] = partial(asyncio.get_running_loop().call_soon_threadsafe, turn.close)

        async def in_pieces() -> Message:
            turn.close()
            message = await receive()
            if message.get("body") and "caller" in state:
                async with self._pieces.of(state["caller"].account):
                    await asyncio.sleep(0)
            return message

        async def begun(message: Message) -> None:
            turn.close()
            await send(message)

        with turn:
            await self._app(scope, in_pieces, begun)
        if "caller" in state:
            if len(self._accounts) >= MOST_ACCOUNTS:
                self._accounts.clear()
            self._accounts[key] = state["caller"].account

    def _limited(self, path: str, headers: Headers, receive: Receive) -> Receive:
        """The body of a request, within the limits of the settings. Uploads have limits of their own.

        The reader of the body gets ``Problem`` 413 at once if the declared length is too large, and as soon as too many
        bytes have arrived.
        """
        form = headers.get("content-type", "").lower().startswith(FORM)
        if UPLOADS.fullmatch(path) or (form and UWS_FORMS.fullmatch(path)):
            return receive
        most, setting = self._settings.max_body_kib * 2**10, "HELIOPSF_MAX_BODY_KIB"
        if path in BULK:
            most, setting = self._settings.max_bulk_body_mib * 2**20, "HELIOPSF_MAX_BULK_BODY_MIB"
        declared = headers.get("content-length", "")
        got, more = 0, True

        async def limited() -> Message:
            nonlocal got, more
            if not more:  # the body is complete; the next message is the end of the connection
                return await receive()
            if not (declared.isdecimal() and int(declared) > most):
                message = await receive()
                got += len(message.get("body", b""))
                more = message.get("more_body", False)
                if got <= most:
                    return message
            raise Problem(
                413,
                "too-large",
                f"expected a request of at most {most} bytes; got more: send less in one request, or ask the "
                f"operator to raise {setting}",
            )

        return limited

    def _check_host(self, headers: Headers) -> None:
        """Refuse a request whose Host header does not contain a host name of this service. This prevents DNS rebinding.

        In DNS rebinding, a web page of another site makes its own host name resolve to a loopback address. The browser
        then treats the page and the service as one site, so the page could use a service that needs no key.
        """
        hosts = self._access.hosts
        if hosts is None:
            return
        sent = headers.get("host", "")
        if _host_of(f"//{sent}")[1] not in hosts:
            raise Problem(
                421,
                "host-not-served",
                f"expected a host name of this service; got {sent[:80]!r}: use another address, or add the name to "
                "HELIOPSF_ALLOWED_HOSTS",
            )


def check_text(*texts: str) -> None:
    """Raise ``Problem`` 422 if a text contains a character that no text of a request may contain."""
    if any(map(NO_TEXT.search, texts)):
        raise Problem(
            422,
            "invalid-request",
            "expected texts without the character NUL and without halves of surrogate pairs; got one of them: remove "
            "it",
        )


def _check_form(path: str, headers: Headers) -> None:
    """Refuse a multipart form for a page that takes no file. Its own charset could name any codec of Python."""
    if path.startswith(FOR_PROGRAMS) or UPLOADS.fullmatch(path):
        return
    if headers.get("content-type", "").lower().startswith(FORM):
        raise Problem(415, "bad-form", f"expected {URL_ENCODED}; got {FORM}: send fields only")


def _host_of(address: str) -> tuple[str | None, str]:
    """The host of an address with its port, and without it and the brackets of IPv6, in lower case; None and "" for a
    text that is no address.
    """
    try:
        parts = urlsplit(address)
        return parts.netloc.lower(), parts.hostname or ""
    except ValueError:
        return None, ""


def _check_origin(method: str, headers: Headers) -> None:
    """Refuse changes that a web page of another site requests, because the browser would add its stored HTTP Basic
    password or cookie.
    """
    if method in SAFE_METHODS:
        return
    site, origin = headers.get("sec-fetch-site"), headers.get("origin")
    if site is not None:
        foreign = site not in ("same-origin", "none")
    else:  # an older browser, or a program
        foreign = origin is not None and _host_of(origin)[0] != headers.get("host", "").lower()
    if foreign:
        raise Problem(
            403,
            "cross-site",
            "expected a request from a program or from a page of this service; got a request from a page of another "
            "site: open the page of this service in the browser, and send the form there",
        )


def _check_framing(headers: Headers) -> None:
    """Refuse a body whose length is given in two ways: a proxy may go by the other one, and the rest of the body would
    then be read as a further request. The connection is closed, because nobody knows where the next request begins.
    """
    if "transfer-encoding" in headers and "content-length" in headers:
        raise Problem(
            400,
            "two-body-lengths",
            "expected Content-Length or Transfer-Encoding; got both: send one of them",
            headers={"Connection": "close"},
        )


def cookie_name(scheme: str) -> str:
    """The name of the cookie of a session.

    Browsers accept a cookie with the prefix ``__Host-`` only over HTTPS and only from this host. So no other host of
    the domain can set such a cookie.
    """
    return f"__Host-{SESSION_COOKIE}" if scheme == "https" else SESSION_COOKIE


def _keep_own_cookie(scope: Scope, headers: Headers) -> None:
    """Leave only the cookie of the session in the headers of a request. Raises ``Problem`` 431 for more than
    ``COOKIE_BYTES`` of cookies.
    """
    sent = headers.getlist("cookie")
    if not sent:
        return
    scope["headers"] = [(name, value) for name, value in scope["headers"] if name != b"cookie"]
    if sum(map(len, sent)) > COOKIE_BYTES:
        raise Problem(
            431,
            "cookies-too-long",
            f"expected at most {COOKIE_BYTES} bytes of cookies; got more: delete the cookies of this site in the "
            "browser, or send none with a key",
        )
    own = re.search(rf"(?:^|;) *({cookie_name(scope['scheme'])}=[\w-]+) *(?:;|$)", ";".join(sent), re.ASCII)
    if own is not None:
        scope["headers"].append((b"cookie", own[1].encode()))


def _keep(headers: MutableHeaders, scope: Scope) -> None:
    """Add the headers that every answer has. Headers that the route has set are not replaced."""
    for name, value in SECURITY_HEADERS.items():
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


class JsonRequest(Request):
    """A request with JSON. Its values are counted before it is parsed; a thread parses it, so that other requests do
    not wait.
    """

    async def json(self) -> object:
        """The content of the body. Raises ``Problem`` 413 for too many values, ``Problem`` 422 as ``check_text``, and
        ValueError if it is not JSON.
        """
        content = await self.body()
        for sign, most in MOST_OF.items():
            if content.count(sign) > most:
                raise Problem(
                    413,
                    "too-many-values",
                    f"expected JSON with at most {most} characters '{sign.decode()}'; got {content.count(sign)}: send "
                    "less in one request",
                )

        def parsed() -> object:
            value = json.loads(content)
            check_text(*_texts_in(value))
            return value

        return await run_in_threadpool(parsed)


def _texts_in(value: object) -> Iterator[str]:
    """The texts in a value of JSON, with the names of its members."""
    left = [value]
    while left:
        one = left.pop()
        if isinstance(one, str):
            yield one
        elif isinstance(one, dict):
            yield from one
            left += one.values()
        elif isinstance(one, list):
            left += one
