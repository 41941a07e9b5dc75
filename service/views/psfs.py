"""The description of a PSF."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

from workers.catalogue.tables import PsfRow
from workers.versions import PsfStatus, iso


def was_certified(row: PsfRow) -> bool:
    """Whether a PSF is or was certified. An interpolated PSF may be deprecated together with one of its ends, without having
    been certified."""
    return row.status == PsfStatus.CERTIFIED or row.valid_from is not None


class PsfView(BaseModel):
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
        return cls(
            id=row.id,
            created_at=row.created_at,
            name=row.name,
            version=row.version,
            instrument=row.instrument,
            channel=row.channel,
            kind=row.kind,
            status=PsfStatus(row.status),
            was_certified=was_certified(row),
            valid_from=None if row.valid_from is None else iso(row.valid_from),
            valid_to=None if row.valid_to is None else iso(row.valid_to),
            successor=row.successor_id,
            origin=row.origin,
            bytes=row.bytes,
            details=row.details,
            file=f"{here}/file",
            preview=f"{here}/preview" if row.preview_sha256 else None,
            report=f"{here}/report" if "report_sha256" in row.details else None,
        )
