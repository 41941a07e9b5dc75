"""How the service describes jobs, products, PSFs, reports and transits. The command line uses these models too, so they
import no web framework.
"""

from __future__ import annotations

import time
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field

from psfcore.noise import NoiseFigures
from workers.catalogue.tables import JobRow, ProductRow, PsfRow, ReportRow, TransitRow
from workers.contract.jobs import JobError, Phase, Queue
from workers.contract.kinds import KINDS
from workers.versions import PsfStatus, iso


class RowView(BaseModel):
    """The description of a row of the catalogue, for its owner."""

    @classmethod
    def of_columns(cls, row: object, **computed: object) -> Self:
        """The description whose fields are the columns of the row with the same names, and ``computed``."""
        columns = {name: getattr(row, name) for name in cls.model_fields if hasattr(row, name)}
        return cls.model_validate(columns | computed)


class PastChange(BaseModel):
    """A change that was recorded: when (s since 1970), by whom, and why. It is made from its row in the catalogue."""

    model_config = ConfigDict(from_attributes=True)

    at: float
    by: str
    reason: str


class Progress(RowView):
    """Progress of a job."""

    stage: str
    step: int
    steps: int
    time_left_s: float | None = Field(
        description="estimated time until the last of `steps`, or until the end of a job that counts several times, "
        "s; null: unknown. The estimate uses the speed since the job began to count these steps, or the estimated "
        "time of the job"
    )
    share: float | None = Field(
        None,
        description="share of the estimated time of a job that counts several times, 0 to 1; null: the steps count "
        "the whole job, or the estimated time has passed, or unknown",
    )


class Estimate(BaseModel):
    """The time and memory that a job was expected to need when it was accepted."""

    memory_mib: int
    seconds: float


class JobView(RowView):
    """A job."""

    id: str
    kind: str
    phase: Phase
    queue: Queue
    created_at: float
    started_at: float | None
    ended_at: float | None
    attempt: int
    cancel_requested: bool
    waiting_before: int | None = Field(
        description="number of waiting jobs that are expected to start before this job: the jobs of more urgent "
        "queues, and "
        "jobs of this queue, in which the owners take turns; 1000: 1000 or more; null: the job is not QUEUED. Only the "
        "answers to a submission and to `GET /v1/jobs/{id}` contain this number; in lists and events it is null"
    )
    progress: Progress
    estimate: Estimate | None = Field(
        description="expected time and memory of the job; null: a UWS job that has not been started"
    )
    parameters: dict[str, Any] = Field(
        description="the parameters, with every default and the PSF filled in; for a PENDING job as the client sent "
        "them"
    )
    result: str | None = Field(description="address of the result; null until the job is COMPLETED")
    result_deleted: bool = Field(
        False,
        description="whether the result was deleted; the same request makes the result again. Lists and the answers "
        "to a "
        "submission and to `GET /v1/jobs/{id}` contain the present value; in events it is always false",
    )
    error: JobError | None

    @classmethod
    def of(cls, row: JobRow, waiting_before: int | None = None, *, result_deleted: bool = False) -> JobView:
        """The description of a job, from its row in the catalogue.

        Parameters
        ----------
        waiting_before
            Number of jobs that wait before this job; None if they were not counted.
        result_deleted
            Whether the result of the job was deleted.
        """
        return cls.of_columns(
            row,
            waiting_before=waiting_before,
            progress=Progress.of_columns(row, time_left_s=time_left_s(row), share=share_of_time(row)),
            estimate=row.estimate or None,
            result=f"{KINDS[row.kind].result}/{row.result_id}" if row.result_id else None,
            result_deleted=result_deleted,
        )


def time_left_s(row: JobRow, now: float | None = None) -> float | None:
    """Estimated remaining time of a running job, s; None if unknown.

    If the steps count the whole job, the estimate uses the speed since the job began to count its present steps.
    Earlier work, such as reading the images, does not count. Otherwise it is the rest of the estimated time of the job.

    Parameters
    ----------
    now
        The time in seconds since 1970; default: the time of this machine's clock.
    """
    now = time.time() if now is None else now
    if not KINDS[row.kind].counted_whole:
        share = share_of_time(row, now)
        if share is None or row.estimate is None:
            return None
        return float(row.estimate["seconds"] * (1 - share))
    done = row.step - row.count_step
    if row.phase != Phase.EXECUTING or done <= 0 or row.count_at is None:
        return None
    return max(0.0, (now - row.count_at) * (row.steps - row.step) / done)


def share_of_time(row: JobRow, now: float | None = None) -> float | None:
    """The share of its estimated time that a running job has used; None if its steps count the whole job, if the
    estimate is not known or has passed, or if the stage has no steps.

    Parameters
    ----------
    now
        The time in seconds since 1970; default: the time of this machine's clock.
    """
    if KINDS[row.kind].counted_whole or row.phase != Phase.EXECUTING or row.started_at is None:
        return None
    if not row.estimate or not row.estimate["seconds"] or not row.steps:
        return None
    used_s = (time.time() if now is None else now) - row.started_at
    share = max(used_s / row.estimate["seconds"], 0.0)
    return float(share) if share < 1 else None


