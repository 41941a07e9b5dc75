"""The description of a product."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

from workers.catalogue.tables import ProductRow


class ProductView(BaseModel):
    """A deconvolved image."""

    id: str = Field(description="identity: hash of image, PSF, method, parameters and algorithm version")
    created_at: float
    kind: str
    image_id: str
    psf_id: str
    psf_version: str
    bytes: int
    sha256: str = Field(description="SHA-256 of the file")
    details: dict[str, Any] = Field(
        description="method, parameters, versions, and what the deconvolution changed in the image (`changes`)"
    )
    file: str = Field(description="address of the FITS file")
    preview: str = Field(description="address of a picture: the image before and after, and the change")
    thumbnail: str | None = Field(
        description="address of a small picture of the product; null: the product was made before products had thumbnails"
    )
    changes: str | None = Field(
        description="address of a picture of all changes; null: the request did not ask for it"
    )

    @classmethod
    def of(cls, row: ProductRow, details: dict[str, Any] | None = None) -> ProductView:
        """The description of a product, from its row in the catalogue.

        details: the current details of the product; default: the details in the row.
        """
        here = f"/v1/products/{row.id}"
        return cls(
            id=row.id,
            created_at=row.created_at,
            kind=row.kind,
            image_id=row.image_id,
            psf_id=row.psf_id,
            psf_version=row.psf_version,
            bytes=row.bytes,
            sha256=row.file_sha256,
            details=row.details if details is None else details,
            file=f"{here}/file",
            preview=f"{here}/preview",
            thumbnail=f"{here}/thumbnail" if row.details.get("thumbnail_sha256") else None,
            changes=f"{here}/changes" if row.details.get("changes_picture_sha256") else None,
        )
