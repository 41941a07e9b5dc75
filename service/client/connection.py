"""The connection of a client to a service: requests, lists, downloads, streams of events, and uploads of large files in
parts.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self, TypedDict, Unpack, cast

import httpx

from psfcore.files import sha256_of
from service.client.answers import AnyAnswer, Health, Json
from service.client.errors import (
    DEFAULT_SERVER,
    FIRST_WAIT_S,
    PASSING,
    Patience,
    ServiceError,
    how_to_start,
    service_address,
)
from service.client.operations import without_none
from service.client.outputs import written

# Longest silence before a stream counts as broken; a stream sends a line at least every 15 s.
QUIET_S = 60.0
GOES_ON = "Submitted jobs are kept and continue when the service runs again; trying again"
PART_BYTES = 2**24  # a cut costs at most this many bytes, because each part has its own checksum
FROM_BYTES = 2**26  # smaller files are sent in one request
TUS = {"Tus-Resumable": "1.0.0"}
# Statuses after which the client asks for the offset and continues: no answer, the part was damaged (460), another
# request sends bytes (423), or the offset was another one (409).
AGAIN = (*PASSING, 409, 423, 460)
Ask = Callable[..., httpx.Response]
Parameter = str | int | float | bool | None
Parameters = Mapping[str, Parameter | Sequence[Parameter]]
_STANDARD_FIELDS = ("type", "title", "status", "detail", "instance")  # of a problem document, RFC 9457


class RequestOptions(TypedDict, total=False):
    """What a request has besides its address and its parameters, as httpx takes them; timeout in s."""

    json: object
    content: bytes | Iterator[bytes]
    headers: Mapping[str, str]
    timeout: float


class Connection:
    """The connection to a service. Every method raises ``ServiceError`` if a request fails; its ``code`` is the reason.

    Attributes
    ----------
    server
        Address of the service.
    """

    server: str

    def __init__(
        self,
        server: str | None = None,
        *,
        key: str | None = None,
        transport: httpx.BaseTransport | None = None,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Prepare the connection. The parameters are those of ``service.client.http.Client``."""
        self.server = service_address(server or os.environ.get("HELIOPSF_SERVER") or DEFAULT_SERVER)
        key = (key or os.environ.get("HELIOPSF_KEY", "")).strip()
        if not (key.isascii() and key.isprintable()) or " " in key:
            # The key is checked here. Otherwise the HTTP library would print the key in its error about a bad header.
            raise ServiceError(
                "expected a key of the form hpsf_ID_SECRET; got another text: set HELIOPSF_KEY to the whole key",
                code="bad-key",
            )
        self.say = say
        self._http = httpx.Client(
            base_url=self.server,
            timeout=60,
            transport=transport,
            headers={"Authorization": f"Bearer {key}"} if key else {},
            event_hooks={"response": [_raise_if_refused]},
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def health(self) -> Health:
        """Ask whether the service is up.

        Returns
        -------
        dict
            The answer of ``/healthz``: ``status`` and ``version``.

        Raises
        ------
        ServiceError
            "database-away" or "reconciler-stopped", or there was no answer.
        """
        return self._json(Health, "GET", "/healthz")

    def wait_until_up(self, timeout_s: float = 60.0) -> None:
        """Wait until the service is up.

        Parameters
        ----------
        timeout_s : float, optional
            Longest wait, s.

        Raises
        ------
        ServiceError
            The error of the last try, after ``timeout_s``.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                self.health()
                return
            except ServiceError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.1)

    def get(self, address: str) -> dict[str, Json]:
        """Get the description at an address of the service.

        Parameters
        ----------
        address : str
            Such as "/v1/products/..." with an id.

        Returns
        -------
        dict
            The description.

        Raises
        ------
        ServiceError
            "no-such-product", "no-such-psf" or another code of the address.
        """
        return self._json(dict[str, Json], "GET", address)

    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        """Download a file of the service.

        Parameters
        ----------
        address : str
            Address of the file, such as ``file`` of a description.
        path : str or path
            Where to write it. The file appears there only when it is complete.
        overwrite : bool, optional
            Whether an existing file is replaced.

        Raises
        ------
        ServiceError
            "output-exists"; "download-damaged" if the SHA-256 is not the one that the service recorded.
        OSError
            The file cannot be written.
        """
        with (
            written(path, overwrite=overwrite) as partial,
            self._streamed(address) as response,
            partial.open("wb") as file,
        ):
            digest = hashlib.sha256()
            for chunk in response.iter_bytes():
                digest.update(chunk)
                file.write(chunk)
            _check_digest(response, digest.digest())

    def follow(self, address: str) -> Iterator[dict[str, Json]]:
        """Follow a job or a bulk run until it ends.

        Parameters
        ----------
        address : str
            "/v1/jobs/..." or "/v1/bulk/..." with an id.

        Yields
        ------
        dict
            The description, now and after each change.

        Raises
        ------
        ServiceError
            The service did not answer for 10 minutes, or it refused the request.

        Notes
        -----
        The iteration ends when the job or bulk run ends or is deleted. If the service does not answer, for example
        during a restart, the client tries again.
        """
        with closing(self._events(f"{address}/events")) as events:
            for event in events:
                if event["event"] == "gone":
                    return
                yield json.loads(event["data"])
                if event["event"] == "end":
                    return

    def events(
        self, *, jobs: Sequence[str] = (), bulks: Sequence[str] = ()
    ) -> Iterator[tuple[str, dict[str, Json]]]:
        """Follow all your jobs and bulk runs.

        Parameters
        ----------
        jobs, bulks : sequence of str, optional
            Ids of jobs and bulk runs whose states are also told if they ended earlier.

        Yields
        ------
        tuple of str and dict
            ("job", description), ("bulk", description) or ("gone", {"kind", "id"}).

        Raises
        ------
        ServiceError
            The service did not answer for 10 minutes, or it refused the request.

        Notes
        -----
        The iteration begins with the jobs and bulk runs that have not ended or that ended in the last seconds. Then it
        tells each one again when its state changes. It does not end by itself.
        """
        with closing(self._events("/v1/events", params={"job": list(jobs), "bulk": list(bulks)})) as events:
            for event in events:
                yield event["event"], json.loads(event["data"])

    def _events(
        self, address: str, params: Parameters | None = None
    ) -> Generator[dict[str, str], None, None]:
        """The events of a stream. If the connection is lost, the stream is opened again. The iteration ends if the
        service answers 204 (no more events).
        """
        last_id: str | None = None
        patience = Patience(self.say, GOES_ON)
        while True:
            headers = {} if last_id is None else {"Last-Event-ID": last_id}
            try:
                with self._streamed(address, params, headers=headers, timeout=QUIET_S) as answer:
                    for event in _events_in(answer.iter_lines()):
                        patience.answered()
                        last_id = event.get("id", last_id)
                        if "data" in event:
                            yield event
                    if answer.status_code == 204:
                        return
            except ServiceError as error:
                patience.wait(error)
            else:
                time.sleep(FIRST_WAIT_S)

    def _all(self, kind: type[AnyAnswer], address: str, filters: Parameters) -> Iterator[AnyAnswer]:
        """All items of a list."""
        page = self._json(dict[str, Json], "GET", address, params={"limit": "200", **filters})
        while True:
            yield from cast("list[AnyAnswer]", page["items"])
            if page["next"] is None:
                return
            page = self.get(str(page["next"]))

    def _json(
        self,
        _kind: type[AnyAnswer],
        method: str,
        address: str,
        *,
        params: Parameters | None = None,
        **options: Unpack[RequestOptions],
    ) -> AnyAnswer:
        """The JSON that a request answers, as an object of the type ``_kind``."""
        body: AnyAnswer = self._answer(method, address, params=params, **options).json()
        return body

    def _answer(
        self,
        method: str,
        address: str,
        *,
        params: Parameters | None = None,
        **options: Unpack[RequestOptions],
    ) -> httpx.Response:
        """The answer to a request. A parameter whose value is None is not sent."""
        with self._reached():
            return self._http.request(method, address, params=without_none(params or {}) or None, **options)

    @contextmanager
    def _streamed(
        self, address: str, params: Parameters | None = None, **options: Unpack[RequestOptions]
    ) -> Iterator[httpx.Response]:
        """The answer at an address, read while it arrives."""
        with self._reached(), self._http.stream("GET", address, params=params, **options) as response:
            yield response

    @contextmanager
    def _reached(self) -> Iterator[None]:
        try:
            yield
        except httpx.TransportError as error:
            raise ServiceError(
                f"no answer from {self.server} ({error}); {how_to_start(self.server)}"
            ) from error


def _events_in(lines: Iterator[str]) -> Iterator[dict[str, str]]:
    """The events of a stream. A blank line ends an event. An event that only states its id has no data."""
    event: dict[str, str] = {}
    for line in lines:
        if line:
            field, _, value = line.partition(":")
            event[field] = value.removeprefix(" ")
        elif event:
            yield event
            event = {}


def _check_digest(response: httpx.Response, received: bytes) -> None:
    """Compare the SHA-256 of the received bytes with the header Repr-Digest (RFC 9530), if the answer has one."""
    declared = response.headers.get("repr-digest", "")
    digest = re.search(r"\bsha-256=:([A-Za-z0-9+/=]+):", declared)
    if digest is not None and digest[1] != base64.b64encode(received).decode():
        raise ServiceError(
            f"expected a file with the SHA-256 {base64.b64decode(digest[1]).hex()}; received one with "
            f"{received.hex()}: try again; if this does not help, the file in the store is damaged: tell the operator",
            code="download-damaged",
        )


def _raise_if_refused(response: httpx.Response) -> None:
    if not response.is_error:
        return
    status = response.status_code
    if not response.headers.get("content-type", "").startswith("application/problem+json"):
        raise ServiceError(
            f"expected an answer of heliopsf; got status {status} in another form: check the address of the service, "
            "and the proxy before it",
            status=status,
        )
    response.read()
    problem = response.json()
    after = response.headers.get("retry-after", "")
    raise ServiceError(
        problem["detail"],
        status=status,
        code=str(problem["type"]).removeprefix("urn:heliopsf:"),
        retry_after_s=float(after) if after.isdecimal() else None,
        fields={name: value for name, value in problem.items() if name not in _STANDARD_FIELDS},
    )


# --- a large file, in parts -----------------------------------------------------------------------------
# By the tus protocol: after a cut of the connection, the upload continues where it was.


def upload_in_parts(ask: Ask, path: Path, kind: str, filename: str, say: Callable[[str], None]) -> str:
    """Upload a file; returns its address in the service. If an earlier upload of this file was cut, continue it.

    ask(method, address, ...): sends a request. Raises ``ServiceError`` if the service refuses the file, or if it does
    not answer for 10 minutes.
    """
    length = path.stat().st_size
    metadata = {"kind": kind, "filename": filename, "sha256": sha256_of(path)}
    text = ",".join(f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in metadata.items())
    headers = TUS | {"Upload-Length": str(length), "Upload-Metadata": text}
    patience = Patience(say, "Trying to continue the upload")
    with path.open("rb") as file:
        while True:
            passing = PASSING
            try:
                answer = ask("POST", "/v1/uploads", headers=headers)
                while "content-location" not in answer.headers:
                    offset = int(answer.headers["upload-offset"])
                    patience.answered(f"the upload continues at {offset / length:.0%}")
                    passing = AGAIN
                    file.seek(offset)
                    answer = ask("PATCH", answer.headers["location"], **_part(file.read(PART_BYTES), offset))
                return str(answer.headers["content-location"])
            except ServiceError as error:
                patience.wait(error, passing)


def _part(content: bytes, offset: int) -> RequestOptions:
    """The body and the headers of a request that sends the bytes from an offset on."""
    checksum = base64.b64encode(hashlib.sha256(content).digest()).decode()
    headers = {
        "Content-Type": "application/offset+octet-stream",
        "Upload-Offset": str(offset),
        "Upload-Checksum": f"sha256 {checksum}",
    }
    return {"content": content, "headers": TUS | headers}
