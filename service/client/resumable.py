"""Uploads a large file in parts, by the tus protocol. After a cut of the connection, the upload continues where it was."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from service.client.errors import PASSING, Patience, ServiceError

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
    patience = Patience(say, "Trying to continue the upload")
    while True:
        passing = PASSING
        try:
            begun = ask("POST", "/v1/uploads", headers=headers)
            if "content-location" in begun.headers:
                return str(begun.headers["content-location"])
            offset = int(begun.headers["upload-offset"])
            patience.answered(f"the upload continues at {offset / length:.0%}")
            passing = AGAIN
            return _send_parts(ask, path, begun.headers["location"], offset, patience)
        except ServiceError as error:
            patience.wait(error, passing)


def _send_parts(ask: Ask, path: Path, address: str, offset: int, patience: Patience) -> str:
    """Send all parts from an offset on; returns the address of the file."""
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
            answer = ask("PATCH", address, content=part, headers=headers)
            if "content-location" in answer.headers:
                return str(answer.headers["content-location"])
            patience.answered()
            offset += len(part)
