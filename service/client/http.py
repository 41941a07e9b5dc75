"""An HTTP client for scripts: ``with Client("http://127.0.0.1:8765") as client: client.deconvolve("in.fits",
"out.fits")``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, cast

from psfcore.errors import DataError
from psfcore.transit.archive import pack
from service.client.answers import (
    Affected,
    Ancestor,
    AnnulusAnswer,
    AnyAnswer,
    Bulk,
    BulkEstimate,
    BulkFailure,
    BulkLine,
    BulkResult,
    Choice,
    ComparisonAnswer,
    Context,
    ContextLine,
    CurveAnswer,
    DefaultContext,
    EncircledAnswer,
    HduHeader,
    Identified,
    Image,
    Job,
    JobEstimate,
    Json,
    Key,
    MadeKey,
    Product,
    ProfileAnswer,
    Psf,
    PsfStatus,
    Report,
    Series,
    SeriesLine,
    Submitted,
    Transit,
    Uploaded,
)
from service.client.connection import (
    FROM_BYTES,
    GOES_ON,
    Connection,
    Parameters,
    upload_in_parts,
)
from service.client.errors import SHOWN_DIGITS, Patience, ServiceError, WaitInterrupted
from service.client.operations import Operations, Progress, without_none

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

QUEUED_S = 10.0  # time in the queue after which a client that waits for a job says so


class Client(Connection, Operations):
    """A heliopsf service, over HTTP.

    Parameters
    ----------
    server : str, optional
        Address of the service. Default: HELIOPSF_SERVER, else http://127.0.0.1:8765. A service of this machine needs no
        scheme: "localhost:8765".
    key : str, optional
        Access key. Default: HELIOPSF_KEY.
    transport : httpx.BaseTransport, optional
        What sends the requests. Default: the network.
    say : function, optional
        It is called with a sentence during a wait, if the job stays in the queue or the service does not answer.

    Raises
    ------
    ServiceError
        "bad-address", or "bad-key" if the key cannot be sent.

    Notes
    -----
    Every method raises ``ServiceError`` if its request fails; the ``code`` of the error states the reason, such as
    "scope-missing". Each method names the codes that are particular to it. Times are in ISO 8601; a time without a zone
    is UTC. A description is what the service answers: JSON as a dict (docs/http.md).
    """

    server: str
    jobs_at_once = 4

    # Uploads -----------------------------------------------------------------------------------

    def upload_image(self, path: str | Path) -> Image:
        return self._upload(Image, "/v1/images", Path(path))

    def upload_transit(self, path: str | Path) -> Transit:
        """Upload a transit.

        Parameters
        ----------
        path : str or path
            A folder with a transit.json, or an archive of one.

        Returns
        -------
        dict
            The description of the transit, with its ``id``.

        Raises
        ------
        ServiceError
            "no-manifest", "bad-manifest", "missing-file", "not-an-archive", "archive-too-large" or another error of the
            transit.

        Notes
        -----
        From a folder, transit.json and the files that it names are sent. A file of 64 MiB or more is sent in parts. If
        the connection is cut, the upload continues where it was; if this process ends before, the next upload of the
        same file continues it, for a day.
        """
        with _as_archive(Path(path)) as archive:
            if archive.stat().st_size < FROM_BYTES:
                return self._upload(Transit, "/v1/transits", archive, media_type="application/octet-stream")
            return self._json(
                Transit, "GET", upload_in_parts(self._answer, archive, "transit", archive.name, self.say)
            )

    def upload_psf(
        self,
        path: str | Path,
        *,
        name: str | None = None,
        version: str | None = None,
        instrument: str | None = None,
        channel: str | None = None,
        kind: str | None = None,
    ) -> Psf:
        described = {
            "name": name,
            "version": version,
            "instrument": instrument,
            "channel": channel,
            "kind": kind,
        }
        return self._upload(Psf, "/v1/psfs", Path(path), described)

    def image_id(self, path: str | Path, sha256: str) -> str:
        try:
            return str(self.get(f"/v1/images/{sha256}")["id"])
        except ServiceError as error:
            if error.code != "no-such-image":
                raise
            return str(self.upload_image(path)["id"])

    def _upload(
        self,
        kind: type[AnyAnswer],
        address: str,
        path: Path,
        query: Parameters | None = None,
        *,
        media_type: str = "application/fits",
    ) -> AnyAnswer:
        with path.open("rb") as file:
            return self._json(
                kind,
                "POST",
                address,
                params={"filename": path.name, **(query or {})},
                content=iter(lambda: file.read(2**20), b""),
                headers={"Content-Type": media_type, "Content-Length": str(path.stat().st_size)},
            )

    # Jobs --------------------------------------------------------------------------------------

    def submit(self, kind: str, *, queue: str | None = None, **parameters: object) -> Job:
        """Submit a job.

        Parameters
        ----------
        kind : str
            "deconvolve", "psf-build", "psf-fit", "psf-interpolate", "psf-tables", "cross-validate", "report",
            "gap-diagnose" or "rerun".
        queue : {"bulk"}, optional
            "bulk": run the job after all jobs of other queues. Default: the queue of its kind.
        **parameters
            The fields of its request in ``workers.contract.requests``, such as ``image_id``.

        Returns
        -------
        dict
            The description of the job, with its ``id`` and ``phase``. If an identical job was submitted before: of
            that job.

        Raises
        ------
        ServiceError
            "no-such-image" or another missing part, "invalid-request", "too-much-memory" or "too-much-time". For a
            deconvolution also "no-psf-for-instrument", "already-deconvolved", "channel-mismatch" or
            "plate-scale-mismatch".
        """
        return self._job(Job, "/v1/jobs", kind, queue=queue, parameters=parameters)

    def estimate(self, kind: str, *, queue: str | None = None, **parameters: object) -> JobEstimate:
        """Estimate a job without starting it.

        Parameters
        ----------
        kind : str
            Kind of the job, as for ``submit``.
        queue : {"bulk"}, optional
            Queue of the job, as for ``submit``.
        **parameters
            Parameters of the job, as for ``submit``.

        Returns
        -------
        dict
            The estimate, with these values among others:

            - ``estimate``: the expected ``seconds`` and ``memory_mib`` (MiB).
            - ``psf``: which PSF a deconvolution would use, and why.
            - ``existing``: the address of the result; None: there is none yet.

        Raises
        ------
        ServiceError
            The errors of ``submit``.
        """
        return self._job(JobEstimate, "/v1/estimates", kind, queue=queue, parameters=parameters)

    def result_id(self, kind: str, **parameters: object) -> str:
        return self._job(Identified, "/v1/jobs/identity", kind, parameters=parameters)["result_id"]

    def _job(self, answer: type[AnyAnswer], address: str, kind: str, **body: object) -> AnyAnswer:
        return self._json(answer, "POST", address, json={"kind": kind, **body})

    def job(self, job_id: str) -> Job:
        """Get the current description of a job.

        Parameters
        ----------
        job_id : str
            Id of the job.

        Returns
        -------
        dict
            ``phase``, ``progress``, and ``result`` (address) or ``error``, among others.

        Raises
        ------
        ServiceError
            "no-such-job".
        """
        return self._json(Job, "GET", f"/v1/jobs/{job_id}")

    def jobs(self, **filters: str) -> Iterator[Job]:
        """List your jobs, newest first.

        Parameters
        ----------
        **filters
            ``phase``: only jobs in this phase, such as "EXECUTING".

        Returns
        -------
        iterator of dict
            Their descriptions.
        """
        return self._all(Job, "/v1/jobs", filters)

    def cancel(self, job_id: str) -> Job:
        """Cancel a job.

        Parameters
        ----------
        job_id : str
            Id of the job.

        Returns
        -------
        dict
            The description of the job. A job that has ended does not change; an executing job ends at its next step.

        Raises
        ------
        ServiceError
            "no-such-job", or "job-of-bulk" for a part of a bulk run.
        """
        return self._json(Job, "DELETE", f"/v1/jobs/{job_id}")

    def wait(
        self, job: Submitted, *, progress: Progress | None = None, timeout_s: float | None = None
    ) -> Job:
        """Wait until a job is completed.

        Parameters
        ----------
        job : dict
            The description of the job, as ``submit`` returns it.
        progress : function, optional
            It is called with (stage, step, steps).
        timeout_s : float, optional
            Longest wait, s. Default: no limit.

        Returns
        -------
        dict
            The description of the completed job.

        Raises
        ------
        ServiceError
            The code of the job's error if it failed, "cancelled", or "pending" if it was never started.
        TimeoutError
            The job is not completed after ``timeout_s``; it continues.
        WaitInterrupted
            Control-C was pressed; the job continues.

        Notes
        -----
        If the service does not answer, for example while it is restarted, the client tries again for ten minutes.
        """
        started, in_queue_said = time.monotonic(), False
        now = cast("Job", job)  # over HTTP, `submit` returns the whole description
        try:
            while now["phase"] in ("QUEUED", "EXECUTING"):
                waited_s = time.monotonic() - started
                if timeout_s is not None and waited_s > timeout_s:
                    raise TimeoutError(
                        f"job {now['id']} is {now['phase']} after {timeout_s:g} s and continues: wait for it again"
                    )
                if now["phase"] == "QUEUED" and waited_s > QUEUED_S and not in_queue_said:
                    self.say(f"job {now['id'][:SHOWN_DIGITS]} waits in the queue {now['queue']}")
                    in_queue_said = True
                time.sleep(0.1)
                now = Patience(self.say, GOES_ON).repeat(lambda: self.job(job["id"]))
                done = now["progress"]
                if progress is not None and done["stage"]:
                    share = done["share"]
                    if share is None:
                        progress(done["stage"], done["step"], max(done["steps"], 1))
                    else:
                        progress(done["stage"], int(100 * share), 100)
        except KeyboardInterrupt as stop:
            raise WaitInterrupted("job", job["id"], self.server) from stop
        return self._ended(now)

    def rerun(
        self, of: Literal["psf", "product"], identity: str, *, progress: Progress | None = None
    ) -> Report:
        """Make a PSF or a product again and compare it with the first one.

        Parameters
        ----------
        of : {"psf", "product"}
            What to make again.
        identity : str
            Id of the PSF or product.
        progress : function, optional
            It is called with (stage, step, steps).

        Returns
        -------
        dict
            The description of the report on the differences.

        Raises
        ------
        ServiceError
            "no-such-psf", "no-such-product", "not-made-here" for an upload, "parameters-unknown" or
            "parameters-outdated".
        """
        return cast("Report", self.run("rerun", {"of": of, "id": identity}, progress))

    # Images and products -----------------------------------------------------------------------

    def product(self, product_id: str) -> Product:
        """Get the description of a product.

        Parameters
        ----------
        product_id : str
            Id of the product.

        Returns
        -------
        dict
            The description of the product.

        Raises
        ------
        ServiceError
            "no-such-product".
        """
        return self._json(Product, "GET", f"/v1/products/{product_id}")

    def products(self, **filters: str) -> Iterator[Product]:
        """List products, newest first.

        Parameters
        ----------
        **filters
            ``image_id``, ``psf_id``: only products of this image, or with this PSF.

        Returns
        -------
        iterator of dict
            Their descriptions.
        """
        return self._all(Product, "/v1/products", filters)

    def delete_product(self, product_id: str) -> None:
        """Delete a product. The same request makes it again.

        Parameters
        ----------
        product_id : str
            Id of the product.

        Raises
        ------
        ServiceError
            "no-such-product".
        """
        self._answer("DELETE", f"/v1/products/{product_id}")

    def release(self, product: Uploaded) -> None:
        """Do nothing: the service keeps its products.

        Parameters
        ----------
        product : dict
            The description of a product.
        """

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
        """Get the pixels of an uploaded image, or of a plane of a product.

        Parameters
        ----------
        of : {"image", "product"}
            What the id names.
        identity : str
            Id of the image or product.
        plane : {"image", "error", "quality"}, optional
            The plane. An uploaded image has only "image".
        x, y : int, optional
            First column and row of the window, px, counted from 0.
        width, height : int, optional
            Columns and rows of the window, px. Default: up to the last ones.
        step : int, optional
            One number stands for a block of step x step px: the mean of its finite pixels, for "quality" the bitwise
            OR.

        Returns
        -------
        ndarray of float32, shape (ny, nx)
            The values [y, x] in the unit of the file. NaN: no value.

        Raises
        ------
        ServiceError
            "no-such-image", "no-such-product", "no-such-plane" or "window-outside".
        """
        import numpy as np  # only a caller of this method needs it

        query = {"plane": plane, "x": x, "y": y, "width": width, "height": height, "step": step}
        answer = self._answer("GET", f"/v1/{of}s/{identity}/pixels", params=query)
        ny, nx = map(int, answer.headers["x-pixels-shape"].split(","))
        return np.frombuffer(answer.content, dtype="<f4").astype(np.float32).reshape(ny, nx)

    def image_header(self, image_id: str) -> list[HduHeader]:
        """Get the header of each HDU of an uploaded image.

        Parameters
        ----------
        image_id : str
            Id of the image.

        Returns
        -------
        list of dict
            For each HDU ``index``, ``name``, and ``cards`` as [keyword, value, comment].

        Raises
        ------
        ServiceError
            "no-such-image".
        """
        return self._header(f"/v1/images/{image_id}")

    def product_header(self, product_id: str) -> list[HduHeader]:
        """Get the header of each HDU of a product.

        Parameters
        ----------
        product_id : str
            Id of the product.

        Returns
        -------
        list of dict
            As ``image_header`` gives them.

        Raises
        ------
        ServiceError
            "no-such-product".
        """
        return self._header(f"/v1/products/{product_id}")

    def _header(self, address: str) -> list[HduHeader]:
        return self._json(list[HduHeader], "GET", f"{address}/header")

    def thumbnail(self, product_id: str, output: str | Path, *, overwrite: bool = False) -> None:
        """Write the small picture of a product (PNG, at most 192 px).

        Parameters
        ----------
        product_id : str
            Id of the product.
        output : str or path
            Where to write the picture.
        overwrite : bool, optional
            Whether an existing file is replaced.

        Raises
        ------
        ServiceError
            "no-such-product", "no-thumbnail" or "output-exists".
        """
        self.download(f"/v1/products/{product_id}/thumbnail", output, overwrite=overwrite)

    def lineage(self, of: Literal["psf", "product"], identity: str) -> Ancestor:
        """Get the images, transits and PSFs of which a PSF or product was made.

        Parameters
        ----------
        of : {"psf", "product"}
            What the id names.
        identity : str
            Id of the PSF or product.

        Returns
        -------
        dict
            The lineage back to the uploads.

        Raises
        ------
        ServiceError
            "no-such-psf" or "no-such-product".
        """
        return self._json(Ancestor, "GET", f"/v1/{of}s/{identity}/lineage")

    def provenance(
        self, of: Literal["psf", "product"], identity: str, output: str | Path, *, overwrite: bool = False
    ) -> None:
        """Write the lineage of a PSF or product as W3C PROV.

        Parameters
        ----------
        of : {"psf", "product"}
            What the id names.
        identity : str
            Id of the PSF or product.
        output : str or path
            Where to write it. PROV-N if the name ends in .provn, otherwise PROV-JSON.
        overwrite : bool, optional
            Whether an existing file is replaced.

        Raises
        ------
        ServiceError
            "no-such-psf", "no-such-product" or "output-exists".
        """
        form = "provn" if Path(output).suffix == ".provn" else "json"
        self.download(f"/v1/{of}s/{identity}/provenance?format={form}", output, overwrite=overwrite)

    # PSFs and their versions -------------------------------------------------------------------

    def psf(self, psf_id: str) -> Psf:
        """Get the description of a PSF version.

        Parameters
        ----------
        psf_id : str
            Id of the PSF.

        Returns
        -------
        dict
            The description of the PSF.

        Raises
        ------
        ServiceError
            "no-such-psf".
        """
        return self._json(Psf, "GET", f"/v1/psfs/{psf_id}")

    def psfs(self, **filters: str) -> Iterator[Psf]:
        """List PSF versions, newest first.

        Parameters
        ----------
        **filters
            ``instrument``, ``channel``, ``kind``, ``name``, ``version``, ``status``, ``valid_at``, ``context``.

        Returns
        -------
        iterator of dict
            Their descriptions.

        Raises
        ------
        ServiceError
            "no-such-context", or "not-valid-at-any-time" for ``valid_at`` with another ``status`` than "certified".
        """
        return self._all(Psf, "/v1/psfs", filters)

    def psf_curve(self, psf_id: str, radii: Sequence[float] | None = None) -> CurveAnswer:
        """Get the light beyond radii: 1 - encircled energy.

        Parameters
        ----------
        psf_id : str
            Id of the PSF.
        radii : sequence of float, optional
            Radii, px. Default: all radii of the table.

        Returns
        -------
        dict
            ``radii_px``, and by component ``light_beyond_pct`` and, for a fitted PSF, ``sigma_points``, percent.

        Raises
        ------
        ServiceError
            "no-such-psf", "bad-radius" or "radius-beyond-reach".
        """
        return cast(
            "CurveAnswer", self.answer([psf_id], "curve", {} if radii is None else {"radii": list(radii)})
        )

    def psf_profile(self, psf_id: str) -> ProfileAnswer:
        """Get the mean weight of the pixels at each radius.

        Parameters
        ----------
        psf_id : str
            Id of the PSF.

        Returns
        -------
        dict
            ``radius_px``, the number of ``pixels``, and by component ``mean_weight`` (share of the light per pixel)
            and, for a fitted PSF, ``sigma``.

        Raises
        ------
        ServiceError
            "no-such-psf".
        """
        return cast("ProfileAnswer", self.answer([psf_id], "profile", {}))

    def psf_encircled(self, psf_id: str, radius: float) -> EncircledAnswer:
        """Get the light within a radius.

        Parameters
        ----------
        psf_id : str
            Id of the PSF.
        radius : float
            Radius, px.

        Returns
        -------
        dict
            By component ``light_within``, a fraction of all light, and ``sigma``.

        Raises
        ------
        ServiceError
            "no-such-psf", "bad-radius" or "radius-beyond-reach".
        """
        return cast("EncircledAnswer", self.answer([psf_id], "encircled", {"radius": radius}))

    def psf_annulus(self, psf_id: str, inner: float, outer: float) -> AnnulusAnswer:
        """Get the light between two radii.

        Parameters
        ----------
        psf_id : str
            Id of the PSF.
        inner, outer : float
            Radii, px. The light beyond ``inner`` and up to ``outer`` counts.

        Returns
        -------
        dict
            By component ``light``, a fraction of all light, and ``sigma``.

        Raises
        ------
        ServiceError
            "no-such-psf", "bad-annulus", "bad-radius" or "radius-beyond-reach".
        """
        return cast("AnnulusAnswer", self.answer([psf_id], "annulus", {"inner": inner, "outer": outer}))

    def compare_psfs(self, psf_id: str, other_id: str) -> ComparisonAnswer:
        """Compare two PSFs: the second minus the first.

        Parameters
        ----------
        psf_id, other_id : str
            Ids of the PSFs.

        Returns
        -------
        dict
            ``radii_px``, by component ``difference_points`` (of the light beyond each radius, percentage points), and
            ``difference_of_sums``, among others.

        Raises
        ------
        ServiceError
            "no-such-psf" or "plate-scale-mismatch".
        """
        return cast("ComparisonAnswer", self.answer([psf_id, other_id], f"compare/{other_id}", {}))

    def answer(
        self, psf_ids: list[str], question: str, query: Mapping[str, float | list[float]]
    ) -> dict[str, Json]:
        """Get the answer to a question on PSFs. If tables are missing, they are made first.

        Parameters
        ----------
        psf_ids : list of str
            Ids of the PSFs of the question. The first one is that of the address.
        question : str
            Last part of the address, such as "curve".
        query : dict
            Values by their names. A list is sent with commas.

        Returns
        -------
        dict
            The answer.

        Raises
        ------
        ServiceError
            "no-such-psf", and the errors of the question.
        """
        address = f"/v1/psfs/{psf_ids[0]}/{question}"
        parameters = {
            name: ",".join(f"{number!r}" for number in value) if isinstance(value, list) else value
            for name, value in query.items()
        }
        try:
            return self._json(dict[str, Json], "GET", address, params=parameters)
        except ServiceError as error:
            if error.code != "no-tables":
                raise
        for psf_id in psf_ids:
            self.wait(self.submit("psf-tables", psf_id=psf_id))
        return self._json(dict[str, Json], "GET", address, params=parameters)

    def psf_cutout(self, psf_id: str, size: int, output: str | Path, *, overwrite: bool = False) -> None:
        """Write the central part of a PSF (FITS).

        Parameters
        ----------
        psf_id : str
            Id of the PSF.
        size : int
            Width and height, px. The weights are not renormalised.
        output : str or path
            Where to write the part.
        overwrite : bool, optional
            Whether an existing file is replaced.

        Raises
        ------
        ServiceError
            "no-such-psf", "cutout-too-large" or "output-exists".
        """
        self.download(f"/v1/psfs/{psf_id}/cutout?size={size}", output, overwrite=overwrite)

    def psf_status(self, psf_id: str) -> PsfStatus:
        """Get the status of a PSF and its history.

        Parameters
        ----------
        psf_id : str
            Id of the PSF.

        Returns
        -------
        dict
            ``status``, the allowed changes (``may_become``), a free version of its series (``next_version``) and the
            ``history``, among others.

        Raises
        ------
        ServiceError
            "no-such-psf".
        """
        return self._json(PsfStatus, "GET", f"/v1/psfs/{psf_id}/status")

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
    ) -> PsfStatus:
        """Certify a draft, or change the time range of a certified PSF.

        Parameters
        ----------
        psf_id : str
            Id of the PSF.
        version : str, optional
            Its version, such as "1.2.0". A draft needs one.
        valid_from, valid_to : str, optional
            Range of observation times. Default: no limits; for a certified PSF its present range.
        supersedes : sequence of str, optional
            Ids of certified PSFs to deprecate in the same step.
        reason : str, optional
            Why, for the history.
        **series
            ``instrument``, ``channel`` and ``kind`` of an uploaded PSF whose file does not contain them.

        Returns
        -------
        dict
            The new status, as ``psf_status`` gives it.

        Raises
        ------
        ServiceError
            "no-such-psf", "wrong-transition", "version-missing", "bad-version", "version-taken", "empty-range",
            "ranges-overlap", "not-to-supersede", "no-line" if the instrument is unknown, or "line-known" if the PSF
            has another instrument, channel or kind.
        """
        change = {"version": version, "valid_from": valid_from, "valid_to": valid_to, **series}
        return self._set_status(psf_id, "certified", supersedes=list(supersedes), reason=reason, **change)

    def deprecate_psf(self, psf_id: str, successor: str | None = None, *, reason: str = "") -> PsfStatus:
        """Deprecate a certified PSF, or name the successor of a deprecated PSF.

        Parameters
        ----------
        psf_id : str
            Id of the PSF.
        successor : str, optional
            Id of the PSF that replaces it.
        reason : str, optional
            Why, for the history.

        Returns
        -------
        dict
            The new status, as ``psf_status`` gives it.

        Raises
        ------
        ServiceError
            "no-such-psf", "wrong-transition", "no-such-successor" or "successor-named".
        """
        return self._set_status(psf_id, "deprecated", successor=successor, reason=reason)

    def _set_status(self, psf_id: str, status: str, **change: object) -> PsfStatus:
        return self._json(PsfStatus, "POST", f"/v1/psfs/{psf_id}/status", json={"status": status, **change})

    def delete_psf(self, psf_id: str) -> Psf:
        """Delete a draft that nothing uses.

        Parameters
        ----------
        psf_id : str
            Id of the PSF.

        Returns
        -------
        dict
            Its last description.

        Raises
        ------
        ServiceError
            "no-such-psf", "not-a-draft" or "psf-in-use".
        """
        return self._json(Psf, "DELETE", f"/v1/psfs/{psf_id}")

    def best_psf(self, **filters: str | None) -> Choice:
        """Get the one PSF that meets filters.

        Parameters
        ----------
        **filters
            ``instrument``, ``channel``, ``kind``, ``name``, ``version``, ``status``, ``valid_at``, ``context``.
            Without a status and a context, only certified PSFs are searched.

        Returns
        -------
        dict
            The description of the PSF under "psf", and the filters of the search.

        Raises
        ------
        ServiceError
            "no-psf-fits", "several-psfs-fit", "no-such-context" or "not-valid-at-any-time".
        """
        return self._json(Choice, "GET", "/v1/psfs/best", params=filters)

    def psf_for_image(self, image_id: str, **where: str | None) -> Choice:
        """Get the PSF that fits the header of an uploaded image.

        Parameters
        ----------
        image_id : str
            Id of the image.
        **where
            ``context`` as for ``best_psf``; ``kind``, by default "total".

        Returns
        -------
        dict
            The description of the PSF under "psf", and what the header says: ``instrument``, ``channel``, ``valid_at``.

        Raises
        ------
        ServiceError
            "no-such-image", "no-such-context", "no-instrument", "no-date", "no-psf-fits", "several-psfs-fit" or
            "several-variants-fit".
        """
        return self._json(Choice, "GET", f"/v1/images/{image_id}/psf", params=where)

    def affected(self, psf_id: str | None = None, *, superseded: bool = False) -> Iterator[Affected]:
        """List the products that were made with a PSF, or with any deprecated PSF.

        Parameters
        ----------
        psf_id : str, optional
            Id of the PSF. Default: any deprecated PSF.
        superseded : bool, optional
            Without ``psf_id``: only products whose PSF has a successor.

        Returns
        -------
        iterator of dict
            For each product ``product_id``, ``image_id``, the PSF, and ``redo_with``: the id of the PSF that replaces
            it.

        Raises
        ------
        ServiceError
            "no-such-psf".
        """
        if psf_id is not None:
            return self._all(Affected, f"/v1/psfs/{psf_id}/affected", {})
        return self._all(Affected, "/v1/affected", {"superseded": superseded})

    def series(self) -> Iterator[SeriesLine]:
        """List the series of which a PSF was certified, by name.

        Returns
        -------
        iterator of dict
            For each ``series`` (instrument/channel/kind), and whether its PSFs may be ``interpolated``.
        """
        return self._all(SeriesLine, "/v1/series", {})

    def interpolate_series(self, series: str, interpolated: bool = True, *, reason: str = "") -> Series:
        """Say whether the PSFs of a series may be interpolated in time.

        Parameters
        ----------
        series : str
            The series: instrument/channel/kind.
        interpolated : bool, optional
            Whether they may.
        reason : str, optional
            Why, for the history.

        Returns
        -------
        dict
            The series with its ``history``.

        Raises
        ------
        ServiceError
            "no-such-series", or "series-not-total" if the series is one of components.
        """
        body = {"interpolated": interpolated, "reason": reason}
        return self._json(Series, "PUT", f"/v1/series/{series}", json=body)

    def interpolate_psf(
        self,
        before: str,
        after: str,
        time: str,
        *,
        before_time: str | None = None,
        after_time: str | None = None,
        progress: Progress | None = None,
    ) -> Psf:
        """Interpolate between two fitted PSFs in time.

        Parameters
        ----------
        before, after : str
            Ids of the PSFs.
        time : str
            The time of the new PSF.
        before_time : str, optional
            The last time at which the earlier PSF holds. Default: the end of the range for which it is certified.
        after_time : str, optional
            The first time at which the later PSF holds. Default: the start of the range for which it is certified.
        progress : function, optional
            It is called with (stage, step, steps).

        Returns
        -------
        dict
            The description of the new PSF.

        Raises
        ------
        ServiceError
            "no-such-psf", "invalid-request" if the times are not in order, "psf-not-fitted", "shapes-differ" or another
            error of the job.
        """
        times = {
            "before_time": before_time or self.psf(before)["valid_to"],
            "after_time": after_time or self.psf(after)["valid_from"],
        }
        parameters = {"before_psf_id": before, "after_psf_id": after, "time": time, **without_none(times)}
        return cast("Psf", self.run("psf-interpolate", parameters, progress))

    def contexts(self) -> Iterator[ContextLine]:
        """List contexts, newest first.

        Returns
        -------
        iterator of dict
            Their descriptions, without their pins.
        """
        return self._all(ContextLine, "/v1/contexts", {})

    def context(self, id_or_name: str) -> Context:
        """Get a context with its pins.

        Parameters
        ----------
        id_or_name : str
            Id or name of the context.

        Returns
        -------
        dict
            The description of the context. ``pins`` has a PSF for each series and range of observation times.

        Raises
        ------
        ServiceError
            "no-such-context".
        """
        return self._json(Context, "GET", f"/v1/contexts/{id_or_name}")

    def create_context(
        self, name: str, pins: Sequence[Mapping[str, str | None]] | None = None, *, reason: str = ""
    ) -> Context:
        """Create a context: PSFs that are pinned under a name.

        Parameters
        ----------
        name : str
            Any name except "now" and "default".
        pins : sequence of dict, optional
            ``{"psf_id", "valid_from", "valid_to"}`` for each PSF. Default: all PSFs that are certified now.
        reason : str, optional
            Why, for the history.

        Returns
        -------
        dict
            The description of the context, with its pins.

        Raises
        ------
        ServiceError
            "bad-name", "name-taken", "nothing-to-pin", "ranges-overlap", "no-line" or "no-such-psf".
        """
        body = {"name": name, "reason": reason, "pins": None if pins is None else list(pins)}
        return self._json(Context, "POST", "/v1/contexts", json=body)

    def default_context(self) -> DefaultContext:
        """Get the context from which the PSF is chosen if a request names no context.

        Returns
        -------
        dict
            ``context`` (None: the PSFs that are certified at the time of a request), and the ``history`` of its
            changes.
        """
        return self._json(DefaultContext, "GET", "/v1/contexts/default")

    def use_context(self, id_or_name: str | None, *, reason: str = "") -> DefaultContext:
        """Make a context the default.

        Parameters
        ----------
        id_or_name : str or None
            Id or name of the context. None: use the PSFs that are certified at the time of each request.
        reason : str, optional
            Why, for the history.

        Returns
        -------
        dict
            As ``default_context`` gives it.

        Raises
        ------
        ServiceError
            "no-such-context".
        """
        body = {"context": id_or_name, "reason": reason}
        return self._json(DefaultContext, "PUT", "/v1/contexts/default", json=body)

    # Bulk runs ---------------------------------------------------------------------------------

    def submit_bulk(self, **request: Any) -> Bulk:
        """Start a bulk run: many images, deconvolved in the same way.

        Parameters
        ----------
        **request
            Values by these names:

            - ``images``: ids of uploaded images.
            - ``files``: patterns of paths on the machine of the service; instead of a pattern also
              ``{"glob": pattern, "where": conditions on the header}``.
            - ``output``: a folder on that machine for the products.
            - ``only``: whether the products are written only to this folder.
            - ``layout``: names of the products in this folder, for example
              ``{telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits``.
            - ``name``: a name of the run.
            - ``psf_id`` or ``context`` (id or name): the PSF, or the context that pins a PSF for each image.
            - The fields of ``workers.contract.requests.Treatment``, such as ``saturation_dn`` or
              ``method={"name": ..., "steps": ...}``.

        Returns
        -------
        dict
            The description of the run. If a run of an identical request is open: of that run.

        Raises
        ------
        ServiceError
            "no-such-image", "no-such-psf", "no-such-context", "bad-path" or "path-not-allowed".
        """
        return self._json(Bulk, "POST", "/v1/bulk", json=_bulk_request(**request))

    def estimate_bulk(self, *, sample: int | None = None, **request: Any) -> BulkEstimate:
        """Estimate a bulk run without starting it.

        Parameters
        ----------
        sample : int, optional
            Largest number of images whose headers are examined. Default: 200.
        **request
            As for ``submit_bulk``.

        Returns
        -------
        dict
            The estimate, with these values among others:

            - ``images``: the number of images that were found.
            - ``seconds``: the expected time of the run with the present workers, s.
            - ``output_bytes``: the expected size of the products, bytes.
            - ``refused``: examined images that the run would refuse, with the reasons.

        Raises
        ------
        ServiceError
            The errors of ``submit_bulk``.
        """
        body = _bulk_request(**request)
        return self._json(BulkEstimate, "POST", "/v1/bulk/estimate", json=body, params={"sample": sample})

    def bulk(self, bulk_id: str) -> Bulk:
        """Get the current description of a bulk run.

        Parameters
        ----------
        bulk_id : str
            Id of the bulk run.

        Returns
        -------
        dict
            ``phase``, the numbers of ``images`` by state, and ``time_left_s``, among others.

        Raises
        ------
        ServiceError
            "no-such-bulk".
        """
        return self._json(Bulk, "GET", f"/v1/bulk/{bulk_id}")

    def bulks(self, **filters: str) -> Iterator[BulkLine]:
        """List bulk runs, newest first.

        Parameters
        ----------
        **filters
            ``phase``: only bulk runs in this phase, such as "RUNNING".

        Returns
        -------
        iterator of dict
            For each ``id``, ``name``, ``phase`` and the numbers of images, among others.
        """
        return self._all(BulkLine, "/v1/bulk", filters)

    def pause_bulk(self, bulk_id: str) -> Bulk:
        """Pause a bulk run: it starts no more images.

        Parameters
        ----------
        bulk_id : str
            Id of the bulk run.

        Returns
        -------
        dict
            The description of the bulk run.

        Raises
        ------
        ServiceError
            "no-such-bulk", or "wrong-phase" if it is not LISTING or RUNNING.
        """
        return self._json(Bulk, "POST", f"/v1/bulk/{bulk_id}/pause")

    def resume_bulk(self, bulk_id: str) -> Bulk:
        """Resume a paused or failed bulk run.

        Parameters
        ----------
        bulk_id : str
            Id of the bulk run.

        Returns
        -------
        dict
            The description of the bulk run.

        Raises
        ------
        ServiceError
            "no-such-bulk", or "wrong-phase" if it is not PAUSED or ERROR.
        """
        return self._json(Bulk, "POST", f"/v1/bulk/{bulk_id}/resume")

    def cancel_bulk(self, bulk_id: str) -> Bulk:
        """End a bulk run permanently. Products that are done are kept.

        Parameters
        ----------
        bulk_id : str
            Id of the bulk run.

        Returns
        -------
        dict
            The description of the bulk run.

        Raises
        ------
        ServiceError
            "no-such-bulk", or "wrong-phase" if it has ended.
        """
        return self._json(Bulk, "POST", f"/v1/bulk/{bulk_id}/cancel")

    def retry_bulk(self, bulk_id: str) -> Bulk:
        """Try the failed images of a bulk run again.

        Parameters
        ----------
        bulk_id : str
            Id of the bulk run.

        Returns
        -------
        dict
            The description of the bulk run.

        Raises
        ------
        ServiceError
            "no-such-bulk", "wrong-phase" if it was cancelled, or "equal-bulk-open" if another bulk run of the same
            request is open.
        """
        return self._json(Bulk, "POST", f"/v1/bulk/{bulk_id}/retry")

    def delete_bulk(self, bulk_id: str) -> None:
        """Delete a bulk run that is not LISTING or RUNNING; its products are kept.

        Parameters
        ----------
        bulk_id : str
            Id of the bulk run.

        Raises
        ------
        ServiceError
            "no-such-bulk" or "wrong-phase".
        """
        self._answer("DELETE", f"/v1/bulk/{bulk_id}")

    def bulk_failures(self, bulk_id: str) -> Iterator[BulkFailure]:
        """List the failed images of a bulk run.

        Parameters
        ----------
        bulk_id : str
            Id of the bulk run.

        Returns
        -------
        iterator of dict
            For each image its ``source`` and its ``error``, among others, in the order of the run.

        Raises
        ------
        ServiceError
            "no-such-bulk".
        """
        return self._all(BulkFailure, f"/v1/bulk/{bulk_id}/failures", {})

    def bulk_results(
        self, bulk_id: str, *, order: str = "bulk", limit: int | None = None
    ) -> Iterator[BulkResult]:
        """List the images of a bulk run that are done.

        Parameters
        ----------
        bulk_id : str
            Id of the bulk run.
        order : {"bulk", "worst"}, optional
            "bulk": the order of the run. "worst": the highest artefact score first.
        limit : int, optional
            Largest number of images. Default: all.

        Yields
        ------
        dict
            For each image its ``source``, ``product_id``, checksums, changes and artefact ``score``, among others.

        Raises
        ------
        ServiceError
            "no-such-bulk".
        """
        query: Parameters = without_none({"order": order, "limit": limit})
        with self._streamed(f"/v1/bulk/{bulk_id}/results", query) as answer:
            for line in answer.iter_lines():
                yield json.loads(line)

    def write_bulk_manifest(
        self, bulk_id: str, path: str | Path, *, format: str = "ndjson", overwrite: bool = False
    ) -> None:
        """Write the manifest of all products of a bulk run.

        Parameters
        ----------
        bulk_id : str
            Id of the bulk run.
        path : str or path
            Where to write it.
        format : {"ndjson", "csv"}, optional
            JSON lines, or a table.
        overwrite : bool, optional
            Whether an existing file is replaced.

        Raises
        ------
        ServiceError
            "no-such-bulk" or "output-exists".
        """
        self.download(f"/v1/bulk/{bulk_id}/results?format={format}", path, overwrite=overwrite)

    def wait_for_bulk(self, bulk_id: str, *, progress: Progress | None = None) -> Bulk:
        """Wait until a bulk run ends, is paused or has failed.

        Parameters
        ----------
        bulk_id : str
            Id of the bulk run.
        progress : function, optional
            It is called with (text, images that have ended, images). While files are listed, with (text, 0, 1).

        Returns
        -------
        dict
            The description of the bulk run.

        Raises
        ------
        ServiceError
            "no-such-bulk", or the service did not answer for 10 minutes.
        WaitInterrupted
            Control-C was pressed; the bulk run continues.
        """
        try:
            for bulk in cast("Iterator[Bulk]", self.follow(f"/v1/bulk/{bulk_id}")):
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
    ) -> MadeKey:
        """Make a key. Only this answer contains the whole key.

        Parameters
        ----------
        scopes : sequence of str
            "read", "submit", "certify", "bulk", "admin"; not more than your own key allows.
        label : str, optional
            A note for lists.
        lasts_days : float, optional
            Lifetime, days. Default: as long as your own key.
        owner : str, optional
            Owner of the key. Another owner than your own needs the scope admin.

        Returns
        -------
        dict
            The description of the key; the whole key is under "key".

        Raises
        ------
        ServiceError
            "keys-not-used", "scope-missing", "too-many-keys" or "outlives-its-maker".
        """
        body = {"scopes": list(scopes), "label": label, "lasts_days": lasts_days, "owner": owner}
        return self._json(MadeKey, "POST", "/v1/keys", json=body)

    def keys(self, owner: str | None = None) -> Iterator[Key]:
        """List keys without their secrets, newest first.

        Parameters
        ----------
        owner : str, optional
            Another owner, or "*" for all; needs the scope admin. Default: your own keys.

        Returns
        -------
        iterator of dict
            Their descriptions.

        Raises
        ------
        ServiceError
            "keys-not-used" or "scope-missing".
        """
        return self._all(Key, "/v1/keys", {"owner": owner})

    def revoke_key(self, key_id: str, *, and_made: bool = False) -> Key:
        """Revoke a key.

        Parameters
        ----------
        key_id : str
            Id of the key: the part after ``hpsf_``.
        and_made : bool, optional
            Whether all keys that were made with it are also revoked.

        Returns
        -------
        dict
            The description of the key.

        Raises
        ------
        ServiceError
            "no-such-key", "keys-not-used" or "scope-missing".
        """
        return self._json(Key, "DELETE", f"/v1/keys/{key_id}", params={"and_made": and_made})


def _bulk_request(
    *,
    images: Sequence[str] = (),
    files: Sequence[str | Mapping[str, object]] = (),
    output: str | None = None,
    only: bool = False,
    layout: str | None = None,
    **fields: object,
) -> dict[str, object]:
    """The body of a request for a bulk run, from the arguments of ``Client.submit_bulk``."""
    fields = without_none(fields)
    own: dict[str, object] = {
        name: fields.pop(name) for name in ("name", "psf_id", "context") if name in fields
    }
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
