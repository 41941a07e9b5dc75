"""The task ``deconvolve``: deconvolves an uploaded image with a PSF; the result is a product."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from psfcore.deconvolve import run
from psfcore.deconvolve.assess.changes import Changes
from psfcore.deconvolve.conditions import PreparedPsfs
from psfcore.deconvolve.doubts import input_warnings
from psfcore.deconvolve.run import Identities, Product, UsedPsf
from psfcore.drawing.thumbnail import write_thumbnail
from psfcore.fits.cards import optional_text
from psfcore.fits.observation import check_exposure_of_sun, read_observation
from psfcore.fits.psfs import read_psf
from psfcore.image import Image
from psfcore.psf import Psf
from psfcore.psf_sampling import with_scale
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow
from workers.contract.identities import product_identity
from workers.contract.requests import ResolvedDeconvolve, options_of
from workers.files.archive import safe_name
from workers.intake.compatibility import DEPRECATED_CODE, deprecated_warning, of_upload
from workers.rows import row_of
from workers.settings import library_versions, software_version
from workers.tasks.context import Context
from workers.tasks.psf_build import requested_psf


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


def deconvolve(context: Context, parameters: Mapping[str, Any]) -> str:
    """Deconvolve an uploaded image and add the product to the catalogue; returns the product's id.

    Raises DataError "no-such-image", "no-such-psf", "instrument-changed", "channel-mismatch", "no-noise-figures",
    "already-deconvolved", "psf-as-image", and the errors of reading the image and of the method.
    """
    request = ResolvedDeconvolve.model_validate(parameters)
    identity = product_identity(request)
    if context.made(ProductRow, identity) is not None:
        return identity
    psf_row = requested_psf(context, request)
    row_of(context.catalogue, ImageRow, request.image_id, context.owner)
    image = load(context, request, context.store.verified(request.image_id))
    made = make(context, request, psf_row, image)
    with context.store.temporary() as path:
        write(made, path)
        context.report("saving", 1, 1)
        keep(made, path)
    return identity


def load(context: Context, request: ResolvedDeconvolve, path: Path) -> Image:
    """Read an image file and mask its saturated pixels."""
    context.report("reading", 0, request.method.steps)
    image = read_observation(path, context.limits, saturation_dn=request.saturation_dn, hdu=request.hdu)
    # A rerun repeats an earlier deconvolution, even if it was made by a version that did not check this.
    if not (request.again or context.anew):
        check_exposure_of_sun(image.header)
    return image


@lru_cache(maxsize=1)
def _prepared(max_bytes: int) -> PreparedPsfs:
    """The prepared PSFs of this process. The jobs of a process run one after the other and often use the same PSF."""
    return PreparedPsfs(max_bytes)


def make(
    context: Context, request: ResolvedDeconvolve, psf_row: PsfRow, image: Image, *, preview: bool = True
) -> Made:
    """Deconvolve an image and measure the changes. ``preview``: also draw the preview picture."""
    threads, digest = context.settings.threads, psf_row.file_sha256
    scale, limits = request.plate_scale_arcsec, context.settings.psf_limits
    prepared = _prepared(context.settings.psf_cache_mib * 2**20)

    def read(*, parts: bool = False) -> Psf:
        return with_scale(read_psf(context.store.verified(digest), limits, parts=parts), scale)

    psf = prepared.on_pixels_of(image.header, (digest, limits, scale), read)

    def begin(stage: str, steps: int) -> Callable[[int, int], None]:
        if stage == run.DECONVOLVING:
            context.times.begin(stage)
        else:
            context.report(stage, 0, steps)
        return lambda step, steps: context.report(stage, step, steps)

    product = run.deconvolve(
        image,
        psf,
        replace(options_of(request, threads), engine_for=prepared.engine_for),
        warnings=_warnings(context, request, psf_row, psf, image),
        possible_psfs=lambda: _possible_psfs(read(parts=True), image, threads),
        begin=begin,
    )
    context.report("saving", 0, 1)
    draw = partial(keep_picture, context, partial(run.draw_preview, product, used_psf(psf_row)))
    with ThreadPoolExecutor(1) as beside:
        # A worker with one thread draws the picture in this thread: a second thread would slow down the other workers.
        picture = beside.submit(draw).result if preview and threads > 1 else draw
        details = details_of(context, request, product, psf_row)
        preview_sha256 = picture() if preview else None
    return Made(context, request, psf_row, product, details, preview_sha256)


def _possible_psfs(psf: Psf, image: Image, threads: int) -> list[Psf]:
    # Most deconvolutions compute no errors, and do not load what follows.
    from psfcore.scatter.total_psf import possible_on_pixels

    return possible_on_pixels(psf, image.header, threads=threads)


def _warnings(
    context: Context, request: ResolvedDeconvolve, row: PsfRow, psf: Psf, image: Image
) -> dict[str, str]:
    """The warnings about the inputs. Raises DataError "channel-mismatch"."""
    # The request of an upload may give an instrument and a channel that the file does not contain.
    instrument, angstrom = of_upload(row, psf.instrument, psf.wavelength_angstrom)
    psf = replace(psf, instrument=instrument, wavelength_angstrom=angstrom)
    # A rerun repeats an earlier deconvolution, even if it was made by a version that did not compare channels.
    allowed = request.other_channel or context.anew
    warning = deprecated_warning(context.catalogue, row)
    deprecated = {} if warning is None else {DEPRECATED_CODE: warning}
    return deprecated | input_warnings(psf, image, request.method.name, other_channel=allowed)


# The product in the store and in the catalogue ------------------------------------------------------


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
