"""A client for scripts: ``with Heliopsf("http://127.0.0.1:8765") as sun: sun.deconvolve("in.fits", "out.fits")``."""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

import httpx

from psfcore.errors import DataError
from psfcore.transit.archive import pack

DEFAULT_SERVER = "http://127.0.0.1:8765"
PATIENCE_S = 30.0
Progress = Callable[[str, int, int], None]


class ServiceError(Exception):
    """The service refused a request, a job failed, or no service is there; the message says why."""

    def __init__(self, message: str, *, status: int | None = None, code: str | None = None) -> None:
        super().__init__(message)
        self.status, self.code = status, code


class Operations(ABC):
    """What can be asked of a service, whether it is reached over HTTP or lives in this process."""

    @abstractmethod
    def upload_image(self, path: str | Path) -> dict[str, Any]:
        """Upload a FITS image; returns its description, with its ``id``."""

    @abstractmethod
    def upload_transit(self, path: str | Path) -> dict[str, Any]:
        """Upload a transit, a folder or an archive of one; returns its description, with its ``id``.

        Of a folder what its transit.json names is sent, as the same bytes each time. Raises ``ServiceError``.
        """

    @abstractmethod
    def upload_psf(
        self, path: str | Path, *, name: str | None = None, version: str | None = None
    ) -> dict[str, Any]:
        """Upload a PSF of your own; returns its description, with its ``id``."""

    @abstractmethod
    def submit(self, kind: str, **parameters: Any) -> dict[str, Any]:
        """Ask for a job; returns it as it is then, which is ended where an equal one was done before."""

    @abstractmethod
    def wait(self, job: dict[str, Any], *, progress: Progress | None = None) -> dict[str, Any]:
        """Wait for a job's end; returns it completed. Raises ``ServiceError`` where it ended otherwise."""

    @abstractmethod
    def get(self, address: str) -> dict[str, Any]:
        """The description at an address of the service, as ``/v1/products/...``."""

    @abstractmethod
    def download(self, address: str, path: str | Path) -> None:
        """Write the file at an address of the service to ``path``."""

    @abstractmethod
    def ask(self, psf_id: str, question: str, **query: Any) -> dict[str, Any]:
        """What a PSF's tables say to "curve", "profile", "encircled", "annulus" or "compare/ID".

        Raises ``ServiceError`` with code "no-tables" where they have not been made.
        """

    @abstractmethod
    def psf_cutout(self, psf_id: str, size: int, output: str | Path) -> None:
        """Write the central (size, size) px of a PSF as FITS."""

    def deconvolve(
        self,
        image: str | Path,
        output: str | Path | None = None,
        *,
        psf_id: str | None = None,
        method: str = "richardson-lucy",
        preview: str | Path | None = None,
        progress: Progress | None = None,
        noise: tuple[float, float] | None = None,
        saturation_dn: float | None = None,
        error_draws: int = 0,
        effects: str | Path | None = None,
        **method_parameters: Any,
    ) -> dict[str, Any]:
        """Upload an image, have it deconvolved and download the product; returns its description.

        ``noise``: (DN a detected photon, DN rms of the readout). ``error_draws``: 4 or more add an ERROR plane.
        ``effects``: where to write the picture of difference, ratio and histogram.
        ``method_parameters``: what the method takes, as ``steps=20``, ``stop="discrepancy"``, ``edges="zero"``.
        """
        wanted = {
            "psf_id": psf_id,
            "method": {"name": method, **_given(method_parameters)},
            "saturation_dn": saturation_dn,
            "error_draws": error_draws,
            "effects_picture": effects is not None,
        }
        image_id = self.upload_image(image)["id"]
        job = self.submit("deconvolve", image_id=image_id, **wanted, **_noise(noise))
        product = self.get(self.wait(job, progress=progress)["result"])
        self._fetch(product, output, preview)
        if effects is not None:
            self.download(product["effects"], effects)
        return product

    def build_psf(
        self,
        instrument: str | Path,
        output: str | Path | None = None,
        *,
        size: int = 2048,
        component: str | None = None,
        mask: str | Path | None = None,
        preview: str | Path | None = None,
        progress: Progress | None = None,
    ) -> dict[str, Any]:
        """Have the PSF of an instrument built and download it; returns its description.

        ``instrument`` is the name of a shipped one, or the path of an instrument file (TOML); ``mask`` the FITS
        image that such a file's mount names; ``component`` one part alone, as ``diffraction``.
        """
        wanted: dict[str, Any] = {"size": size, "component": component}
        if isinstance(instrument, Path) or instrument.endswith(".toml"):
            wanted["instrument_file"] = Path(instrument).read_text("utf-8")
        else:
            wanted["instrument"] = instrument
        if mask is not None:
            wanted["mask_id"] = self.upload_image(mask)["id"]
        job = self.submit("psf-build", **wanted)
        psf = self.get(self.wait(job, progress=progress)["result"])
        self._fetch(psf, output, preview)
        return psf

    def fit_psf(
        self,
        transit: str | Path,
        output: str | Path | None = None,
        *,
        report: str | Path | None = None,
        preview: str | Path | None = None,
        progress: Progress | None = None,
        noise: tuple[float, float] | None = None,
        **parameters: Any,
    ) -> dict[str, Any]:
        """Upload a transit (a folder or an archive), have its scatter fitted and download the PSF; its description.

        ``report``, ``preview``: where to write the report (JSON) and the picture. ``noise``: as for ``deconvolve``.
        ``parameters``: what the fit takes, as ``shape="stretched"``, ``as_published=True``.
        """
        transit_id = self.upload_transit(transit)["id"]
        job = self.submit("psf-fit", transit_id=transit_id, **_given(parameters), **_noise(noise))
        psf = self.get(self.wait(job, progress=progress)["result"])
        self._fetch(psf, output, preview)
        if report is not None:
            self.download(psf["report"], report)
        return psf

    def cross_validate(
        self,
        transit: str | Path,
        report: str | Path | None = None,
        *,
        preview: str | Path | None = None,
        progress: Progress | None = None,
        noise: tuple[float, float] | None = None,
        **parameters: Any,
    ) -> dict[str, Any]:
        """Upload a transit, have its fit cross-validated and download the report (JSON); its description.

        ``parameters``: as for ``fit_psf``, and ``scheme="exact"``, ``runs=10``.
        """
        transit_id = self.upload_transit(transit)["id"]
        job = self.submit("cross-validate", transit_id=transit_id, **_given(parameters), **_noise(noise))
        found = self.get(self.wait(job, progress=progress)["result"])
        self._fetch(found, report, preview)
        return found

    def evaluate(
        self,
        transit: str | Path,
        report: str | Path | None = None,
        *,
        page: str | Path | None = None,
        preview: str | Path | None = None,
        progress: Progress | None = None,
        noise: tuple[float, float] | None = None,
        **parameters: Any,
    ) -> dict[str, Any]:
        """Upload a transit, have a report made on it and its PSF, and download that; its description.

        ``report``, ``page``, ``preview``: where to write it as JSON, as HTML, as a picture. ``noise``: as for
        ``deconvolve``. ``parameters``: ``psf_id`` of a PSF to judge instead of fitting one, ``seed``, ``dark_offsets``.
        """
        transit_id = self.upload_transit(transit)["id"]
        job = self.submit("evaluate", transit_id=transit_id, **_given(parameters), **_noise(noise))
        found = self.get(self.wait(job, progress=progress)["result"])
        self._fetch(found, report, preview)
        if page is not None:
            self.download(found["html"], page)
        return found

    def diagnose_gap(
        self,
        transit: str | Path,
        report: str | Path | None = None,
        *,
        page: str | Path | None = None,
        preview: str | Path | None = None,
        progress: Progress | None = None,
        noise: tuple[float, float] | None = None,
        **parameters: Any,
    ) -> dict[str, Any]:
        """Upload a transit, have the gap between it and its model diagnosed and download the report; its description.

        ``report``, ``page``, ``preview``, ``noise``: as for ``evaluate``. ``parameters``: ``psf_id`` of a fitted PSF to
        start from, ``seed``, ``correct``. Where there is an answer, ``details.corrected_psf_id`` names the PSF with it.
        """
        transit_id = self.upload_transit(transit)["id"]
        job = self.submit("gap-diagnose", transit_id=transit_id, **_given(parameters), **_noise(noise))
        found = self.get(self.wait(job, progress=progress)["result"])
        self._fetch(found, report, preview)
        if page is not None:
            self.download(found["html"], page)
        return found

    def psf_curve(self, psf_id: str, radii: Sequence[float] | None = None) -> dict[str, Any]:
        """Light beyond radii (px) in percent by component, with errors; without radii the whole table."""
        return self.answer([psf_id], "curve", {} if radii is None else {"radii": list(radii)})

    def psf_profile(self, psf_id: str) -> dict[str, Any]:
        """Mean weight of a pixel by radius, by component."""
        return self.answer([psf_id], "profile", {})

    def psf_encircled(self, psf_id: str, radius: float) -> dict[str, Any]:
        """Light within a radius (px), as a fraction of all light."""
        return self.answer([psf_id], "encircled", {"radius": radius})

    def psf_annulus(self, psf_id: str, inner: float, outer: float) -> dict[str, Any]:
        """Light between two radii (px), as a fraction of all light."""
        return self.answer([psf_id], "annulus", {"inner": inner, "outer": outer})

    def compare_psfs(self, psf_id: str, other_id: str) -> dict[str, Any]:
        """Differences of two PSFs' curves (points) and totals, the second less the first."""
        return self.answer([psf_id, other_id], f"compare/{other_id}", {})

    def answer(self, psf_ids: list[str], question: str, query: dict[str, Any]) -> dict[str, Any]:
        """The answer; tables that are not there yet, as of a PSF that was uploaded, are made first."""
        try:
            return self.ask(psf_ids[0], question, **query)
        except ServiceError as error:
            if error.code != "no-tables":
                raise
        for psf_id in psf_ids:
            self.wait(self.submit("psf-tables", psf_id=psf_id))
        return self.ask(psf_ids[0], question, **query)

    def _fetch(self, result: dict[str, Any], output: str | Path | None, preview: str | Path | None) -> None:
        if output is not None:
            self.download(result["file"], output)
        if preview is not None:
            self.download(result["preview"], preview)

    @staticmethod
    def _ended(job: dict[str, Any]) -> dict[str, Any]:
        """The job, where it is completed; else what it died of, or that nobody started it."""
        if job["phase"] == "PENDING":
            raise ServiceError(f"job {job['id']} was set up and not started", code="pending")
        if job["phase"] == "ERROR":
            raise ServiceError(job["error"]["message"], code=job["error"]["code"])
        if job["phase"] == "ABORTED":
            raise ServiceError(f"job {job['id']} was cancelled", code="cancelled")
        return job


