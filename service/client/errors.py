"""What can go wrong between a client and a service: its errors, requests without an answer, and the address of a
service, as users write it: a URL, or host and port of this machine without a scheme.
"""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeVar
from urllib.parse import urlsplit

DEFAULT_SERVER = "http://127.0.0.1:8765"
EXAMPLE = f"{DEFAULT_SERVER} or localhost:8765"
SHOWN_DIGITS = 12  # digits of an id in lists; commands and addresses accept such shortened ids
FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 30.0
PATIENCE_S = 600.0  # a client gives up after this time without an answer
# Statuses after which a request is tried again; None: no answer.
PASSING: tuple[int | None, ...] = (None, 429, 502, 503)

Answer = TypeVar("Answer")


class ServiceError(Exception):
    """A request that was refused, a job that failed, or a service that did not answer.

    Parameters
    ----------
    message : str
        A sentence for people: why the request failed.
    status : int, optional
        HTTP status of the answer. None: there was no answer, or the client found the error.
    code : str, optional
        The reason as a word in kebab-case for programs, such as "no-such-psf". None: heliopsf did not answer.
    retry_after_s : float, optional
        Time after which the service asks to try again, s.
    fields : mapping of str to object, optional
        Further fields of the problem document, such as ``psfs`` of "no-psf-for-instrument".
    """

    def __init__(
        self,
        message: str,
        *,
        status: int | None = None,
        code: str | None = None,
        retry_after_s: float | None = None,
        fields: Mapping[str, object] | None = None,
    ) -> None:
        super().__init__(message)
        self.status, self.code, self.retry_after_s = status, code, retry_after_s
        self.fields = dict(fields or {})


def error_lines(message: str, fields: Mapping[str, Any], *, local: bool) -> list[str]:
    """An error as lines to print. If the telescope of an image is unknown, the lines say why, and name the two ways to
    get a PSF.

    Parameters
    ----------
    fields
        The further fields of the error.
    local
        Whether the command runs without a service.
    """
    if not fields.get("ways"):
        return [message]
    known = {one["way"]: f". {one['known']}" if "known" in one else "" for one in fields["ways"]}
    reason = f": {fields['reason']}" if fields["reason"] else ""
    could = [f"{one['id'][:SHOWN_DIGITS]} ({one['name']} {one['version']})" for one in fields["psfs"]]
    ids = f", or a PSF of the service: --psf ID, such as {', '.join(could[:3])}" if could else ""
    return [
        f"no PSF is known for {fields['image']}{reason}",
        "Two ways:",
        "  1. your own PSF: --psf FILE.fits, or an instrument file (docs/instruments.md): --psf "
        f"FILE.toml{ids}{known['upload']}",
        "  2. a fit to images of a transit: heliopsf psf fit TRANSIT -o "
        f"PSF.fits{' --local' if local else ''}{known['fit']}",
    ]


class WaitInterrupted(KeyboardInterrupt):
    """Control-C was pressed during a wait for a job or a bulk run. The job or bulk run continues without the client.

    Attributes
    ----------
    what
        "job" or "bulk".
    identity
        The id of the job or bulk run.
    server
        Address of the service.
    others
        The ids of further jobs that continue.
    """

    def __init__(self, what: str, identity: str, server: str, others: tuple[str, ...] = ()) -> None:
        named = (
            f"{what} {identity} goes on" if not others else f"{what}s {', '.join((identity, *others))} go on"
        )
        super().__init__(f"the wait was interrupted; {named} at {server}")
        self.what, self.identity, self.server, self.others = what, identity, server, others


class Patience:
    """How long a client repeats a request that got no answer: at growing intervals, for up to 10 minutes.

    Parameters
    ----------
    say
        Function that gets a message when the answers stop, and when they begin again.
    goes_on
        A text for this message that says what happens in the meantime.
    """

    def __init__(self, say: Callable[[str], None], goes_on: str) -> None:
        self._say, self._goes_on, self._lost = say, goes_on, False
        self.answered()

    def answered(self, news: str = "the service answers again") -> None:
        """Begin to count anew. If answers were missing before, the message ``news`` is sent."""
        self._since, self._wait_s = time.monotonic(), FIRST_WAIT_S
        if self._lost:
            self._say(news)
        self._lost = False

    def repeat(self, ask: Callable[[], Answer], passing: Collection[int | None] = PASSING) -> Answer:
        """The answer to a request, which is repeated while the service does not answer."""
        while True:
            try:
                answer = ask()
            except ServiceError as error:
                self.wait(error, passing)
            else:
                self.answered()
                return answer

    def wait(self, error: ServiceError, passing: Collection[int | None] = PASSING) -> None:
        """Wait before the next try. Raises the error if its status is not in ``passing``, or if the patience is at its
        end.
        """
        if error.status not in passing or time.monotonic() - self._since > PATIENCE_S:
            raise error
        if not self._lost and (error.status != 429 or error.code == "too-many-streams"):
            self._say(f"{error}. {self._goes_on} for {PATIENCE_S / 60:.0f} min")
            self._lost = True
        time.sleep(min(error.retry_after_s or self._wait_s, LONGEST_WAIT_S))
        self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)


# --- the address of a service ---------------------------------------------------------------------------


def service_address(text: str) -> str:
    """The URL of a service. ``localhost:8791`` becomes ``http://localhost:8791``.

    A host of another machine needs a scheme, because the client cannot know whether this machine uses TLS, and an
    access key must not be sent without TLS by mistake. Raises ``ServiceError`` "bad-address".
    """
    text = text.strip()
    url = text if "://" in text else f"http://{text}"
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # a port that is no number, or an IPv6 address without its brackets
        valid = False
    if not valid or any(sign.isspace() or not sign.isprintable() for sign in text):
        raise ServiceError(
            f"expected the address of a service, such as {EXAMPLE}; got {text!r}", code="bad-address"
        )
    if url != text and not is_loopback(parts.hostname or ""):
        raise ServiceError(
            f"expected http:// or https:// before the name of another machine; got {text!r}: "
            f"write https://{text} if the service uses TLS, else http://{text}",
            code="bad-address",
        )
    return url


def how_to_start(server: str) -> str:
    """What to do if no service answers at this address: the command that starts a service there, if the address is on
    this machine.
    """
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
