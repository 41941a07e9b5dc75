"""The client's requests about PSF versions: status, best PSF, series, contexts, lineage, reruns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

Progress = Callable[[str, int, int], None]


class VersionedPsfs(ABC):
    """The requests about PSF versions. Times are in ISO 8601; a time without a zone is UTC.

    Every method raises ``service.client.errors.ServiceError``; its ``code`` is the reason ("ranges-overlap", "no-psf-fits", ...).
    """

    @abstractmethod
    def get(self, address: str) -> dict[str, Any]:
        """The description at an address of the service."""

    @abstractmethod
    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the file at an address of the service to ``path``; an existing file only if ``overwrite`` is true."""

    @abstractmethod
    def submit(self, kind: str, *, queue: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Submit a job."""

    @abstractmethod
    def wait(self, job: dict[str, Any], *, progress: Progress | None = None) -> dict[str, Any]:
        """Wait until a job ends."""

    @abstractmethod
    def _json(self, method: str, address: str, **options: Any) -> dict[str, Any]:
        """The answer to a request."""

    @abstractmethod
    def _all(self, address: str, filters: dict[str, str]) -> Iterator[dict[str, Any]]:
        """All items of a list."""

    def psf_status(self, psf_id: str) -> dict[str, Any]:
        """The status of a PSF, the status changes that are allowed, a free version of its series, and its history."""
        return self.get(f"/v1/psfs/{psf_id}/status")

    def certify_psf(
        self,
        psf_id: str,
        version: str | None = None,
        *,
        valid_from: str | None = None,
        valid_to: str | None = None,
        supersedes: Sequence[str] = (),
        reason: str = "",
        **series: str | None,
    ) -> dict[str, Any]:
        """Certify a draft under a version, or change the time range of a certified PSF. Returns its new status.

        supersedes: certified PSFs to deprecate in the same step. series: ``instrument``, ``channel`` and ``kind`` of an
        uploaded PSF, if its file does not contain them.
        """
        body = {
            "status": "certified",
            "version": version,
            "valid_from": valid_from,
            "valid_to": valid_to,
            "supersedes": list(supersedes),
            "reason": reason,
            **series,
        }
        return self._json("POST", f"/v1/psfs/{psf_id}/status", json=body)

    def deprecate_psf(self, psf_id: str, successor: str | None = None, *, reason: str = "") -> dict[str, Any]:
        """Deprecate a certified PSF, or name the successor of a deprecated PSF. Returns its new status."""
        body = {"status": "deprecated", "successor": successor, "reason": reason}
        return self._json("POST", f"/v1/psfs/{psf_id}/status", json=body)

    def delete_psf(self, psf_id: str) -> dict[str, Any]:
        """Delete a draft that nothing uses. Returns its last description."""
        return self._json("DELETE", f"/v1/psfs/{psf_id}")

    def best_psf(self, **filters: str | None) -> dict[str, Any]:
        """The one PSF that fits ``instrument``, ``channel``, ``kind``, ``version``, ``valid_at``, ``context``, ...

        The description of the PSF is under the key "psf". Raises ``ServiceError`` "no-psf-fits" or "several-psfs-fit".
        """
        return self._json("GET", "/v1/psfs/best", params=_given(filters))

    def psf_for_image(self, image_id: str, **where: str | None) -> dict[str, Any]:
        """The PSF that fits the header of an uploaded image; ``context`` and ``kind`` as for ``best_psf``."""
        return self._json("GET", f"/v1/images/{image_id}/psf", params=_given(where))

    def affected(self, psf_id: str | None = None, *, superseded: bool = False) -> Iterator[dict[str, Any]]:
        """Products made with a PSF. Without ``psf_id``: products made with any deprecated PSF.

        superseded: list only products whose PSF has a successor.
        """
        if psf_id is not None:
            return self._all(f"/v1/psfs/{psf_id}/affected", {})
        return self._all("/v1/affected", {"superseded": "true" if superseded else "false"})

    def series(self) -> Iterator[dict[str, Any]]:
        """The series of which a PSF was certified: name, and whether its PSFs may be interpolated."""
        return self._all("/v1/series", {})

    def interpolate_series(
        self, series: str, interpolated: bool = True, *, reason: str = ""
    ) -> dict[str, Any]:
        """Say whether the PSFs of a series (instrument/channel/kind) may be interpolated in time. Returns the series."""
        body = {"interpolated": interpolated, "reason": reason}
        return self._json("PUT", f"/v1/series/{series}", json=body)

    def interpolate_psf(
        self,
        before: str,
        after: str,
        time: str,
        *,
        before_time: str | None = None,
        after_time: str | None = None,
        progress: Progress | None = None,
    ) -> dict[str, Any]:
        """Interpolate between two fitted PSFs in time; returns the new PSF.

        before, after: their ids. before_time, after_time: the last time at which the earlier PSF holds, and the first
        time at which the later PSF holds; default: the end and the start of the ranges for which they are certified.
        """
        times = {
            "before_time": before_time or self.get(f"/v1/psfs/{before}")["valid_to"],
            "after_time": after_time or self.get(f"/v1/psfs/{after}")["valid_from"],
        }
        job = self.submit(
            "psf-interpolate", before_psf_id=before, after_psf_id=after, time=time, **_given(times)
        )
        return self.get(self.wait(job, progress=progress)["result"])

    def contexts(self) -> Iterator[dict[str, Any]]:
        """All contexts, newest first, without their pins."""
        return self._all("/v1/contexts", {})

    def context(self, id_or_name: str) -> dict[str, Any]:
        """A context with its pins."""
        return self.get(f"/v1/contexts/{id_or_name}")

    def create_context(
        self, name: str, pins: Sequence[dict[str, Any]] | None = None, *, reason: str = ""
    ) -> dict[str, Any]:
        """Make a context. pins: ``{"psf_id", "valid_from", "valid_to"}`` for each PSF; default: all certified PSFs."""
        body = {"name": name, "reason": reason, "pins": None if pins is None else list(pins)}
        return self._json("POST", "/v1/contexts", json=body)

    def default_context(self) -> dict[str, Any]:
        """The default context, from which the PSF is chosen if a request names no context, and the history of its changes."""
        return self.get("/v1/contexts/default")

    def use_context(self, id_or_name: str | None, *, reason: str = "") -> dict[str, Any]:
        """Make a context the default; None: use the PSFs that are certified at the time of each request."""
        return self._json("PUT", "/v1/contexts/default", json={"context": id_or_name, "reason": reason})

    def lineage(self, of: Literal["psf", "product"], identity: str) -> dict[str, Any]:
        """The images, transits and PSFs from which a PSF or a product was made, back to the uploads."""
        return self.get(f"/v1/{of}s/{identity}/lineage")

    def provenance(
        self, of: Literal["psf", "product"], identity: str, output: str | Path, *, overwrite: bool = False
    ) -> None:
        """Write the lineage of a PSF or a product as W3C PROV: PROV-N if the name of the file ends in .provn, otherwise PROV-JSON."""
        form = "provn" if Path(output).suffix == ".provn" else "json"
        self.download(f"/v1/{of}s/{identity}/provenance?format={form}", output, overwrite=overwrite)

    def rerun(
        self, of: Literal["psf", "product"], identity: str, *, progress: Progress | None = None
    ) -> dict[str, Any]:
        """Make a PSF or a product again; returns the report on the differences."""
        job = self.submit("rerun", of=of, id=identity)
        return self.get(self.wait(job, progress=progress)["result"])


def _given(filters: dict[str, str | None]) -> dict[str, str]:
    return {name: value for name, value in filters.items() if value is not None}
