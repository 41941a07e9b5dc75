"""Bulk: many images deconvolved alike, as it is asked for and as it goes on.

LISTING --> RUNNING --> COMPLETED        retry: COMPLETED --> RUNNING, with the images that failed
   |  ^      |  ^
   v  |      v  |                        cancel: any but COMPLETED and CANCELLED --> CANCELLED
  PAUSED or ERROR                        pause, resume: there and back
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from psfcore.noise_figures import NoiseFigures
from workers.contract.methods import Method, RichardsonLucy
from workers.contract.requests import Identity

MOST_UPLOADED = 100_000
MOST_SETS = 100
MOST_CONDITIONS = 16
TEXT = r"^[^\x00-\x1f\x7f]+$"


class BulkPhase(StrEnum):
    """Phases of a bulk."""

    LISTING = "LISTING"  # its files are being looked for
    RUNNING = "RUNNING"
    PAUSED = "PAUSED"
    COMPLETED = "COMPLETED"  # every image is done, or failed
    CANCELLED = "CANCELLED"
    ERROR = "ERROR"  # it could not go on, for a reason that no single image has


AT_WORK = frozenset({BulkPhase.LISTING, BulkPhase.RUNNING})
STOPPED = frozenset({BulkPhase.PAUSED, BulkPhase.ERROR})
OPEN = AT_WORK | STOPPED  # an equal request shares these
BULK_ENDED = frozenset({BulkPhase.COMPLETED, BulkPhase.CANCELLED})


class ItemState(StrEnum):
    """How far one image of a bulk is."""

    WAITING = "waiting"
    TAKEN = "taken"
    DONE = "done"
    FAILED = "failed"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


Keyword = Annotated[str, StringConstraints(pattern=r"^[A-Z0-9_-]{1,8}$")]
Number = Annotated[int | float, Field(allow_inf_nan=False)]
Word = Annotated[str, StringConstraints(max_length=80)]
Value = bool | Number | Word
Comparison = Literal["<", "<=", ">", ">=", "!="]
Condition = (
    Value
    | Annotated[list[Value], Field(min_length=1, max_length=100)]
    | Annotated[dict[Comparison, Number | Word], Field(min_length=1)]
)
Where = Annotated[dict[Keyword, Condition], Field(max_length=MOST_CONDITIONS)]


class FileSet(_Strict):
    """Files below a folder that the operator allows."""

    glob: str = Field(
        min_length=2,
        max_length=1000,
        pattern=TEXT,
        description="an absolute path; * ? [ab] stand for parts of a name, ** for any folders between",
    )
    where: Where = Field(
        default_factory=dict,
        description='what the header must say: {"INSTRUME": "EUI", "WAVELNTH": [171, 174], "XPOSURE": {">=": 1}}',
    )


class Output(_Strict):
    """Where products are written as files too."""

    folder: str = Field(
        min_length=2,
        max_length=1000,
        pattern=TEXT,
        description="absolute, below a folder that the operator allows; made where it is not there",
    )
    only: bool = Field(False, description="there alone: the service keeps no product")


class Treatment(_Strict):
    """How each image is deconvolved."""

    method: Method = Field(default_factory=lambda: RichardsonLucy())
    noise: NoiseFigures | None = Field(
        None, description="of the images' gain mode; none: the instrument's, if known"
    )
    saturation_dn: float | None = Field(
        None, gt=0, allow_inf_nan=False, description="DN of one exposure; none: the instrument's, if known"
    )
    error_draws: int = Field(0, ge=0, le=64, description="noise draws for an ERROR plane (4 or more)")


class BulkWork(_Strict):
    """What is asked of a bulk, but for the uploads, which are images of it from the start."""

    name: str = Field("", max_length=80, pattern=r"^[^\x00-\x1f\x7f]*$", description="a label for people")
    files: list[FileSet] = Field(default_factory=list, max_length=MOST_SETS)
    psf_id: Identity | None = Field(None, description="a PSF of the catalogue")
    context: str | None = Field(
        None,
        min_length=1,
        max_length=64,
        description="or the set to find each image's PSF in: its id or name",
    )
    parameters: Treatment = Field(default_factory=lambda: Treatment())
    output: Output | None = None

    @property
    def keeps_products(self) -> bool:
        """Whether the service keeps what it makes, in its store."""
        return self.output is None or not self.output.only


class BulkRequest(BulkWork):
    """Many images to be deconvolved with one PSF, or each with the PSF that a context pins for it."""

    images: list[Identity] = Field(
        default_factory=list, max_length=MOST_UPLOADED, description="ids that uploads of images answered"
    )

    @model_validator(mode="after")
    def _something_with_one_psf(self) -> BulkRequest:
        if not self.images and not self.files:
            raise ValueError("expected images or files; got neither")
        if (self.psf_id is None) == (self.context is None):
            raise ValueError(
                "expected one of psf_id and context: what a bulk is made with is fixed when it begins"
            )
        return self
