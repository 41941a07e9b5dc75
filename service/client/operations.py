"""The requests to a service. The requests use a few abstract operations, which the HTTP client and the service in
this process implement.

A method that writes files first checks these files, and then sends its request
(``service.client.outputs.check_outputs``). An existing file is replaced only with ``overwrite=True``, and only when
the new file is complete.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from service.client.answers import Ended, Job, Json, Product, Psf, Report, Submitted, Uploaded
from service.client.errors import ServiceError
from service.client.outputs import Name, check_outputs
from workers.contract.requests import Deconvolve

Progress = Callable[[str, int, int], None]  # called with the stage, the step, and the number of steps
Value = TypeVar("Value")


class Operations(ABC):
    """The requests to a service, over HTTP or in this process. Every method raises ``ServiceError``.

    Attributes
    ----------
    server
        Address of the service; None: this process.
    jobs_at_once
        Number of jobs that ``service.client.many`` has in flight.
    """

    server: str | None = None
    jobs_at_once = 1  # in this process, a job runs when ``wait`` is called

    @abstractmethod
    def upload_image(self, path: str | Path) -> Uploaded:
        """Upload a FITS image.

        Parameters
        ----------
        path : str or path
            The file.

        Returns
        -------
        dict
            The description of the image, with its ``id``.

        Raises
        ------
        ServiceError
            "empty-upload", "not-fits" or another error of the file.
        """

    @abstractmethod
    def upload_transit(self, path: str | Path) -> Uploaded:
        """Upload a transit: a folder, or an archive of a folder. Returns the description of the transit, with its
        ``id``.

        From a folder, transit.json and the files that it names are sent. The same folder always gives the same bytes.
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
    ) -> Uploaded:
        """Upload a PSF.

        Parameters
        ----------
        path : str or path
            The FITS file.
        name, version : str, optional
            Name and version of the PSF. Default: those in the file, else the name of the file and a version with its
            hash.
        instrument, channel : str, optional
            Needed if the file does not contain them.
        kind : str, optional
            "total": the whole PSF. Default: "uploaded"; such a PSF is used only if a request names it.

        Returns
        -------
        dict
            The description of the PSF, with its ``id``.

        Raises
        ------
        ServiceError
            "psf-not-centred", "psf-sum" or another error of the file.
        """

    @abstractmethod
    def submit(self, kind: str, **parameters: Any) -> Submitted:
        """Submit a job; returns its description. If an identical job was submitted before, returns the description of
        that job.
        """

    @abstractmethod
    def result_id(self, kind: str, **parameters: object) -> str:
        """Get the id that the result of a job has or would have, without starting the job.

        Parameters
        ----------
        kind : str
            Kind of the job, as for ``submit``.
        **parameters
            Parameters of the job, as for ``submit``.

        Returns
        -------
        str
            The id. Equal requests have equal ids, except those of the kind "rerun".

        Raises
        ------
        ServiceError
            The errors of ``submit``.
        """

    @abstractmethod
    def image_id(self, path: str | Path, sha256: str) -> str:
        """Get the id of an image; upload the image if the service does not have it.

        Parameters
        ----------
        path : str or path
            The FITS file.
        sha256 : str
            SHA-256 of the file, 64 hexadecimal digits.

        Returns
        -------
        str
            The id of the image.

        Raises
        ------
        ServiceError
            The errors of ``upload_image``.
        """

    @abstractmethod
    def release(self, product: Uploaded) -> None:
        """Delete the files of a downloaded product if the service runs in this process; over HTTP, keep them."""

    @abstractmethod
    def wait(self, job: Submitted, *, progress: Progress | None = None) -> Ended:
        """Wait until a job is completed; returns its description. Raises ``ServiceError`` if the job fails or is
        cancelled.
        """

    @abstractmethod
    def get(self, address: str) -> dict[str, Json]:
        """The description at an address of the service, such as ``/v1/products/...``."""

    @abstractmethod
    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the file at an address of the service to ``path``; an existing file only if ``overwrite`` is true."""

    def deconvolve(
        self,
        image: str | Path,
        output: str | Path | None = None,
        *,
        preview: str | Path | None = None,
        changes: str | Path | None = None,
        progress: Progress | None = None,
        overwrite: bool = False,
        **parameters: object,
    ) -> Product:
        """Upload an image, deconvolve it and download the product.

        Parameters
        ----------
        image : str or path
            The FITS file.
        output : str or path, optional
            Where to write the product (FITS). Default: it is not downloaded.
        preview : str or path, optional
            Where to write the picture of the image before and after (PNG).
        changes : str or path, optional
            Where to write the picture of difference, ratio and histograms (PNG).
        progress : function, optional
            It is called with (stage, step, steps).
        overwrite : bool, optional
            Whether existing files are replaced.
        **parameters
            Values by these names:

            - ``method``: name of the method. Default: "richardson-lucy".
            - The parameters of the method, such as ``steps=20``, ``stop="discrepancy"`` or ``edges="zero"``.
            - ``noise``: photon gain (DN per photon) and read noise (DN rms).
            - The other fields of ``workers.contract.requests.Deconvolve``, such as ``psf_id``, ``error_draws`` or
              ``region``.

        Returns
        -------
        dict
            The description of the product. ``details["warnings"]`` says what may be wrong with it.

        Raises
        ------
        ServiceError
            "output-exists", "output-is-input", "outputs-equal" or "output-not-writable" before the upload; the errors
            of ``upload_image`` and ``submit``; and that of the job if it fails.
        """
        check_outputs((output, preview, changes), inputs=(image,), overwrite=overwrite)
        image_id = self.upload_image(image)["id"]
        request = deconvolution(image_id, changes_picture=changes is not None, **parameters)
        files = {"file": output, "preview": preview, "changes": changes}
        return cast("Product", self._download_result("deconvolve", request, files, progress, overwrite))

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
        overwrite: bool = False,
    ) -> Psf:
        """Build the PSF of an instrument and download it.

        Parameters
        ----------
        instrument : str or path
            The name of a known instrument, or the path of an instrument file (TOML).
        output : str or path, optional
            Where to write the PSF (FITS). Default: it is not downloaded.
        size : int, optional
            Width and height, px: an even number from 64 to 4096.
        component : str, optional
            Build only this component, such as "diffraction".
        mask : str or path, optional
            The mask image (FITS), if the mount in the instrument file names one.
        preview : str or path, optional
            Where to write the picture of the PSF (PNG).
        progress : function, optional
            It is called with (stage, step, steps).
        overwrite : bool, optional
            Whether existing files are replaced.

        Returns
        -------
        dict
            The description of the PSF.

        Raises
        ------
        ServiceError
            "unknown-instrument" or "bad-instrument-file", and the errors of the files as for ``deconvolve``.
        """
        named = named_instrument(instrument)
        file = instrument if "instrument_file" in named else None
        check_outputs((output, preview), inputs=(file, mask), overwrite=overwrite)
        request: dict[str, object] = {"size": size, "component": component, **named}
        if mask is not None:
            request["mask_id"] = self.upload_image(mask)["id"]
        files = {"file": output, "preview": preview}
        return cast("Psf", self._download_result("psf-build", request, files, progress, overwrite))

    def psf_of_instrument(self, instrument: str) -> str:
        """Get the id of the PSF of an instrument, which is built if it does not exist.

        Parameters
        ----------
        instrument : str
            As for ``build_psf``.

        Returns
        -------
        str
            The id of the PSF.

        Raises
        ------
        ServiceError
            The errors of ``build_psf``.
        """
        return str(self.build_psf(instrument)["id"])

    def fit_psf(
        self,
        transit: str | Path,
        output: str | Path | None = None,
        *,
        report: str | Path | None = None,
        preview: str | Path | None = None,
        **options: Any,
    ) -> Psf:
        """Upload a transit, fit its scatter kernel and download the PSF.

        Parameters
        ----------
        transit : str or path
            A folder or an archive, as for ``upload_transit``.
        output : str or path, optional
            Where to write the PSF (FITS). Default: it is not downloaded.
        report : str or path, optional
            Where to write the report (JSON).
        preview : str or path, optional
            Where to write the plot (PNG).
        **options
            Values by these names:

            - ``progress``, ``overwrite``, ``noise``: as for ``deconvolve``.
            - The fields of ``workers.contract.requests.PsfFit``, such as ``shape="stretched"`` or
              ``as_published=True``.

        Returns
        -------
        dict
            The description of the PSF.

        Raises
        ------
        ServiceError
            The errors of ``upload_transit`` and ``submit``, of the files as for ``deconvolve``, and of the fit.
        """
        files = {"file": output, "report": report, "preview": preview}
        return cast("Psf", self._on_transit("psf-fit", transit, files, **options))

    def cross_validate(
        self,
        transit: str | Path,
        report: str | Path | None = None,
        *,
        preview: str | Path | None = None,
        **options: Any,
    ) -> Report:
        """Upload a transit, cross-validate its fit and download the report.

        Parameters
        ----------
        transit : str or path
            A folder or an archive, as for ``upload_transit``.
        report : str or path, optional
            Where to write the report (JSON). Default: it is not downloaded.
        preview : str or path, optional
            Where to write the plot (PNG).
        **options
            Values by these names:

            - ``progress``, ``overwrite``, ``noise``: as for ``deconvolve``.
            - The fields of ``workers.contract.requests.CrossValidate``, such as ``scheme="exact"`` or ``runs=10``.

        Returns
        -------
        dict
            The description of the report.

        Raises
        ------
        ServiceError
            As for ``fit_psf``.
        """
        return cast(
            "Report",
            self._on_transit("cross-validate", transit, {"file": report, "preview": preview}, **options),
        )

    def report(
        self,
        transit: str | Path,
        report: str | Path | None = None,
        *,
        page: str | Path | None = None,
        preview: str | Path | None = None,
        **options: Any,
    ) -> Report:
        """Upload a transit, make a report on its PSF and download the report.

        Parameters
        ----------
        transit : str or path
            A folder or an archive, as for ``upload_transit``.
        report : str or path, optional
            Where to write the report (JSON). Default: it is not downloaded.
        page : str or path, optional
            Where to write the report as a page (HTML).
        preview : str or path, optional
            Where to write its plot (PNG).
        **options
            Values by these names:

            - ``progress``, ``overwrite``, ``noise``: as for ``deconvolve``.
            - ``psf_id``: a PSF to evaluate. Default: fit a PSF to the transit.
            - The other fields of ``workers.contract.requests.Report``: ``saturation_dn``, ``seed``, ``dark_offsets``,
              ``shapes``.

        Returns
        -------
        dict
            The description of the report.

        Raises
        ------
        ServiceError
            As for ``fit_psf``.
        """
        files = {"file": report, "preview": preview, "html": page}
        return cast("Report", self._on_transit("report", transit, files, **options))

    def diagnose_gap(
        self,
        transit: str | Path,
        report: str | Path | None = None,
        *,
        page: str | Path | None = None,
        preview: str | Path | None = None,
        **options: Any,
    ) -> Report:
        """Upload a transit, diagnose the gap between it and the fitted model, download the report.

        Parameters
        ----------
        transit : str or path
            A folder or an archive, as for ``upload_transit``.
        report : str or path, optional
            Where to write the report (JSON). Default: it is not downloaded.
        page : str or path, optional
            Where to write the report as a page (HTML).
        preview : str or path, optional
            Where to write its plot (PNG).
        **options
            Values by these names:

            - ``progress``, ``overwrite``, ``noise``: as for ``deconvolve``.
            - ``psf_id``: a fitted PSF, from which the fit starts.
            - ``coverage``: the probability of the alternatives of each cause together.
            - ``correct``: whether a corrected PSF is made, if an effect is found.
            - ``saturation_dn``, ``seed``: the other fields of ``workers.contract.requests.GapDiagnose``.

        Returns
        -------
        dict
            The description of the report. If there is a corrected PSF, ``details["corrected_psf_id"]`` is its id.

        Raises
        ------
        ServiceError
            As for ``fit_psf``.
        """
        files = {"file": report, "preview": preview, "html": page}
        return cast("Report", self._on_transit("gap-diagnose", transit, files, **options))

    def _on_transit(
        self,
        kind: str,
        transit: Name,
        files: dict[str, Name | None],
        *,
        progress: Progress | None = None,
        noise: tuple[float, float] | None = None,
        overwrite: bool = False,
        **parameters: object,
    ) -> dict[str, Json]:
        """Run a job of this kind on a transit, and download files of its result; returns the description of the
        result.
        """
        check_outputs(files.values(), inputs=(transit,), overwrite=overwrite)
        transit_id = self.upload_transit(transit)["id"]
        request = {"transit_id": transit_id, **without_none(parameters), **_noise(noise)}
        return self._download_result(kind, request, files, progress, overwrite)

    def _download_result(
        self,
        kind: str,
        request: dict[str, object],
        files: dict[str, Name | None],
        progress: Progress | None,
        overwrite: bool,
    ) -> dict[str, Json]:
        """Run a job and download files of its result; returns the description of the result.

        Parameters
        ----------
        files
            The file to write for each name of an address in the description; None: this file is not downloaded.
        """
        result = self.run(kind, request, progress)
        for name, path in files.items():
            if path is not None:
                self.download(str(result[name]), path, overwrite=overwrite)
        return result

    def run(self, kind: str, parameters: Mapping[str, object], progress: Progress | None) -> dict[str, Json]:
        """Run a job and wait for its result.

        Parameters
        ----------
        kind : str
            Kind of the job, as for ``submit``.
        parameters : dict
            Parameters of the job.
        progress : function or None
            It is called with (stage, step, steps).

        Returns
        -------
        dict
            The description of the result.

        Raises
        ------
        ServiceError
            The errors of ``submit`` and ``wait``.
        """
        job = self.submit(kind, **parameters)
        return self.result_of(job, self.wait(job, progress=progress))

    def result_of(self, job: Submitted, ended: Ended) -> dict[str, Json]:
        """Get the result of a job that has ended.

        Parameters
        ----------
        job : dict
            The job, as ``submit`` returns it.
        ended : dict
            The same job, as ``wait`` returns it.

        Returns
        -------
        dict
            The description of the result.

        Raises
        ------
        ServiceError
            "no-result" if the job ended without a result.
        """
        if ended["result"] is None:
            raise ServiceError(
                f"expected the address of the result of job {job['id']}; it ended without a result: submit it again",
                code="no-result",
            )
        return self.get(ended["result"])

    @staticmethod
    def _ended(job: Job) -> Job:
        """The job, if it is completed. Raises ``ServiceError`` if it failed, was cancelled or was never started."""
        if job["phase"] == "PENDING":
            raise ServiceError(
                f"job {job['id']} was created but not started: start it with PHASE=RUN at /uws/jobs/{job['id']}/phase",
                code="pending",
            )
        if job["phase"] == "ERROR" and (fault := job["error"]) is not None:
            raise ServiceError(fault["message"], code=fault["code"])
        if job["phase"] == "ABORTED":
            raise ServiceError(
                f"job {job['id']} was cancelled: submit it again if you need its result", code="cancelled"
            )
        return job


def deconvolution(image_id: str, **parameters: object) -> dict[str, object]:
    """The parameters of a request to deconvolve an uploaded image, from the arguments of ``Operations.deconvolve``."""
    return {"image_id": image_id, **treatment(**parameters)}


def treatment(
    *, method: object = "richardson-lucy", noise: object = None, **parameters: object
) -> dict[str, object]:
    """The fields of a request to deconvolve, from the arguments of ``Operations.deconvolve``."""
    parameters = without_none(parameters)
    fields = {name: value for name, value in parameters.items() if name in Deconvolve.model_fields}
    of_method = {name: value for name, value in parameters.items() if name not in fields}
    return {"method": {"name": method, **of_method}, **fields, **_noise(noise)}


def named_instrument(instrument: str | Path) -> dict[str, str]:
    """The field of a request to build a PSF that names the instrument, or contains its file."""
    if isinstance(instrument, Path) or instrument.endswith(".toml"):
        return {"instrument_file": Path(instrument).read_text("utf-8")}
    return {"instrument": instrument}


def without_none(parameters: Mapping[str, Value | None]) -> dict[str, Value]:
    """The parameters that are not None. The service has defaults for the others."""
    return {name: value for name, value in parameters.items() if value is not None}


def _noise(noise: object) -> dict[str, object]:
    """The parameter of a job for photon gain (DN per photon) and read noise (DN rms), if given."""
    if not noise:
        return {}
    gain, read = cast("tuple[float, float]", noise)
    return {"noise": {"photon_gain_dn": gain, "read_noise_dn": read}}
