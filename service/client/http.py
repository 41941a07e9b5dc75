"""An HTTP client for scripts: ``with Client("http://127.0.0.1:8765") as client: client.deconvolve("in.fits", "out.fits")``."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

from psfcore.errors import DataError
from psfcore.transit.archive import pack
from service.client.connection import FROM_BYTES, GOES_ON, Connection, upload_in_parts
from service.client.errors import SHOWN_DIGITS, Patience, ServiceError, WaitInterrupted
from service.client.operations import Operations, Progress, without_none

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

QUEUED_S = 10.0  # time in the queue after which a client that waits for a job says so


class Client(Connection, Operations):
    """A heliopsf service, over HTTP.

    Every method raises ``ServiceError`` if its request fails; the ``code`` of the error states the reason, such as
    "no-psf-fits", "path-not-allowed" or "scope-missing". Times are in ISO 8601; a time without a zone is UTC.
    """

    server: str
    jobs_at_once = 4

    # Uploads -----------------------------------------------------------------------------------

    def upload_image(self, path: str | Path) -> dict[str, Any]:
        return self._upload("/v1/images", Path(path))

    def upload_transit(self, path: str | Path) -> dict[str, Any]:
        """Upload a transit: a folder, or an archive of a folder. Returns the description of the transit, with its ``id``.

        A file of 64 MiB or more is sent in parts. If the connection is cut, the upload continues where it was; if this
        process ends before, the next upload of the same file continues it, for a day.
        """
        with _as_archive(Path(path)) as archive:
            if archive.stat().st_size < FROM_BYTES:
                return self._upload("/v1/transits", archive, media_type="application/octet-stream")
            return self.get(upload_in_parts(self._answer, archive, "transit", archive.name, self.say))

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
        described = {
            "name": name,
            "version": version,
            "instrument": instrument,
            "channel": channel,
            "kind": kind,
        }
        return self._upload("/v1/psfs", Path(path), described)

    def image_id(self, path: str | Path, sha256: str) -> str:
        try:
            return str(self.get(f"/v1/images/{sha256}")["id"])
        except ServiceError as error:
            if error.code != "no-such-image":
                raise
            return str(self.upload_image(path)["id"])

    def _upload(
        self,
        address: str,
        path: Path,
        query: dict[str, Any] | None = None,
        *,
        media_type: str = "application/fits",
    ) -> dict[str, Any]:
        with path.open("rb") as file:
            return self._json(
                "POST",
                address,
                params={"filename": path.name} | (query or {}),
                content=iter(lambda: file.read(2**20), b""),
                headers={"Content-Type": media_type, "Content-Length": str(path.stat().st_size)},
            )

    # Jobs --------------------------------------------------------------------------------------

    def submit(self, kind: str, *, queue: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Submit a job; returns its description. If an identical job was submitted before, returns the description of
        that job.

        queue: "bulk" runs the job after all jobs of other queues; default: the queue of its kind.
        """
        return self._job("/v1/jobs", kind, queue=queue, parameters=parameters)

    def estimate(self, kind: str, *, queue: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Estimate a job without starting it. The arguments and the errors are the same as for ``submit``.

        "estimate" has the expected ``seconds`` and ``memory_mib``, "psf" says which PSF a deconvolution would use and why, and
        "existing" is the address of the result if there is one already.
        """
        return self._job("/v1/estimates", kind, queue=queue, parameters=parameters)

    def result_id(self, kind: str, **parameters: Any) -> str:
        return str(self._job("/v1/jobs/identity", kind, parameters=parameters)["result_id"])

    def _job(self, address: str, kind: str, **body: Any) -> dict[str, Any]:
        return self._json("POST", address, json={"kind": kind, **body})

    def job(self, job_id: str) -> dict[str, Any]:
        """The current description of a job."""
        return self.get(f"/v1/jobs/{job_id}")

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
        started, in_queue_said, job_id = time.monotonic(), False, job["id"]
        try:
            while job["phase"] in ("QUEUED", "EXECUTING"):
                waited_s = time.monotonic() - started
                if timeout_s is not None and waited_s > timeout_s:
                    raise TimeoutError(
                        f"job {job['id']} is {job['phase']} after {timeout_s:g} s and continues: wait for it again"
                    )
                if job["phase"] == "QUEUED" and waited_s > QUEUED_S and not in_queue_said:
                    self.say(f"job {job['id'][:SHOWN_DIGITS]} waits in the queue {job['queue']}")
                    in_queue_said = True
                time.sleep(0.1)
                job = Patience(self.say, GOES_ON).repeat(lambda: self.job(job_id))
                now = job["progress"]
                if progress is not None and now["stage"]:
                    share = now["share"]
                    if share is None:
                        progress(now["stage"], now["step"], max(now["steps"], 1))
                    else:
                        progress(now["stage"], round(100 * share), 100)
        except KeyboardInterrupt as stop:
            raise WaitInterrupted("job", job["id"], self.server) from stop
        return self._ended(job)

    def rerun(
        self, of: Literal["psf", "product"], identity: str, *, progress: Progress | None = None
    ) -> dict[str, Any]:
        """Make a PSF or a product again; returns the report on the differences."""
        return self.run("rerun", {"of": of, "id": identity}, progress)

    # Images and products -----------------------------------------------------------------------

    def product(self, product_id: str) -> dict[str, Any]:
        """The description of a product."""
        return self.get(f"/v1/products/{product_id}")

    def products(self, **filters: str) -> Iterator[dict[str, Any]]:
        """All products, newest first."""
        return self._all("/v1/products", filters)

    def delete_product(self, product_id: str) -> None:
        """Delete a product. The same request makes it again."""
        self._answer("DELETE", f"/v1/products/{product_id}")

    def release(self, product: dict[str, Any]) -> None:
        """Do nothing: the service keeps its products."""

    def pixels(
        self,
        of: Literal["image", "product"],
        identity: str,
        plane: Literal["image", "error", "quality"] = "image",
        *,
        x: int = 0,
        y: int = 0,
        width: int | None = None,
        height: int | None = None,
        step: int = 1,
    ) -> NDArray[np.float32]:
        """The pixels [y, x] of an uploaded image or of a plane of a product, in the unit of the file; NaN: no value.

        x, y, width, height: the window, px, counted from 0; default: the whole plane. step: n gives one number for each block of
        n x n px: the mean of its finite pixels, for "quality" the bitwise OR. Raises ``ServiceError`` "window-outside"
        and "no-such-plane".
        """
        import numpy as np  # only a caller of this method needs it

        query = {"plane": plane, "x": x, "y": y, "width": width, "height": height, "step": step}
        answer = self._answer("GET", f"/v1/{of}s/{identity}/pixels", params=query)
        ny, nx = map(int, answer.headers["x-pixels-shape"].split(","))
        return np.frombuffer(answer.content, dtype="<f4").astype(np.float32).reshape(ny, nx)

    def image_header(self, image_id: str) -> list[dict[str, Any]]:
        """The header of each HDU of an uploaded image: ``index``, ``name``, and ``cards`` as [keyword, value, comment]."""
        return self._header(f"/v1/images/{image_id}")

    def product_header(self, product_id: str) -> list[dict[str, Any]]:
        """The header of each HDU of a product, as ``image_header`` gives them."""
        return self._header(f"/v1/products/{product_id}")

    def _header(self, address: str) -> list[dict[str, Any]]:
        hdus: list[dict[str, Any]] = self._answer("GET", f"{address}/header").json()
        return hdus

    def thumbnail(self, product_id: str, output: str | Path, *, overwrite: bool = False) -> None:
        """Write the small picture of a product (PNG, at most 192 px). Raises ``ServiceError`` "no-thumbnail"."""
        self.download(f"/v1/products/{product_id}/thumbnail", output, overwrite=overwrite)

    def lineage(self, of: Literal["psf", "product"], identity: str) -> dict[str, Any]:
        """The images, transits and PSFs from which a PSF or a product was made, back to the uploads."""
        return self.get(f"/v1/{of}s/{identity}/lineage")

    def provenance(
        self, of: Literal["psf", "product"], identity: str, output: str | Path, *, overwrite: bool = False
    ) -> None:
        """Write the lineage of a PSF or a product as W3C PROV: PROV-N if the name of the file ends in .provn, otherwise PROV-JSON."""
        form = "provn" if Path(output).suffix == ".provn" else "json"
        self.download(f"/v1/{of}s/{identity}/provenance?format={form}", output, overwrite=overwrite)

    # PSFs and their versions -------------------------------------------------------------------

    def psf(self, psf_id: str) -> dict[str, Any]:
        """The description of a PSF version."""
        return self.get(f"/v1/psfs/{psf_id}")

    def psfs(self, **filters: str) -> Iterator[dict[str, Any]]:
        """All PSF versions, newest first."""
        return self._all("/v1/psfs", filters)

    def psf_curve(self, psf_id: str, radii: Sequence[float] | None = None) -> dict[str, Any]:
        """Light beyond radii (px) in percent, by component, with errors; without ``radii``, at all radii of the table."""
        return self.answer([psf_id], "curve", {} if radii is None else {"radii": list(radii)})

    def psf_profile(self, psf_id: str) -> dict[str, Any]:
        """Mean weight of the pixels at each radius, for each component."""
        return self.answer([psf_id], "profile", {})

    def psf_encircled(self, psf_id: str, radius: float) -> dict[str, Any]:
        """Light within a radius (px), as a fraction of all light."""
        return self.answer([psf_id], "encircled", {"radius": radius})

    def psf_annulus(self, psf_id: str, inner: float, outer: float) -> dict[str, Any]:
        """Light between two radii (px), as a fraction of all light."""
        return self.answer([psf_id], "annulus", {"inner": inner, "outer": outer})

    def compare_psfs(self, psf_id: str, other_id: str) -> dict[str, Any]:
        """Differences of the curves (percentage points) and sums of two PSFs, the second minus the first."""
        return self.answer([psf_id, other_id], f"compare/{other_id}", {})

    def answer(self, psf_ids: list[str], question: str, query: dict[str, Any]) -> dict[str, Any]:
        """The answer to a query. If tables are missing, for example of an uploaded PSF, they are made first."""
        address = f"/v1/psfs/{psf_ids[0]}/{question}"
        parameters = {
            name: ",".join(f"{number!r}" for number in value) if isinstance(value, list) else value
            for name, value in query.items()
        }
        try:
            return self._json("GET", address, params=parameters)
        except ServiceError as error:
            if error.code != "no-tables":
                raise
        for psf_id in psf_ids:
            self.wait(self.submit("psf-tables", psf_id=psf_id))
        return self._json("GET", address, params=parameters)

    def psf_cutout(self, psf_id: str, size: int, output: str | Path, *, overwrite: bool = False) -> None:
        """Write the central (size, size) px of a PSF as FITS."""
        self.download(f"/v1/psfs/{psf_id}/cutout?size={size}", output, overwrite=overwrite)

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
        change = {"version": version, "valid_from": valid_from, "valid_to": valid_to, **series}
        return self._set_status(psf_id, "certified", supersedes=list(supersedes), reason=reason, **change)

    def deprecate_psf(self, psf_id: str, successor: str | None = None, *, reason: str = "") -> dict[str, Any]:
        """Deprecate a certified PSF, or name the successor of a deprecated PSF. Returns its new status."""
        return self._set_status(psf_id, "deprecated", successor=successor, reason=reason)

    def _set_status(self, psf_id: str, status: str, **change: Any) -> dict[str, Any]:
        return self._json("POST", f"/v1/psfs/{psf_id}/status", json={"status": status, **change})

    def delete_psf(self, psf_id: str) -> dict[str, Any]:
        """Delete a draft that nothing uses. Returns its last description."""
        return self._json("DELETE", f"/v1/psfs/{psf_id}")

    def best_psf(self, **filters: str | None) -> dict[str, Any]:
        """The one PSF that fits ``instrument``, ``channel``, ``kind``, ``version``, ``valid_at``, ``context``, ...

        The description of the PSF is under the key "psf". Raises ``ServiceError`` "no-psf-fits" or "several-psfs-fit".
        """
        return self._json("GET", "/v1/psfs/best", params=filters)

    def psf_for_image(self, image_id: str, **where: str | None) -> dict[str, Any]:
        """The PSF that fits the header of an uploaded image; ``context`` and ``kind`` as for ``best_psf``."""
        return self._json("GET", f"/v1/images/{image_id}/psf", params=where)

    def affected(self, psf_id: str | None = None, *, superseded: bool = False) -> Iterator[dict[str, Any]]:
        """Products made with a PSF. Without ``psf_id``: products made with any deprecated PSF.

        superseded: list only products whose PSF has a successor.
        """
        if psf_id is not None:
            return self._all(f"/v1/psfs/{psf_id}/affected", {})
        return self._all("/v1/affected", {"superseded": superseded})

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
            "before_time": before_time or self.psf(before)["valid_to"],
            "after_time": after_time or self.psf(after)["valid_from"],
        }
        parameters = {"before_psf_id": before, "after_psf_id": after, "time": time, **without_none(times)}
        return self.run("psf-interpolate", parameters, progress)

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
        body = {"context": id_or_name, "reason": reason}
        return self._json("PUT", "/v1/contexts/default", json=body)

    # Bulk runs ---------------------------------------------------------------------------------

    def submit_bulk(self, **request: Any) -> dict[str, Any]:
        """Start a bulk run and return its description. If a bulk run of an identical request is open, return the description of that run.

        request: the arguments below, by their names. images: ids of uploaded images. files: patterns of paths on the machine of the service, or {"glob": pattern,
        "where": conditions on the header}. output: folder on that machine for the products. only: write the products only to
        this folder. layout: names of the products in this folder, for example ``{telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits``.
        fields: ``name``, either ``psf_id`` or ``context`` (id or name), and the fields of
        ``workers.contract.requests.Treatment``, such as ``method={"name": ..., "steps": ...}`` or ``saturation_dn``.
        """
        return self._json("POST", "/v1/bulk", json=_bulk_request(**request))

    def estimate_bulk(self, *, sample: int | None = None, **request: Any) -> dict[str, Any]:
        """Estimate a bulk run without starting it. The other arguments and the errors are those of ``submit_bulk``.

        sample: largest number of images whose headers are examined; default: 200. "images" is the number of images that
        were found, "seconds" the expected time of the run with the present workers, "output_bytes" the expected size of the
        products; "refused" has the examined images that the run would refuse, with the reasons.
        """
        body = _bulk_request(**request)
        return self._json("POST", "/v1/bulk/estimate", json=body, params={"sample": sample})

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

    def retry_bulk(self, bulk_id: str) -> dict[str, Any]:
        """Try the failed images again. Raises ``ServiceError`` "equal-bulk-open" if another bulk run of the same request is open."""
        return self._json("POST", f"/v1/bulk/{bulk_id}/retry")

    def delete_bulk(self, bulk_id: str) -> None:
        """Delete a bulk run that is not LISTING or RUNNING; its products are kept. Raises ``ServiceError`` "wrong-phase"."""
        self._answer("DELETE", f"/v1/bulk/{bulk_id}")

    def bulk_failures(self, bulk_id: str) -> Iterator[dict[str, Any]]:
        """The failed images, with reasons."""
        return self._all(f"/v1/bulk/{bulk_id}/failures", {})

    def bulk_results(
        self, bulk_id: str, *, order: str = "bulk", limit: int | None = None
    ) -> Iterator[dict[str, Any]]:
        """The images that are done, with checksums and changes. ``order="worst"`` puts the highest artefact score first."""
        query = without_none({"order": order, "limit": limit})
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
                    # The number of steps is unknown.
                    progress(f"{ended} of at least {total} images", 0, 1)
                elif progress is not None and total:
                    progress("images", ended, total)
                if bulk["phase"] not in ("LISTING", "RUNNING"):
                    break
        except KeyboardInterrupt as stop:
            raise WaitInterrupted("bulk", bulk_id, self.server) from stop
        return bulk

    # Keys, for a service that requires keys ----------------------------------------------------

    def make_key(
        self,
        scopes: Sequence[str],
        *,
        label: str = "",
        lasts_days: float | None = None,
        owner: str | None = None,
    ) -> dict[str, Any]:
        """Make a key; returns its description. Only this answer contains the whole key, under "key".

        scopes: "read", "submit", "certify", "bulk", "admin"; not more than your own key allows. lasts_days: lifetime, days;
        default: as long as your own key. owner: another owner than your own needs the scope admin.
        """
        body = {"scopes": list(scopes), "label": label, "lasts_days": lasts_days, "owner": owner}
        return self._json("POST", "/v1/keys", json=body)

    def keys(self, owner: str | None = None) -> Iterator[dict[str, Any]]:
        """Your keys without their secrets, newest first. owner: another owner, or "*" for all; needs the scope admin."""
        return self._all("/v1/keys", {"owner": owner})

    def revoke_key(self, key_id: str, *, and_made: bool = False) -> dict[str, Any]:
        """Revoke a key; returns its description. and_made: also revoke all keys that were made with it."""
        return self._json("DELETE", f"/v1/keys/{key_id}", params={"and_made": and_made})


def _bulk_request(
    *,
    images: Sequence[str] = (),
    files: Sequence[str | Mapping[str, Any]] = (),
    output: str | None = None,
    only: bool = False,
    layout: str | None = None,
    **fields: Any,
) -> dict[str, Any]:
    """The body of a request for a bulk run, from the arguments of ``Client.submit_bulk``."""
    fields = without_none(fields)
    own: dict[str, Any] = {name: fields.pop(name) for name in ("name", "psf_id", "context") if name in fields}
    return {
        **own,
        "images": list(images),
        "files": [{"glob": one} if isinstance(one, str) else dict(one) for one in files],
        "parameters": fields,
        "output": None if output is None else {"folder": output, "only": only, "layout": layout},
    }


@contextmanager
def _as_archive(path: Path) -> Iterator[Path]:
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
