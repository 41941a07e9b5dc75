"""An HTTP client for scripts: ``with Client("http://127.0.0.1:8765") as client: client.deconvolve("in.fits", "out.fits")``."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

import httpx

from psfcore.errors import DataError
from psfcore.transit.archive import pack
from service.client import resumable
from service.client.address import DEFAULT_SERVER, SHOWN_DIGITS, how_to_start, service_address
from service.client.bulk import FIRST_WAIT_S, LONGEST_WAIT_S, PASSING, PATIENCE_S, BulkClient, still_waiting
from service.client.errors import ServiceError, WaitInterrupted
from service.client.keys import KeysClient
from service.client.operations import Operations
from service.client.outputs import written
from service.client.versions import Progress, VersionedPsfs
from service.client.viewing import Viewing

_STANDARD_FIELDS = ("type", "title", "status", "detail", "instance")  # of a problem document, RFC 9457
QUEUED_S = 10.0  # time in the queue after which a client that waits for a job says so


def _silent(_line: str) -> None:
    """Say nothing."""


class Client(VersionedPsfs, BulkClient, KeysClient, Viewing, Operations):
    """A heliopsf service, over HTTP."""

    server: str
    jobs_at_once = 4

    def __init__(
        self,
        server: str | None = None,
        *,
        key: str | None = None,
        transport: httpx.BaseTransport | None = None,
        say: Callable[[str], None] = _silent,
    ) -> None:
        """server: address of the service; default: HELIOPSF_SERVER. key: access key; default: HELIOPSF_KEY. say: a
        function that is called with a sentence during a wait, if the job stays in the queue or the service does not
        answer.

        A service of this machine needs no scheme: ``localhost:8765``. Raises ``ServiceError`` "bad-address", and "bad-key" if
        the key cannot be sent.
        """
        self.server = service_address(server or os.environ.get("HELIOPSF_SERVER") or DEFAULT_SERVER)
        key = (key or os.environ.get("HELIOPSF_KEY", "")).strip()
        if not (key.isascii() and key.isprintable()) or " " in key:
            # The key is checked here. Otherwise the HTTP library would print the key in its error about a bad header.
            raise ServiceError(
                "expected a key of the form hpsf_ID_SECRET; got another text: set HELIOPSF_KEY to the whole key",
                code="bad-key",
            )
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self.say = say
        self._http = httpx.Client(base_url=self.server, timeout=60, transport=transport, headers=headers)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def health(self) -> dict[str, Any]:
        """The answer of ``/healthz``."""
        return self._json("GET", "/healthz")

    def wait_until_up(self, timeout_s: float = 60.0) -> None:
        """Wait until the service answers. Raises ``ServiceError`` after ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                self.health()
                return
            except ServiceError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.1)

    def upload_image(self, path: str | Path) -> dict[str, Any]:
        """Upload a FITS image; returns its description, with its ``id``."""
        return self._upload("/v1/images", Path(path), {})

    def upload_transit(self, path: str | Path) -> dict[str, Any]:
        """Upload a transit: a folder, or an archive of a folder. Returns the description of the transit, with its ``id``.

        A file of 64 MiB or more is sent in parts. If the connection is cut, the upload continues where it was; if this
        process ends before, the next upload of the same file continues it, for a day.
        """
        with as_archive(Path(path)) as archive:
            if archive.stat().st_size < resumable.FROM_BYTES:
                return self._upload("/v1/transits", archive, {}, media_type="application/octet-stream")
            return self.get(resumable.upload(self._answer, archive, "transit", archive.name, self.say))

    def upload_psf(
        self,
        path: str | Path,
        *,
        name: str | None = None,
        version: str | None = None,
        instrument: str | None = None,
        channel: str | None = None,
        kind: str | None = None,
    ) -> dict[str, Any]:
        """Upload a PSF (FITS); returns its description, with its ``id``."""
        series = {"instrument": instrument, "channel": channel, "kind": kind}
        return self._upload("/v1/psfs", Path(path), {"name": name, "version": version, **series})

    def submit(self, kind: str, *, queue: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Submit a job; returns its description. If an identical job was submitted before, returns the description of
        that job.

        queue: "bulk" runs the job after all jobs of other queues; default: the queue of its kind.
        """
        body = {"kind": kind, "queue": queue, "parameters": parameters}
        return self._json("POST", "/v1/jobs", json=body)

    def estimate(self, kind: str, *, queue: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Estimate a job without starting it. The arguments and the errors are the same as for ``submit``.

        "estimate" has the expected ``seconds`` and ``memory_mib``, "psf" says which PSF a deconvolution would use and why, and
        "existing" is the address of the result if there is one already.
        """
        body = {"kind": kind, "queue": queue, "parameters": parameters}
        return self._json("POST", "/v1/estimates", json=body)

    def result_id(self, kind: str, **parameters: Any) -> str:
        """The id that the result of a job with these parameters has or would have. No job is started."""
        body = {"kind": kind, "parameters": parameters}
        identity: str = self._json("POST", "/v1/jobs/identity", json=body)["result_id"]
        return identity

    def image_id(self, path: str | Path, sha256: str) -> str:
        """The id of an image. If the service does not have the image, the image is uploaded. sha256: hash of the
        file."""
        try:
            identity: str = self.get(f"/v1/images/{sha256}")["id"]
        except ServiceError as error:
            if error.code != "no-such-image":
                raise
            identity = self.upload_image(path)["id"]
        return identity

    def release(self, product: dict[str, Any]) -> None:
        """Do nothing: the service keeps its products."""

    def job(self, job_id: str) -> dict[str, Any]:
        """The current description of a job."""
        return self._json("GET", f"/v1/jobs/{job_id}")

    def jobs(self, **filters: str) -> Iterator[dict[str, Any]]:
        """Your jobs, newest first; ``phase`` selects the jobs in one phase."""
        return self._all("/v1/jobs", filters)

    def cancel(self, job_id: str) -> dict[str, Any]:
        """Cancel a job."""
        return self._json("DELETE", f"/v1/jobs/{job_id}")

    def wait(
        self, job: dict[str, Any], *, progress: Progress | None = None, timeout_s: float | None = None
    ) -> dict[str, Any]:
        """Wait until a job is completed; returns its description.

        If the service does not answer, for example while it is restarted, the client tries again for ten minutes.
        Raises ``ServiceError`` if the job failed or was cancelled, ``TimeoutError`` after ``timeout_s``, and
        ``WaitInterrupted`` on Control-C. After ``TimeoutError`` or ``WaitInterrupted``, the job continues.
        """
        try:
            return self._ended(self._followed(job, progress, timeout_s))
        except KeyboardInterrupt as stop:
            raise WaitInterrupted("job", job["id"], self.server) from stop

    def _followed(
        self, job: dict[str, Any], progress: Progress | None, timeout_s: float | None
    ) -> dict[str, Any]:
        """The description of a job when it has ended."""
        started, told = time.monotonic(), False
        while job["phase"] in ("QUEUED", "EXECUTING"):
            waited_s = time.monotonic() - started
            if timeout_s is not None and waited_s > timeout_s:
                raise TimeoutError(f"job {job['id']} is {job['phase']} after {timeout_s:g} s")
            if job["phase"] == "QUEUED" and waited_s > QUEUED_S and not told:
                self.say(f"job {job['id'][:SHOWN_DIGITS]} waits in the queue {job['queue']}")
                told = True
            time.sleep(0.1)
            job = self._job_patiently(job["id"])
            now = job["progress"]
            if progress is not None and now["stage"]:
                progress(now["stage"], now["step"], max(now["steps"], 1))
        return job

    def _job_patiently(self, job_id: str) -> dict[str, Any]:
        """The description of a job. While the service does not answer, the request is repeated at growing intervals."""
        deadline, wait_s = time.monotonic() + PATIENCE_S, FIRST_WAIT_S
        lost = False
        while True:
            try:
                job = self.job(job_id)
            except ServiceError as error:
                if error.status not in PASSING or time.monotonic() > deadline:
                    raise
                if not lost and error.status != 429:
                    self.say(still_waiting(error))
                    lost = True
                time.sleep(min(error.retry_after_s or wait_s, LONGEST_WAIT_S))
                wait_s = min(2 * wait_s, LONGEST_WAIT_S)
            else:
                if lost:
                    self.say("the service answers again")
                return job

    def get(self, address: str) -> dict[str, Any]:
        """The description at an address of the service."""
        return self._json("GET", address)

    def product(self, product_id: str) -> dict[str, Any]:
        """The description of a product."""
        return self._json("GET", f"/v1/products/{product_id}")

    def psf(self, psf_id: str) -> dict[str, Any]:
        """The description of a PSF version."""
        return self._json("GET", f"/v1/psfs/{psf_id}")

    def psfs(self, **filters: str) -> Iterator[dict[str, Any]]:
        """All PSF versions, newest first."""
        return self._all("/v1/psfs", filters)

    def products(self, **filters: str) -> Iterator[dict[str, Any]]:
        """All products, newest first."""
        return self._all("/v1/products", filters)

    def delete_product(self, product_id: str) -> None:
        """Delete a product. The same request makes it again."""
        self._answer("DELETE", f"/v1/products/{product_id}")

    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        """Download a file of the service. The file appears at ``path`` only when it is complete.

        Raises ``ServiceError`` "download-damaged" if its SHA-256 is not the one that the service recorded.
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

    def ask(self, psf_id: str, question: str, **query: Any) -> dict[str, Any]:
        """The answer of the service to a query about a PSF."""
        parameters = {
            name: ",".join(f"{number!r}" for number in value) if isinstance(value, list) else value
            for name, value in query.items()
        }
        return self._json("GET", f"/v1/psfs/{psf_id}/{question}", params=parameters)

    def psf_cutout(self, psf_id: str, size: int, output: str | Path, *, overwrite: bool = False) -> None:
        """Download the central (size, size) px of a PSF."""
        self.download(f"/v1/psfs/{psf_id}/cutout?size={size}", output, overwrite=overwrite)

    def _upload(
        self, address: str, path: Path, query: dict[str, str | None], *, media_type: str = "application/fits"
    ) -> dict[str, Any]:
        known = {key: value for key, value in query.items() if value is not None}
        with path.open("rb") as file:
            return self._json(
                "POST",
                address,
                params={"filename": path.name, **known},
                content=iter(lambda: file.read(2**20), b""),
                headers={"Content-Type": media_type, "Content-Length": str(path.stat().st_size)},
            )

    def _all(self, address: str, filters: dict[str, str]) -> Iterator[dict[str, Any]]:
        page = self._json("GET", address, params={"limit": "200", **filters})
        while True:
            yield from page["items"]
            if page["next"] is None:
                return
            page = self._json("GET", page["next"])

    @contextmanager
    def _streamed(self, address: str, **options: Any) -> Iterator[httpx.Response]:
        try:
            with self._http.stream("GET", address, **options) as response:
                if response.is_error:
                    response.read()
                    raise _refused(response)
                yield response
        except httpx.TransportError as error:
            raise self._unreachable(error) from error

    def _json(self, method: str, address: str, **options: Any) -> dict[str, Any]:
        body: dict[str, Any] = self._answer(method, address, **options).json()
        return body

    def _answer(self, method: str, address: str, **options: Any) -> httpx.Response:
        try:
            response = self._http.request(method, address, **options)
        except httpx.TransportError as error:
            raise self._unreachable(error) from error
        if response.is_error:
            raise _refused(response)
        return response

    def _unreachable(self, error: httpx.TransportError) -> ServiceError:
        return ServiceError(f"no answer from {self.server} ({error}); {how_to_start(self.server)}")


@contextmanager
def as_archive(path: Path) -> Iterator[Path]:
    """The archive at ``path``. If ``path`` is a folder, a temporary archive of this folder."""
    if not path.is_dir():
        yield path
        return
    with TemporaryDirectory(prefix="heliopsf-") as folder:
        archive = Path(folder) / f"{path.resolve().name}.tar"
        try:
            pack(path, archive)
        except DataError as error:
            raise ServiceError(error.message, code=error.code) from error
        yield archive


def _check_digest(response: httpx.Response, received: bytes) -> None:
    """Compare the SHA-256 of the received bytes with the header Repr-Digest (RFC 9530), if the answer has one."""
    declared = response.headers.get("repr-digest", "")
    found = re.search(r"\bsha-256=:([A-Za-z0-9+/=]+):", declared)
    if found is not None and found[1] != base64.b64encode(received).decode():
        raise ServiceError(
            f"expected a file with the SHA-256 {base64.b64decode(found[1]).hex()}; received one with {received.hex()}: try "
            "again; if this does not help, the file in the store is damaged: tell the operator",
            code="download-damaged",
        )


def _refused(response: httpx.Response) -> ServiceError:
    if response.headers.get("content-type", "").startswith("application/problem+json"):
        problem = response.json()
        code = str(problem["type"]).removeprefix("urn:heliopsf:")
        after = response.headers.get("retry-after", "")
        return ServiceError(
            problem["detail"],
            status=response.status_code,
            code=code,
            retry_after_s=float(after) if after.isdecimal() else None,
            fields={name: value for name, value in problem.items() if name not in _STANDARD_FIELDS},
        )
    return ServiceError(f"the service answered {response.status_code}", status=response.status_code)
