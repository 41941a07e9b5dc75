"""What a client asks of bulk, many images deconvolved alike, and how it follows what goes on."""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import httpx

from service.client.errors import ServiceError
from service.client.versions import Progress

FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 30.0
PATIENCE_S = 600.0
PASSING = (None, 429, 502, 503)  # no answer at all, or one that says to come again
QUIET_S = 60.0  # a stream says at least every 15 s that it is there


class BulkClient(ABC):
    """The part of a service's client that is about bulk and events.

    Every method raises ``ServiceError``, whose ``code`` says why ("path-not-allowed", "no-such-bulk", ...).
    """

    @abstractmethod
    def get(self, address: str) -> dict[str, Any]:
        """The description at an address of the service."""

    @abstractmethod
    def download(self, address: str, path: str | Path) -> None:
        """Write the file at an address of the service to ``path``."""

    @abstractmethod
    def _json(self, method: str, address: str, **options: Any) -> dict[str, Any]:
        """The answer to a request."""

    @abstractmethod
    def _all(self, address: str, filters: dict[str, str]) -> Iterator[dict[str, Any]]:
        """All items of a list."""

    @abstractmethod
    def _streamed(self, address: str, **options: Any) -> AbstractContextManager[httpx.Response]:
        """The answer at an address, while it comes."""

    def submit_bulk(
        self,
        *,
        images: Sequence[str] = (),
        files: Sequence[str | Mapping[str, Any]] = (),
        psf_id: str | None = None,
        context: str | None = None,
        output: str | None = None,
        only: bool = False,
        name: str = "",
        **parameters: Any,
    ) -> dict[str, Any]:
        """Have many images deconvolved; returns the bulk, which is the open one of an equal request if there is one.

        ``images``: ids of uploads. ``files``: patterns on the service's machine, or {"glob": ..., "where": {...}} with
        what headers must say. ``psf_id`` or ``context`` (id or name). ``output``: folder there; ``only`` there.
        ``parameters``: ``method={"name": ..., "steps": ...}``, ``noise``, ``saturation_dn``, ``error_draws``.
        """
        return self._json(
            "POST",
            "/v1/bulk",
            json={
                "name": name,
                "images": list(images),
                "files": [{"glob": one} if isinstance(one, str) else dict(one) for one in files],
                "psf_id": psf_id,
                "context": context,
                "parameters": {key: value for key, value in parameters.items() if value is not None},
                "output": None if output is None else {"folder": output, "only": only},
            },
        )

    def bulk(self, bulk_id: str) -> dict[str, Any]:
        """A bulk as it is now."""
        return self.get(f"/v1/bulk/{bulk_id}")

    def bulks(self, **filters: str) -> Iterator[dict[str, Any]]:
        """All bulks, newest first."""
        return self._all("/v1/bulk", filters)

    def pause_bulk(self, bulk_id: str) -> dict[str, Any]:
        """Begin no more of its images."""
        return self._json("POST", f"/v1/bulk/{bulk_id}/pause")

    def resume_bulk(self, bulk_id: str) -> dict[str, Any]:
        """Let a bulk that was paused, or could not go on, go on."""
        return self._json("POST", f"/v1/bulk/{bulk_id}/resume")

    def cancel_bulk(self, bulk_id: str) -> dict[str, Any]:
        """End a bulk; what is done stays."""
        return self._json("POST", f"/v1/bulk/{bulk_id}/cancel")

    def retry_bulk(self, bulk_id: str) -> dict[str, Any]:
        """Try again what failed; "equal-bulk-open" where the same request is at work as another bulk."""
        return self._json("POST", f"/v1/bulk/{bulk_id}/retry")

    def bulk_failures(self, bulk_id: str) -> Iterator[dict[str, Any]]:
        """Images that failed, with reasons."""
        return self._all(f"/v1/bulk/{bulk_id}/failures", {})

    def bulk_results(
        self, bulk_id: str, *, order: str = "bulk", limit: int | None = None
    ) -> Iterator[dict[str, Any]]:
        """Images that are done, with checksums and what changed; ``order="worst"``: the most doubtful first."""
        query = {"order": order} | ({} if limit is None else {"limit": str(limit)})
        with self._streamed(f"/v1/bulk/{bulk_id}/results", params=query) as answer:
            for line in answer.iter_lines():
                yield json.loads(line)

    def write_bulk_manifest(self, bulk_id: str, path: str | Path, *, format: str = "ndjson") -> None:
        """Write the manifest of what is done, as lines of JSON ("ndjson") or as a table ("csv")."""
        self.download(f"/v1/bulk/{bulk_id}/results?format={format}", path)

    def wait_for_bulk(self, bulk_id: str, *, progress: Progress | None = None) -> dict[str, Any]:
        """Follow a bulk to its end, or to where it cannot go on by itself; returns it as it is then."""
        for bulk in self.follow(f"/v1/bulk/{bulk_id}"):
            images = bulk["images"]
            if progress is not None and images["total"]:
                progress("images", images["done"] + images["failed"], images["total"])
            if bulk["phase"] not in ("LISTING", "RUNNING"):
                break
        return bulk

    def follow(self, address: str) -> Iterator[dict[str, Any]]:
        """A job or a bulk, by its address (``/v1/jobs/...``, ``/v1/bulk/...``): now, and each time it has changed.

        Ends with it. A service that is away for some minutes (a restart) does not end it.
        """
        last_id: str | None = None
        wait_s, heard_at = FIRST_WAIT_S, time.monotonic()
        while True:
            headers = {} if last_id is None else {"Last-Event-ID": last_id}
            try:
                with self._streamed(f"{address}/events", headers=headers, timeout=QUIET_S) as answer:
                    for event in _events(answer.iter_lines()):
                        last_id = event.get("id", last_id)
                        wait_s, heard_at = FIRST_WAIT_S, time.monotonic()
                        if event["event"] == "gone":
                            return
                        yield json.loads(event["data"])
                        if event["event"] == "end":
                            return
                    if answer.status_code == 204:
                        return
            except ServiceError as error:
                if error.status not in PASSING or time.monotonic() - heard_at > PATIENCE_S:
                    raise
                wait_s = min(2 * wait_s, LONGEST_WAIT_S)
            time.sleep(wait_s)


def _events(lines: Iterator[str]) -> Iterator[dict[str, str]]:
    """Events of a stream; what stands before a blank line is one, if it has data."""
    event: dict[str, str] = {}
    for line in lines:
        if line:
            field, _, value = line.partition(":")
            event[field] = value.removeprefix(" ")
        elif "data" in event:
            yield event
            event = {}
        else:
            event = {}
