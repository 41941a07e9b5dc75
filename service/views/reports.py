"""The description of a report."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

from workers.catalogue.tables import ReportRow


class ReportView(BaseModel):
    """The report of a job, for example on a transit or a rerun."""

    id: str
    created_at: float
    kind: str
    transit_id: str | None = Field(description="id of the transit; null: the report is not on a transit")
    about_id: str | None = Field(
        description="id of the PSF or product; null: the report is not on a PSF or product"
    )
    bytes: int
    details: dict[str, Any] = Field(description="the summary sentence and the main figures")
    file: str = Field(description="address of the whole report as JSON")
    preview: str | None = Field(description="address of the picture; null: the report has none")
    html: str | None = Field(
        description="address of the report as a self-contained HTML page; null: the report has none"
    )
    output: str | None = Field(
        description="address of the FITS file that the rerun made; no list contains this file; null: the report is not on a rerun"
    )

    @classmethod
    def of(cls, row: ReportRow) -> ReportView:
        """The description of a report, from its row in the catalogue."""
        here = f"/v1/reports/{row.id}"
        return cls(
            id=row.id,
            created_at=row.created_at,
            kind=row.kind,
            transit_id=row.transit_id,
            about_id=row.about_id,
            bytes=row.bytes,
            details=row.details,
            file=f"{here}/file",
            preview=f"{here}/preview" if row.preview_sha256 else None,
            html=f"{here}/page" if row.details.get("page_sha256") else None,
            output=f"{here}/output" if row.details.get("output_sha256") else None,
        )