class Heliopsf(Operations):
    """A heliopsf service, over HTTP."""

    def __init__(self, server: str | None = None, *, transport: httpx.BaseTransport | None = None) -> None:
        self.server = server or os.environ.get("HELIOPSF_SERVER", DEFAULT_SERVER)
        self._http = httpx.Client(base_url=self.server, timeout=60, transport=transport)

    def __enter__(self) -> Heliopsf:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def health(self) -> dict[str, Any]:
        """What ``/healthz`` says."""
        return self._json("GET", "/healthz")

    def wait_until_up(self, timeout_s: float = 60.0) -> None:
        """Wait until a service that was just started answers; ``ServiceError`` where it does not in time."""
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
        """Upload a transit, a folder or an archive of one; returns its description, with its ``id``."""
        with as_archive(Path(path)) as archive:
            return self._upload("/v1/transits", archive, {}, media_type="application/octet-stream")

    def upload_psf(
        self, path: str | Path, *, name: str | None = None, version: str | None = None
    ) -> dict[str, Any]:
        """Upload a PSF of your own; returns its description, with its ``id``."""
        return self._upload("/v1/psfs", Path(path), {"name": name, "version": version})

    def submit(self, kind: str, **parameters: Any) -> dict[str, Any]:
        """Ask for a job; returns it as it is then, which is ended where an equal one was done before."""
        return self._json("POST", "/v1/jobs", json={"kind": kind, "parameters": parameters})

    def job(self, job_id: str) -> dict[str, Any]:
        """A job as it is now."""
        return self._json("GET", f"/v1/jobs/{job_id}")

    def cancel(self, job_id: str) -> dict[str, Any]:
        """Cancel a job."""
        return self._json("DELETE", f"/v1/jobs/{job_id}")

    def wait(
        self, job: dict[str, Any], *, progress: Progress | None = None, timeout_s: float | None = None
    ) -> dict[str, Any]:
        """Wait for a job's end; returns it completed.

        Raises ``ServiceError`` where it failed or was cancelled, ``TimeoutError`` after ``timeout_s``.
        """
        started = time.monotonic()
        while job["phase"] in ("QUEUED", "EXECUTING"):
            if timeout_s is not None and time.monotonic() - started > timeout_s:
                raise TimeoutError(f"job {job['id']} is {job['phase']} after {timeout_s:g} s")
            time.sleep(0.1)
            job = self._job_patiently(job["id"])
            if progress is not None and job["progress"]["steps"]:
                progress(job["progress"]["stage"], job["progress"]["step"], job["progress"]["steps"])
        return self._ended(job)

    def _job_patiently(self, job_id: str) -> dict[str, Any]:
        """The job; a service that is away for a moment (a restart) does not end the wait for it."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                return self.job(job_id)
            except ServiceError as error:
                if error.status not in (None, 502, 503) or time.monotonic() > deadline:
                    raise
                time.sleep(0.5)

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

    def download(self, address: str, path: str | Path) -> None:
        """Download a file of the service; ``path`` is written only once it is whole."""
        target = Path(path)
        partial = target.with_name(target.name + ".part")
        try:
            with self._http.stream("GET", address) as response:
                if response.is_error:
                    response.read()
                    raise _refused(response)
                with partial.open("wb") as file:
                    for chunk in response.iter_bytes():
                        file.write(chunk)
            partial.replace(target)
        except httpx.TransportError as error:
            raise self._unreachable(error) from error
        finally:
            partial.unlink(missing_ok=True)

    def ask(self, psf_id: str, question: str, **query: Any) -> dict[str, Any]:
        """The service's answer to a question about a PSF."""
        told = {
            name: ",".join(f"{number!r}" for number in value) if isinstance(value, list) else value
            for name, value in query.items()
        }
        return self._json("GET", f"/v1/psfs/{psf_id}/{question}", params=told)

    def psf_cutout(self, psf_id: str, size: int, output: str | Path) -> None:
        """Download the central (size, size) px of a PSF."""
        self.download(f"/v1/psfs/{psf_id}/cutout?size={size}", output)

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

    def _json(self, method: str, address: str, **options: Any) -> dict[str, Any]:
        try:
            response = self._http.request(method, address, **options)
        except httpx.TransportError as error:
            raise self._unreachable(error) from error
        if response.is_error:
            raise _refused(response)
        body: dict[str, Any] = response.json()
        return body

    def _unreachable(self, error: httpx.TransportError) -> ServiceError:
        return ServiceError(f"no answer from {self.server} ({error}); `heliopsf serve` starts a service")


@contextmanager
def as_archive(path: Path) -> Iterator[Path]:
    """The archive at ``path``, or one made of the folder there, which is gone afterwards."""
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


def _given(parameters: dict[str, Any]) -> dict[str, Any]:
    """Of a job's parameters those that were given; the service has defaults for the others."""
    return {name: value for name, value in parameters.items() if value is not None}


def _noise(noise: tuple[float, float] | None) -> dict[str, Any]:
    """A job's parameter for (DN a photon, DN rms of the readout), where they are known."""
    return {} if noise is None else {"noise": {"photon_gain_dn": noise[0], "read_noise_dn": noise[1]}}


def percent(value: float | None, digits: int = 1) -> str:
    """A change as people read it; None is a change of nothing."""
    return "n/a (no light)" if value is None else f"{value:+.{digits}f} %"


def _refused(response: httpx.Response) -> ServiceError:
    if response.headers.get("content-type", "").startswith("application/problem+json"):
        problem = response.json()
        code = str(problem["type"]).removeprefix("urn:heliopsf:")
        return ServiceError(problem["detail"], status=response.status_code, code=code)
    return ServiceError(f"the service answered {response.status_code}", status=response.status_code)
