"""The address of a service, as users write it: a URL, or host and port of this machine without a scheme."""

from __future__ import annotations

import ipaddress
from urllib.parse import SplitResult, urlsplit

from service.client.errors import SHOWN_DIGITS as SHOWN_DIGITS
from service.client.errors import ServiceError

DEFAULT_SERVER = "http://127.0.0.1:8765"
EXAMPLE = f"{DEFAULT_SERVER} or localhost:8765"


def service_address(text: str) -> str:
    """The URL of a service. ``localhost:8791`` becomes ``http://localhost:8791``.

    A host of another machine needs a scheme, because the client cannot know whether this machine uses TLS, and an access
    key must not be sent without TLS by mistake. Raises ``ServiceError`` "bad-address".
    """
    text = text.strip()
    if "://" in text:
        parts = _split(text, text)
        if parts.scheme not in ("http", "https"):
            raise _bad(text)
        return text
    parts = _split(f"http://{text}", text)
    assert parts.hostname is not None
    if not is_loopback(parts.hostname):
        raise ServiceError(
            f"expected http:// or https:// before the name of another machine; got {text!r}: "
            f"write https://{text} if the service uses TLS, else http://{text}",
            code="bad-address",
        )
    return parts.geturl()


def how_to_start(server: str) -> str:
    """What to do if no service answers at this address: the command that starts a service there, if the address is on
    this machine."""
    parts = urlsplit(server)
    if parts.scheme != "http" or not is_loopback(parts.hostname or ""):
        return "check the address, or ask the operator whether the service runs"
    port = parts.port or 80
    named = "" if port == urlsplit(DEFAULT_SERVER).port else f" --port {port}"
    return f"`heliopsf serve{named}` starts a service there; commands with --local need none"


def is_loopback(host: str) -> bool:
    """Whether an address can be reached only from its own machine."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:  # the host is a name, which may stand for another address on another machine
        return False


def _split(url: str, text: str) -> SplitResult:
    """The parts of a URL. Raises ``ServiceError`` if it has no host or no valid port."""
    try:
        parts = urlsplit(url)
        valid = bool(parts.hostname) and (parts.port is None or parts.port > 0)
    except ValueError as error:  # a port that is no number, or an IPv6 address without its brackets
        raise _bad(text) from error
    if not valid or any(sign.isspace() or not sign.isprintable() for sign in text):
        raise _bad(text)
    return parts


def _bad(text: str) -> ServiceError:
    return ServiceError(
        f"expected the address of a service, such as {EXAMPLE}; got {text!r}", code="bad-address"
    )
