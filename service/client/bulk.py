"""The client's requests about bulk runs, and how the client follows jobs and bulk runs by their events."""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.client.errors import ServiceError, WaitInterrupted
from service.client.versions import Progress

if TYPE_CHECKING:
    import httpx

FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 30.0
PATIENCE_S = 600.0  # a client that waits for a job or bulk run gives up after this time without an answer
PASSING = (None, 429, 502, 503)  # statuses after which a request is tried again; None: no answer
QUIET_S = (
    60.0  # longest silence before the stream counts as broken; a stream sends a line at least every 15 s
)


class BulkClient(ABC):
    """The requests about bulk runs and events.

    If a request fails, every method raises ``ServiceError``. The ``code`` of the error states the reason
    ("path-not-allowed", "no-such-bulk", ...). server: address of the service. say: a function that receives a message
    for the user when the service stops answering during a wait, and when it answers again.
    """

    server: str
    say: Callable[[str], None]

    @abstractmethod
    def get(self, address: str) -> dict[str, Any]:
        """The description at an address of the service."""

    @abstractmethod
    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the file at an address of the service to ``path``; an existing file only if ``overwrite`` is true."""

    @abstractmethod
    def _answer(self, method: str, address: str, **options: Any) -> httpx.Response:
        """The answer to a request, unchanged."""

    @abstractmethod
    def _json(self, method: str, address: str, **options: Any) -> dict[str, Any]:
        """The answer to a request."""

    @abstractmethod
    def _all(self, address: str, filters: dict[str, str]) -> Iterator[dict[str, Any]]:
        """All items of a list."""

    @abstractmethod
    def _streamed(self, address: str, **options: Any) -> AbstractContextManager[httpx.Response]:
        """The answer at an address, read while it arrives."""

    def submit_bulk(
        self,
        *,
        images: Sequence[str] = (),
        files: Sequence[str | Mapping[str, Any]] = (),
        output: str | None = None,
        only: bool = False,
        layout: str | None = None,
        **fields: Any,
    ) -> dict[str, Any]:
        """Start a bulk run and return its description. If a bulk run of an identical request is open, return the description of that run.

        images: ids of uploaded images. files: patterns of paths on the machine of the service, or {"glob": pattern,
        "where": conditions on the header}. output: folder on that machine for the products. only: write the products only to
        this folder. layout: names of the products in this folder, for example ``{telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits``.
        fields: ``name``, either ``psf_id`` or ``context`` (id or name), and the fields of
        ``workers.contract.requests.Treatment``, such as ``method={"name": ..., "steps": ...}`` or ``saturation_dn``.
        """
        wanted = _bulk_request(images, files, output, only, layout, fields)
        return self._json("POST", "/v1/bulk", json=wanted)

    def estimate_bulk(
        self,
        *,
        images: Sequence[str] = (),
        files: Sequence[str | Mapping[str, Any]] = (),
        output: str | None = None,
        only: bool = False,
        layout: str | None = None,
        sample: int | None = None,
        **fields: Any,
    ) -> dict[str, Any]:
        """Estimate a bulk run without starting it. The other arguments and the errors are those of ``submit_bulk``.

        sample: largest number of images whose headers are examined; default: 200. "images" is the number of images that
        were found, "seconds" the expected time of the run with the workers of now, "output_bytes" the expected size of the
        products; "refused" has the examined images that the run would refuse, with the reasons.
        """
        wanted = _bulk_request(images, files, output, only, layout, fields)
        query = {} if sample is None else {"sample": str(sample)}
        return self._json("POST", "/v1/bulk/estimate", json=wanted, params=query)

    def bulk(self, bulk_id: str) -> dict[str, Any]:
        """The current description of a bulk run."""
        return self.get(f"/v1/bulk/{bulk_id}")

    def bulks(self, **filters: str) -> Iterator[dict[str, Any]]:
        """All bulk runs, newest first."""
        return self._all("/v1/bulk", filters)

    def pause_bulk(self, bulk_id: str) -> dict[str, Any]:
        """Pause a bulk run: it starts no more images."""
        return self._json("POST", f"/v1/bulk/{bulk_id}/pause")

    def resume_bulk(self, bulk_id: str) -> dict[str, Any]:
        """Resume a paused or failed bulk run."""
        return self._json("POST", f"/v1/bulk/{bulk_id}/resume")

    def cancel_bulk(self, bulk_id: str) -> dict[str, Any]:
        """End a bulk run permanently. Products that are done are kept."""
        return self._json("POST", f"/v1/bulk/{bulk_id}/cancel")

    def delete_bulk(self, bulk_id: str) -> None:
        """Delete a bulk run that is not LISTING or RUNNING; its products are kept. Raises ``ServiceError`` "wrong-phase"."""
        self._answer("DELETE", f"/v1/bulk/{bulk_id}")

    def retry_bulk(self, bulk_id: str) -> dict[str, Any]:
        """Try the failed images again. Raises ``ServiceError`` "equal-bulk-open" if another bulk run of the same request is open."""
        return self._json("POST", f"/v1/bulk/{bulk_id}/retry")

    def bulk_failures(self, bulk_id: str) -> Iterator[dict[str, Any]]:
        """The failed images, with reasons."""
        return self._all(f"/v1/bulk/{bulk_id}/failures", {})

    def bulk_results(
        self, bulk_id: str, *, order: str = "bulk", limit: int | None = None
    ) -> Iterator[dict[str, Any]]:
        """The images that are done, with checksums and changes. ``order="worst"`` puts the highest artefact score first."""
        query = {"order": order} | ({} if limit is None else {"limit": str(limit)})
        with self._streamed(f"/v1/bulk/{bulk_id}/results", params=query) as answer:
            for line in answer.iter_lines():
                yield json.loads(line)

    def write_bulk_manifest(
        self, bulk_id: str, path: str | Path, *, format: str = "ndjson", overwrite: bool = False
    ) -> None:
        """Write the manifest of all products, as JSON lines ("ndjson") or as a table ("csv")."""
        self.download(f"/v1/bulk/{bulk_id}/results?format={format}", path, overwrite=overwrite)

    def wait_for_bulk(self, bulk_id: str, *, progress: Progress | None = None) -> dict[str, Any]:
        """Wait until a bulk run ends, is paused or has failed; returns its description.

        Raises ``WaitInterrupted`` on Control-C; the bulk run then continues.
        """
        try:
            for bulk in self.follow(f"/v1/bulk/{bulk_id}"):
                images = bulk["images"]
                ended, total = images["done"] + images["failed"], images["total"]
                if progress is not None and not bulk["listed"]:
                    progress(
                        f"{ended} of at least {total} images", 0, 1
                    )  # how many steps are left is unknown
                elif progress is not None and total:
                    progress("images", ended, total)
                if bulk["phase"] not in ("LISTING", "RUNNING"):
                    break
        except KeyboardInterrupt as stop:
            raise WaitInterrupted("bulk", bulk_id, self.server) from stop
        return bulk

    def follow(self, address: str) -> Iterator[dict[str, Any]]:
        """Yield the description of a job or bulk run (address ``/v1/jobs/...``, ``/v1/bulk/...``) now and after each change.

        The iteration ends when the job or bulk run ends or is deleted. If the service does not answer, for example
        during a restart, the client tries again for up to 10 minutes and then raises ``ServiceError``.
        """
        with closing(self._told(f"{address}/events")) as events:
            for event in events:
                if event["event"] == "gone":
                    return
                yield json.loads(event["data"])
                if event["event"] == "end":
                    return

    def events(
        self, *, jobs: Sequence[str] = (), bulks: Sequence[str] = ()
    ) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the state of your jobs and bulk runs: ("job", description), ("bulk", description), ("gone", {"kind",
        "id"}).

        The iteration first yields the jobs and bulk runs that have not ended or that ended in the last seconds, and
        those whose ids are in ``jobs`` and ``bulks``. Then the iteration yields each job or bulk run again when its
        state changes. The iteration does not end by itself. If the service does not answer, the client tries again
        for up to 10 minutes and then raises ``ServiceError``.
        """
        with closing(self._told("/v1/events", params={"job": list(jobs), "bulk": list(bulks)})) as events:
            for event in events:
                yield event["event"], json.loads(event["data"])

    def _told(self, address: str, **options: Any) -> Generator[dict[str, str], None, None]:
        """The events of a stream. If the connection is lost, the stream is opened again. The iteration ends if the
        service answers 204 (no more events)."""
        last_id: str | None = None
        wait_s, heard_at, lost = FIRST_WAIT_S, time.monotonic(), False
        while True:
            headers = {} if last_id is None else {"Last-Event-ID": last_id}
            try:
                with self._streamed(address, headers=headers, timeout=QUIET_S, **options) as answer:
                    for event in _events(answer.iter_lines()):
                        if lost:
                            self.say("the service answers again")
                        last_id, lost = event.get("id", last_id), False
                        wait_s, heard_at = FIRST_WAIT_S, time.monotonic()
                        if "data" in event:
                            yield event
                    if answer.status_code == 204:
                        return
            except ServiceError as error:
                if error.status not in PASSING or time.monotonic() - heard_at > PATIENCE_S:
                    raise
                if not lost:
                    self.say(still_waiting(error))
                wait_s, lost = min(2 * wait_s, LONGEST_WAIT_S), True
            time.sleep(wait_s)


def _bulk_request(
    images: Sequence[str],
    files: Sequence[str | Mapping[str, Any]],
    output: str | None,
    only: bool,
    layout: str | None,
    fields: Mapping[str, Any],
) -> dict[str, Any]:
    """The body of a request for a bulk run."""
    given = {name: value for name, value in fields.items() if value is not None}
    own: dict[str, Any] = {name: given.pop(name) for name in ("name", "psf_id", "context") if name in given}
    return {
        **own,
        "images": list(images),
        "files": [{"glob": one} if isinstance(one, str) else dict(one) for one in files],
        "parameters": given,
        "output": None if output is None else {"folder": output, "only": only, "layout": layout},
    }


def still_waiting(error: ServiceError) -> str:
    """What to tell a user whose service stopped answering during a wait."""
    return (
        f"{error}. Submitted jobs are kept and continue when the service runs again; trying again for "
        f"{PATIENCE_S / 60:.0f} min"
    )


def _events(lines: Iterator[str]) -> Iterator[dict[str, str]]:
    """The events of a stream. A blank line ends an event. An event that only states its id has no data."""
    event: dict[str, str] = {}
    for line in lines:
        if line:
            field, _, value = line.partition(":")
            event[field] = value.removeprefix(" ")
        elif event:
            yield event
            event = {}
