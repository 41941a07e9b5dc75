"""What can be asked of a service, told from a few operations that differ between one over HTTP and one in this process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from service.client.errors import ServiceError
from service.client.versions import Progress


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
        self,
        path: str | Path,
        *,
        name: str | None = None,
        version: str | None = None,
        instrument: str | None = None,
        channel: str | None = None,
        kind: str | None = None,
    ) -> dict[str, Any]:
        """Upload a PSF of your own; returns its description, with its ``id``.

        ``instrument``, ``channel``, ``kind``: what its file does not say; ``kind="total"`` is a whole PSF.
        """

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

        ``noise``: (DN a detected photon, DN rms of the readout). ``error_draws``: 2 or more add an ERROR plane, and need ``noise``.
        ``effects``: where to write the picture of difference, ratio and histogram.
        ``method_parameters``: what the method takes, as ``steps=20``, ``stop="discrepancy"``, ``edges="zero"``.
        """
        wanted = {
            "psf_id": psf_id,
            "method": {"name": method, **_given(method_parameters)},
            "saturation_dn": saturation_dn,
            "error_draws": error_draws,
            "changes_picture": effects is not None,
        }
        image_id = self.upload_image(image)["id"]
        job = self.submit("deconvolve", image_id=image_id, **wanted, **_noise(noise))
        product = self.get(self.wait(job, progress=progress)["result"])
        self._fetch(product, output, preview)
        if effects is not None:
            self.download(product["changes"], effects)
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
        psf = self._on_transit("psf-fit", transit, progress, noise, parameters)
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
        found = self._on_transit("cross-validate", transit, progress, noise, parameters)
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
        found = self._on_transit("report", transit, progress, noise, parameters)
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
        found = self._on_transit("gap-diagnose", transit, progress, noise, parameters)
        self._fetch(found, report, preview)
        if page is not None:
            self.download(found["html"], page)
        return found

    def _on_transit(
        self,
        kind: str,
        transit: str | Path,
        progress: Progress | None,
        noise: tuple[float, float] | None,
        parameters: dict[str, Any],
    ) -> dict[str, Any]:
        """Upload a transit and have a job of this kind done on it; the description of what it made."""
        transit_id = self.upload_transit(transit)["id"]
        job = self.submit(kind, transit_id=transit_id, **_given(parameters), **_noise(noise))
        return self.get(self.wait(job, progress=progress)["result"])

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


def _given(parameters: dict[str, Any]) -> dict[str, Any]:
    """Of a job's parameters those that were given; the service has defaults for the others."""
    return {name: value for name, value in parameters.items() if value is not None}


def _noise(noise: tuple[float, float] | None) -> dict[str, Any]:
    """A job's parameter for (DN a photon, DN rms of the readout), where they are known."""
    return {} if noise is None else {"noise": {"photon_gain_dn": noise[0], "read_noise_dn": noise[1]}}
