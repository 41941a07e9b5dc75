"""The description of an uploaded transit."""

from __future__ import annotations

from pydantic import BaseModel, Field

from psfcore.noise_figures import NoiseFigures
from workers.catalogue.tables import TransitRow


class PointingView(BaseModel):
    """A pointing of a transit."""

    fov: int = Field(description="number of the pointing in transit.json")
    images: int


class FileView(BaseModel):
    """A file of a transit."""

    name: str
    bytes: int = Field(description="unpacked size, as declared in the archive")


class TransitView(BaseModel):
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
    def of(cls, row: TransitRow) -> TransitView:
        """The description of a transit, from its row in the catalogue."""
        return cls.model_validate(_content(row))


class TransitDetails(TransitView):
    """An uploaded transit, with the files that its transit.json names."""

    files: list[FileView]

    @classmethod
    def of(cls, row: TransitRow) -> TransitDetails:
        """The description of a transit and its files, from the row of the transit in the catalogue."""
        return cls.model_validate(_content(row))


def _content(row: TransitRow) -> dict[str, object]:
    about = {"id": row.id, "created_at": row.created_at, "bytes": row.bytes, "filename": row.filename}
    return row.summary | about
