"""Bounds on the body of a request: its size, and the number of values in it.

A body costs memory and time before its content is known. Therefore its size is bounded while it arrives, and the values
in JSON are counted before Python makes objects of these values. The proxy in front of the server bounds the time.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from fastapi import Request
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.types import Message, Receive

from service.http.problems import Problem
from service.http.uploads import has_own_limit
from workers.settings import Settings

BULK = frozenset({"/v1/bulk", "/v1/bulk/estimate"})  # the only addresses at which large JSON is expected
# The largest request, a bulk run of 100,000 uploaded images, has one list and one value for each image. Python makes a
# list or an object for each bracket, and pydantic may report an error for each member of an object.
MOST_OF = {b"[": 25_000, b"{": 25_000, b":": 25_000, b",": 200_000}


@dataclass(frozen=True)
class BodyLimits:
    """The largest body of a usual request, and the largest body of a bulk run."""

    usual_bytes: int
    bulk_bytes: int

    @classmethod
    def of(cls, settings: Settings) -> BodyLimits:
        """The limits in the settings."""
        return cls(settings.max_body_kib * 2**10, settings.max_bulk_body_mib * 2**20)

    def received(self, path: str, headers: Headers, receive: Receive) -> Receive:
        """The body of a request, within these limits. Uploads have their own limits on the size, in ``service.http.uploads``.

        The reader of the body gets ``Problem`` 413 at once if the declared length is too large, and as soon as too many
        bytes have arrived.
        """
        own = has_own_limit(path, headers.get("content-type", ""))
        most = None if own else self.bulk_bytes if path in BULK else self.usual_bytes
        declared = headers.get("content-length", "")
        got, more = 0, True

        async def limited() -> Message:
            nonlocal got, more
            if not more:  # the body is complete; the next message is the end of the connection
                return await receive()
            if most is not None and declared.isdecimal() and int(declared) > most:
                raise _too_large(path, most)
            message = await receive()
            got += len(message.get("body", b""))
            more = message.get("more_body", False)
            if most is not None and got > most:
                raise _too_large(path, most)
            return message

        return limited


class JsonRequest(Request):
    """A request with JSON. Its values are counted before it is parsed; a thread parses it, so that other requests do not wait."""

    async def json(self) -> Any:
        """The content of the body. Raises ``Problem`` 413 for too many values, and ValueError if it is not JSON."""
        content = await self.body()
        for sign, most in MOST_OF.items():
            found = content.count(sign)
            if found > most:
                raise Problem(
                    413,
                    "too-many-values",
                    f"expected JSON with at most {most} characters '{sign.decode()}'; got {found}: send less in one request",
                )
        return await run_in_threadpool(json.loads, content)


def _too_large(path: str, most: int) -> Problem:
    setting = "HELIOPSF_MAX_BULK_BODY_MIB" if path in BULK else "HELIOPSF_MAX_BODY_KIB"
    return Problem(
        413,
        "too-large",
        f"expected a request of at most {most} bytes; got more: send less in one request, or ask the operator to raise "
        f"{setting}",
    )
