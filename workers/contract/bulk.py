"""Bulk runs: many images deconvolved in the same way. Requests and phases.

LISTING --> RUNNING --> COMPLETED        retry: COMPLETED --> RUNNING, for the failed images
   |  ^      |  ^
   v  |      v  |                        cancel: any phase except COMPLETED and CANCELLED --> CANCELLED
  PAUSED or ERROR                        pause and resume
                                         delete: any phase except LISTING and RUNNING
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    FailFast,
    Field,
    StringConstraints,
    field_validator,
    model_validator,
)

from workers.contract.layout import FIELDS, check_layout
from workers.contract.requests import PRINTABLE, PRINTABLE_OR_EMPTY, Identity, Treatment

MOST_UPLOADED = 100_000
MOST_SETS = 100
MOST_CONDITIONS = 16


class BulkPhase(StrEnum):
    """Phases of a bulk run."""

    LISTING = "LISTING"  # files are being listed, and images that are listed are processed
    RUNNING = "RUNNING"  # all files are listed
    PAUSED = "PAUSED"
    COMPLETED = "COMPLETED"  # every image is done or failed
    CANCELLED = "CANCELLED"
    ERROR = "ERROR"  # stopped by an error that concerns the whole run, not one image


AT_WORK = frozenset({BulkPhase.LISTING, BulkPhase.RUNNING})
STOPPED = frozenset({BulkPhase.PAUSED, BulkPhase.ERROR})
OPEN = AT_WORK | STOPPED  # while a run is in one of these phases, an identical request gets this run
BULK_ENDED = frozenset({BulkPhase.COMPLETED, BulkPhase.CANCELLED})
DELETABLE = STOPPED | BULK_ENDED


class ItemState(StrEnum):
    """State of one image of a bulk run."""

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
    """A set of files, below a folder that the operator allows."""

    glob: str = Field(
        min_length=2,
        max_length=1000,
        pattern=PRINTABLE,
        description="an absolute path; * ? [ab] match parts of a name, ** matches any number of folders",
    )
    where: Where = Field(
        default_factory=dict,
        description='conditions on the header, for example {"INSTRUME": "EUI", "WAVELNTH": [171, 174], "XPOSURE": {">=": 1}}',
    )


class Output(_Strict):
    """A folder that products are also written to."""

    folder: str = Field(
        min_length=2,
        max_length=1000,
        pattern=PRINTABLE,
        description="absolute path below a folder that the operator allows; the folder is created if it does not exist",
    )
    only: bool = Field(False, description="true: write products only to the folder; the service keeps none")
    layout: str | None = Field(
        None,
        max_length=300,
        description="relative path of each product in the folder, for example {telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits; "
        f"fields: {', '.join(FIELDS)}; an existing file with other content is never replaced; null: STEM-PRODUCT.fits",
    )

    @field_validator("layout")
    @classmethod
    def _usable(cls, layout: str | None) -> str | None:
        if layout is not None:
            check_layout(layout)
        return layout


class BulkWork(_Strict):
    """The part of a request for a bulk run that is stored with the run: all except the ids of uploaded images."""

    name: str = Field("", max_length=80, pattern=PRINTABLE_OR_EMPTY, description="a name to show in lists")
    files: list[FileSet] = Field(default_factory=list, max_length=MOST_SETS)
    psf_id: Identity | None = Field(None, description="a PSF of the catalogue")
    context: str | None = Field(
        None,
        min_length=1,
        max_length=64,
        description="id or name of the context from which the PSF of each image is chosen",
    )
    parameters: Treatment = Field(default_factory=lambda: Treatment())
    output: Output | None = None

    @property
    def keeps_products(self) -> bool:
        """Whether the service keeps the products in its store."""
        return self.output is None or not self.output.only


class BulkRequest(BulkWork):
    """Deconvolve many images with one PSF, or each with the PSF that a context pins for it."""

    images: Annotated[list[Identity], FailFast()] = Field(
        default_factory=list, max_length=MOST_UPLOADED, description="ids returned by the uploads of images"
    )

    @model_validator(mode="after")
    def _something_with_one_psf(self) -> BulkRequest:
        if not self.images and not self.files:
            raise ValueError("expected images or files; got neither")
        if (self.psf_id is None) == (self.context is None):
            raise ValueError(
                "expected exactly one of psf_id and context, because the PSFs of a bulk run are fixed when it starts"
            )
        return self