class ProductView(RowView):
    """A deconvolved image."""

    id: str = Field(description="identity: hash of image, PSF, method, parameters and algorithm version")
    created_at: float
    kind: str
    image_id: str
    psf_id: str
    psf_version: str
    bytes: int
    sha256: str = Field(description="SHA-256 of the file")
    details: dict[str, object] = Field(
        description="method, parameters, versions, and what the deconvolution changed in the image (`changes`)"
    )
    file: str = Field(description="address of the FITS file")
    preview: str = Field(description="address of a picture: the image before and after, and the change")
    thumbnail: str | None = Field(
        description="address of a small picture of the product; null: the product was made before products had "
        "thumbnails"
    )
    changes: str | None = Field(
        description="address of a picture of all changes; null: the request did not ask for it"
    )

    @classmethod
    def of(cls, row: ProductRow, details: dict[str, object] | None = None) -> ProductView:
        """The description of a product, from its row in the catalogue.

        Parameters
        ----------
        details
            The current details of the product; default: the details in the row.
        """
        here = f"/v1/products/{row.id}"
        return cls.of_columns(
            row,
            sha256=row.file_sha256,
            details=row.details if details is None else details,
            file=f"{here}/file",
            preview=f"{here}/preview",
            thumbnail=f"{here}/thumbnail" if row.details.get("thumbnail_sha256") else None,
            changes=f"{here}/changes" if row.details.get("changes_picture_sha256") else None,
        )


def was_certified(row: PsfRow) -> bool:
    """Whether a PSF is or was certified. An interpolated PSF may be deprecated together with one of its ends, without
    having been certified.
    """
    return row.status == PsfStatus.CERTIFIED or row.valid_from is not None


class PsfView(RowView):
    """A PSF. Its content never changes, because the id depends on the content. Its status may change."""

    id: str
    created_at: float
    name: str
    version: str
    instrument: str | None
    channel: str | None = Field(description="wavelength in whole angstrom; null: unknown")
    kind: str = Field(
        description="`total`, a component's name such as `diffraction`, or `uploaded` if the kind is unknown"
    )
    status: PsfStatus
    was_certified: bool = Field(
        description="whether the PSF is or was certified; if not, it has no range of observation times"
    )
    valid_from: str | None = Field(
        description="start of the range of observation times; null: no lower limit, or never certified"
    )
    valid_to: str | None = Field(description="null: no upper limit, or never certified")
    successor: str | None = Field(description="for a deprecated PSF: id of the PSF to use instead")
    origin: str = Field(
        description="`built`, `fitted` (to a transit), `interpolated` (in time) or `uploaded`"
    )
    bytes: int
    details: dict[str, Any] = Field(description="shape, curve, parameters and provenance")
    file: str = Field(description="address of the FITS file")
    preview: str | None = Field(
        description="address of the picture; null: the PSF was uploaded and has no tables yet"
    )
    report: str | None = Field(description="address of the report on the fit; null: the PSF was not fitted")

    @classmethod
    def of(cls, row: PsfRow) -> PsfView:
        """The description of a PSF, from its row in the catalogue."""
        here = f"/v1/psfs/{row.id}"
        return cls.of_columns(
            row,
            was_certified=was_certified(row),
            valid_from=None if row.valid_from is None else iso(row.valid_from),
            valid_to=None if row.valid_to is None else iso(row.valid_to),
            successor=row.successor_id,
            file=f"{here}/file",
            preview=f"{here}/preview" if row.preview_sha256 else None,
            report=f"{here}/report" if "report_sha256" in row.details else None,
        )


class ReportView(RowView):
    """The report of a job, for example on a transit or a rerun."""

    id: str
    created_at: float
    kind: str
    transit_id: str | None = Field(description="id of the transit; null: the report is not on a transit")
    about_id: str | None = Field(
        description="id of the PSF or product; null: the report is not on a PSF or product"
    )
    bytes: int
    details: dict[str, object] = Field(description="the summary sentence and the main figures")
    file: str = Field(description="address of the whole report as JSON")
    preview: str | None = Field(description="address of the picture; null: the report has none")
    html: str | None = Field(
        description="address of the report as a self-contained HTML page; null: the report has none"
    )
    output: str | None = Field(
        description="address of the FITS file that the rerun made; no list contains this file; null: the report is "
        "not on a rerun"
    )

    @classmethod
    def of(cls, row: ReportRow) -> ReportView:
        """The description of a report, from its row in the catalogue."""
        here = f"/v1/reports/{row.id}"
        return cls.of_columns(
            row,
            file=f"{here}/file",
            preview=f"{here}/preview" if row.preview_sha256 else None,
            html=f"{here}/page" if row.details.get("page_sha256") else None,
            output=f"{here}/output" if row.details.get("output_sha256") else None,
        )


class PointingView(BaseModel):
    """A pointing of a transit."""

    fov: int = Field(description="number of the pointing in transit.json")
    images: int


class FileView(BaseModel):
    """A file of a transit."""

    name: str
    bytes: int = Field(description="unpacked size, as declared in the archive")


class TransitView(RowView):
    """An uploaded transit: properties of its archive, and the content of its transit.json."""

    id: str = Field(description="SHA-256 of the archive")
    created_at: float
    bytes: int
    filename: str | None
    archive: str = Field(description="zip, tar or tar.gz")
    instrument: str | None
    images: int
    pointings: list[PointingView]
    noise: NoiseFigures | None = Field(
        description="noise figures; null: the request for a job must give them"
    )
    known_psf: str | None = Field(
        description="file of the known part of the PSF; null: the diffraction PSF of the instrument"
    )
    unpacked_bytes: int

    @classmethod
    def of(cls, row: TransitRow) -> Self:
        """The description of a transit, from its row in the catalogue."""
        return cls.of_columns(row, **row.summary)


class TransitDetails(TransitView):
    """An uploaded transit, with the files that its transit.json names."""

    files: list[FileView]
