"""Bulk runs: many images deconvolved in the same way. Requests, phases, and the names of output files.

LISTING --> RUNNING --> COMPLETED        retry: COMPLETED --> RUNNING, for the failed images
   |  ^      |  ^
   v  |      v  |                        cancel: any phase except COMPLETED and CANCELLED --> CANCELLED
  PAUSED or ERROR                        pause and resume
                                         delete: any phase except LISTING and RUNNING
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import datetime
from enum import StrEnum
from pathlib import PurePosixPath
from string import Formatter
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

from psfcore.errors import DataError
from workers.contract.requests import Identity, Treatment
from workers.texts import Line, Name

MOST_UPLOADED = 100_000
MOST_SETS = 100
MOST_CONDITIONS = 16
FIELDS = {
    "stem": "name of the input file without its ending",
    "folder": "folder of the input file below the folder that the operator allows",
    "telescop": "TELESCOP",
    "instrume": "INSTRUME",
    "detector": "DETECTOR",
    "wavelnth": "WAVELNTH",
    "date": "time of the observation, in the form of strftime: {date:%Y/%m/%d}",
    "product": "first 16 digits of the product's id",
    "psf": "first 16 digits of the PSF's id",
}
DATE_PARTS = frozenset("YmdHMSj")
MOST_IN_PART, MOST_IN_PATH = 200, 1200
_LITERAL = re.compile(r"[A-Za-z0-9._/=+-]*")
_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9._-]+")
FieldValue = str | datetime | PurePosixPath | None


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

    glob: Name = Field(
        min_length=2,
        max_length=1000,
        description="an absolute path; * ? [ab] match parts of a name, ** matches any number of folders",
    )
    where: Where = Field(
        default_factory=dict,
        description='conditions on the header, for example {"INSTRUME": "EUI", "WAVELNTH": [171, 174], "XPOSURE": '
        '{">=": 1}}',
    )


class Output(_Strict):
    """A folder that products are also written to."""

    folder: Name = Field(
        min_length=2,
        max_length=1000,
        description="absolute path below a folder that the operator allows; the folder is created if it does not exist",
    )
    only: bool = Field(False, description="true: write products only to the folder; the service keeps none")
    layout: str | None = Field(
        None,
        max_length=300,
        description="relative path of each product in the folder, for example "
        "{telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits; "
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

    name: Line = Field("", max_length=80, description="a name to show in lists")
    files: list[FileSet] = Field(default_factory=list, max_length=MOST_SETS)
    psf_id: Identity | None = Field(None, description="a PSF of the catalogue")
    context: str | None = Field(
        None,
        min_length=1,
        max_length=64,
        description="id or name of the context from which the PSF of each image is chosen",
    )
    parameters: Treatment = Field(default_factory=lambda: Treatment())  # noqa: PLW0108  # pydantic calls it later
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


# Layouts --------------------------------------------------------------------------------------------
#
# A layout is a relative path with fields in braces, such as {telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits. Values
# of headers and file names become parts of names: all characters except letters, digits, full stops, underscores and
# hyphens are replaced. Therefore no value can lead out of the output folder.


def check_layout(layout: str) -> None:
    """Raise ValueError if a layout cannot be used: an unknown field, a character or a path that is not allowed."""
    for literal, name, form, conversion in _parsed(layout):
        if not _LITERAL.fullmatch(literal):
            raise ValueError(f"expected letters, digits and . _ / = + - outside of fields; got {literal!r}")
        if name is None:
            continue
        if name not in FIELDS or conversion:
            raise ValueError(f"expected the fields {', '.join(FIELDS)}; got {name!r}")
        if name == "date":
            _check_date_form(form or "")
        elif form:
            raise ValueError(f"expected a form after a colon only for the field date; got {name}:{form}")
    if layout.startswith("/") or not layout.endswith(".fits"):
        raise ValueError(f"expected a relative path that ends in .fits; got {layout!r}")
    if any(part.startswith(".") for part in layout.split("/")):
        raise ValueError(f"expected no part of the path that begins with a full stop; got {layout!r}")
    if "" in layout.split("/"):
        raise ValueError(f"expected a name between two slashes; got {layout!r}")


def laid_out(layout: str, values: Mapping[str, FieldValue]) -> PurePosixPath:
    """The relative path of an output file.

    Parameters
    ----------
    layout
        The path with the names of fields in braces.
    values
        The values of the fields; None: the image lacks the value.

    Raises
    ------
    DataError
        "no-output-name" if a value is missing or the path cannot be used.
    """
    text = ""
    for literal, name, form, _ in _parsed(layout):
        text += literal + ("" if name is None else _written(name, form or "", values[name]))
    path = PurePosixPath(*(part for part in text.split("/") if part))
    if any(part.startswith(".") or len(part) > MOST_IN_PART for part in path.parts):
        raise _no_name(
            f"parts of a path that have at most {MOST_IN_PART} characters and do not begin with a full stop",
            text,
        )
    return path


def _parsed(layout: str) -> list[tuple[str, str | None, str | None, str | None]]:
    try:
        return list(Formatter().parse(layout))
    except ValueError as error:
        raise ValueError(f"expected fields in braces, as in {{stem}}; got {layout!r} ({error})") from error


def _check_date_form(form: str) -> None:
    parts = re.findall(r"%(.?)", form)
    rest = re.sub(r"%.?", "", form)
    if not parts or not DATE_PARTS.issuperset(parts) or not _LITERAL.fullmatch(rest):
        wanted = ", ".join(f"%{part}" for part in sorted(DATE_PARTS))
        raise ValueError(f"expected a form of the date with {wanted}, as in {{date:%Y/%m/%d}}; got {form!r}")


def _written(name: str, form: str, value: FieldValue) -> str:
    if isinstance(value, datetime):
        return value.strftime(form)
    if isinstance(value, PurePosixPath):
        return "/".join(_as_part(part) for part in value.parts)
    found = _as_part(value or "")
    if not found:
        raise _no_name(f"an image with a value for the field {name} ({FIELDS[name]})", "none")
    return found


def _as_part(text: str) -> str:
    return _NOT_IN_A_NAME.sub("_", text).strip("._-")[:MOST_IN_PART]


def _no_name(expected: str, got: str) -> DataError:
    return DataError("no-output-name", f"expected {expected}; got {got}: use another layout of the output")
