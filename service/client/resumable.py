"""Uploads a large file in parts, by the tus protocol. After a cut of the connection, the upload continues where it was."""

from __future__ import annotations

import base64
import hashlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.client.bulk import FIRST_WAIT_S, LONGEST_WAIT_S, PASSING, PATIENCE_S
from service.client.errors import ServiceError

if TYPE_CHECKING:
    import httpx

PART_BYTES = 2**24  # a cut costs at most this many bytes, because each part has its own checksum
FROM_BYTES = 2**26  # smaller files are sent in one request
TUS = {"Tus-Resumable": "1.0.0"}
# Statuses after which the client asks for the offset and continues: no answer, the part was damaged (460), another request
# sends bytes (423), or the offset was another one (409).
AGAIN = (*PASSING, 409, 423, 460)
Ask = Callable[..., "httpx.Response"]


def upload(ask: Ask, path: Path, kind: str, filename: str, say: Callable[[str], None]) -> str:
    """Upload a file; returns its address in the service. If an earlier upload of this file was cut, continue it.

    ask(method, address, ...): sends a request. Raises ``ServiceError`` if the service refuses the file, or if it does not
    answer for 10 minutes.
    """
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    length = path.stat().st_size
    metadata = {"kind": kind, "filename": filename, "sha256": sha256}
    text = ",".join(f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in metadata.items())
    headers = TUS | {"Upload-Length": str(length), "Upload-Metadata": text}
    heard_at, wait_s, cut = time.monotonic(), FIRST_WAIT_S, False
    while True:
        try:
            begun = ask("POST", "/v1/uploads", headers=headers)
            if "content-location" in begun.headers:
                return str(begun.headers["content-location"])
            if cut:
                say(f"the upload continues at {int(begun.headers['upload-offset']) / length:.0%}")
            cut, heard_at, wait_s = False, time.monotonic(), FIRST_WAIT_S
            return _sent(ask, path, begun.headers["location"], int(begun.headers["upload-offset"]))
        except _Cut as error:
            if error.progress:
                heard_at, wait_s = time.monotonic(), FIRST_WAIT_S
            _wait_or_raise(error.reason, heard_at)
            reason = error.reason
        except ServiceError as error:
            if error.status not in PASSING:
                raise
            _wait_or_raise(error, heard_at)
            reason = error
        if not cut:
            say(f"{reason}. Trying to continue the upload for {PATIENCE_S / 60:.0f} min")
        cut = True
        time.sleep(min(reason.retry_after_s or wait_s, LONGEST_WAIT_S))
        wait_s = min(2 * wait_s, LONGEST_WAIT_S)


class _Cut(Exception):
    """A part was not received. progress: whether parts before it were received."""

    def __init__(self, reason: ServiceError, *, progress: bool) -> None:
        super().__init__(str(reason))
        self.reason, self.progress = reason, progress


def _sent(ask: Ask, path: Path, address: str, offset: int) -> str:
    """Send all parts from an offset on; returns the address of the file. Raises ``_Cut`` and ``ServiceError``."""
    begun_at = offset
    with path.open("rb") as file:
        file.seek(offset)
        while True:
            part = file.read(PART_BYTES)
            checksum = base64.b64encode(hashlib.sha256(part).digest()).decode()
            headers = TUS | {
                "Content-Type": "application/offset+octet-stream",
                "Upload-Offset": str(offset),
                "Upload-Checksum": f"sha256 {checksum}",
            }
            try:
                answer: Any = ask("PATCH", address, content=part, headers=headers)
            except ServiceError as error:
                if error.status not in AGAIN:
                    raise
                raise _Cut(error, progress=offset > begun_at) from error
            if "content-location" in answer.headers:
                return str(answer.headers["content-location"])
            offset += len(part)


def _wait_or_raise(error: ServiceError, heard_at: float) -> None:
    if time.monotonic() - heard_at > PATIENCE_S:
        raise error
