"""The product of a deconvolution in the service: its file and pictures in the store, and its row in the catalogue."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from psfcore.deconvolve import run
from psfcore.deconvolve.assess.changes import Changes
from psfcore.deconvolve.run import Identities, Product, UsedPsf
from psfcore.drawing.thumbnail import write_thumbnail
from psfcore.fits.cards import optional_text
from workers.catalogue.tables import ProductRow, PsfRow
from workers.contract.identities import product_identity
from workers.contract.requests import ResolvedDeconvolve
from workers.files.archive import safe_name
from workers.settings import library_versions, software_version
from workers.tasks.context import Context


@dataclass(frozen=True)
class Made:
    """A finished deconvolution whose file is not yet written. preview_sha256: None if no preview was drawn."""

    context: Context
    request: ResolvedDeconvolve
    psf_row: PsfRow
    product: Product
    details: dict[str, Any]
    preview_sha256: str | None

    @property
    def identity(self) -> str:
        """The product's id."""
        return product_identity(self.request)

    @property
    def found(self) -> Changes:
        """The measured changes."""
        return self.product.assessed.changes


def used_psf(row: PsfRow) -> UsedPsf:
    """The PSF of a row, as the cards of a product name it."""
    return UsedPsf(row.id, row.name, row.version, row.status)


def write(made: Made, path: Path) -> None:
    """Write the product as a FITS file."""
    request = made.request
    ids = Identities(
        product=made.identity,
        input_sha256=request.image_id,
        algorithm_version=request.method.algorithm_version,
        filename=made.details["filename"],
    )
    run.write(made.product, path, used_psf(made.psf_row), ids)


def keep(made: Made, path: Path) -> ProductRow:
    """Move a written product file into the store and add the product to the catalogue."""
    context, request, product = made.context, made.request, made.product
    size_bytes = path.stat().st_size
    file_sha256 = context.store.keep(path)
    changes = (
        keep_picture(context, lambda file: run.draw_changes(product, used_psf(made.psf_row), file))
        if request.changes_picture
        else None
    )
    thumbnail = keep_picture(context, lambda file: write_thumbnail(product.pixels, file))
    row = ProductRow(
        owner=context.owner,
        id=made.identity,
        created_at=time.time(),
        kind="deconvolved-image",
        image_id=request.image_id,
        psf_id=made.psf_row.id,
        psf_version=made.psf_row.version,
        file_sha256=file_sha256,
        bytes=size_bytes,
        preview_sha256=made.preview_sha256 or thumbnail,
        details=made.details | {"changes_picture_sha256": changes, "thumbnail_sha256": thumbnail},
    )
    return context.add(row)


def keep_picture(context: Context, draw: Callable[[Path], object]) -> str:
    """Draw a picture into the store; returns its SHA-256."""
    with context.store.temporary() as picture:
        draw(picture)
        return context.store.keep(picture)


def details_of(
    context: Context, request: ResolvedDeconvolve, product: Product, psf: PsfRow
) -> dict[str, Any]:
    """The details of the product's row: the request, the versions of the software, and the details of the product."""
    header = product.image.header
    return {
        # The name depends only on the content of the input and on the request.
        "filename": safe_name(optional_text(header, "FILENAME") or "heliopsf", product_identity(request)),
        "method": request.method.model_dump(mode="json"),
        "algorithm_version": request.method.algorithm_version,
        "software_version": software_version(),
        "libraries": library_versions(),
        "parameters": request.model_dump(mode="json", exclude_none=True),
        "job_id": context.job_id,
        **product.details(used_psf(psf), psf.details.get("provenance")),
    }
