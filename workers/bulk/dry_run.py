"""A dry run: what a bulk run would do, without starting it.

All files that the patterns match are counted. Of the images, a sample is examined: the header of each image is read,
its PSF is chosen, and its time and memory are estimated, with the functions that a worker uses. Pixels are not read.
Therefore an image whose pixels cannot be used is found only by the run.
"""

from __future__ import annotations

import dataclasses
import hashlib
import random
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import read_summary
from workers.bulk.intake import check_places, check_uploaded, pinned
from workers.bulk.matching import found_files
from workers.bulk.targets import target_of
from workers.catalogue.bulks import Listed
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, ProductRow
from workers.contract.bulk import BulkRequest, Output
from workers.contract.identities import product_identity
from workers.contract.phases import Fault, JobError
from workers.contract.requests import Deconvolve, ResolvedDeconvolve
from workers.files import archive as archive_files
from workers.files import beneath
from workers.intake import estimates
from workers.intake.requests import resolved_deconvolution
from workers.rows import no_such
from workers.settings import Settings

BUDGET_S = 20.0  # a dry run stops after this time, and reports what it found
MOST_REFUSED = 100  # refused images that are named
# Bytes of a product: float32 pixels, the plane QUALITY, and with errors the planes ERROR and PSF_ERROR.
IMAGE_BYTES, QUALITY_BYTES, ERROR_BYTES = 4, 1, 4
BLOCK_BYTES = 2880  # the length of a FITS file is a multiple of this
HEADER_BYTES = 2 * BLOCK_BYTES  # a usual header of an image; the headers of planes are as long
NO_ID = "0" * 64  # takes the place of the SHA-256 of a file, which is not read


@dataclass(frozen=True)
class Refused:
    """An image that the run would refuse, and the reason. source: the id of an upload, or the path of a file."""

    source: str
    error: JobError


@dataclass
class DryRun:
    """What a bulk run would do. Figures of all images are scaled up from the examined ones.

    images: images that were found. complete: False if the time was not enough to list all files and to examine the
    sample. examined, refused_images, existing: numbers of examined images, of those that would be refused, and of those
    whose product exists already (known for uploads only). output_bytes: size of all products, bytes. seconds: time of
    the run. workers: worker processes now. memory_mib: memory of the largest examined image. example_output: path of the
    product of an examined image, if it is known before the run; a product's id is not known for a file.
    """

    images: int = 0
    complete: bool = True
    examined: int = 0
    refused_images: int = 0
    refused: list[Refused] = field(default_factory=list)
    existing: int = 0
    output_bytes: int = 0
    seconds: float = 0.0
    workers: int = 1
    memory_mib: int = 0
    example_output: str | None = None


class _OutOfTime(Exception):
    """The time of the dry run is over."""


def dry_run(
    request: BulkRequest, catalogue: Catalogue, owner: str, settings: Settings, *, sample: int
) -> DryRun:
    """Examine at most ``sample`` images of a bulk run, and estimate the whole run.

    Raises the same ``DataError`` as ``workers.bulk.intake.begin``, and "unreadable-folder", "too-many-images", "no-images".
    """
    asked = _Asked(request, catalogue, owner, settings)
    found = DryRun(workers=max(1, len(catalogue.census.workers(settings.lease_s))))
    chosen: list[Listed] = []
    chance = random.Random(0)
    try:
        for image in asked.images():
            found.images += 1
            if len(chosen) < sample:
                chosen.append(image)
            elif (place := chance.randrange(found.images)) < sample:
                chosen[place] = image
    except _OutOfTime:
        found.complete = False
    if not found.images and found.complete:
        raise DataError(
            "no-images",
            "expected files that match the patterns and the header conditions; found no files: check the globs and `where`",
        )
    seconds, size_bytes = 0.0, 0
    for image in chosen:
        if asked.late:
            found.complete = False
            break
        found.examined += 1
        try:
            one = asked.examined(image)
        except DataError as error:
            found.refused_images += 1
            if len(found.refused) < MOST_REFUSED:
                reason = JobError(fault=Fault.USER, code=error.code, message=error.message)
                found.refused.append(Refused(image.source, reason))
            continue
        found.existing += one.exists
        found.memory_mib = max(found.memory_mib, one.memory_mib)
        found.example_output = found.example_output or one.output
        seconds, size_bytes = seconds + one.seconds, size_bytes + one.bytes
    scale = found.images / max(1, found.examined)
    found.seconds = round(scale * seconds / found.workers, 1)
    found.output_bytes = round(scale * size_bytes)
    return found


@dataclass(frozen=True)
class _Examined:
    exists: bool
    bytes: int
    seconds: float
    memory_mib: int
    output: str | None


class _Asked:
    """A request, whose images are found and examined within ``BUDGET_S``."""

    def __init__(self, request: BulkRequest, catalogue: Catalogue, owner: str, settings: Settings) -> None:
        self._request, self._catalogue, self._owner, self._settings = request, catalogue, owner, settings
        self._ends_at = time.monotonic() + BUDGET_S
        self._psf_id, self._context_id = pinned(request, catalogue, owner)
        self._uploads = list(dict.fromkeys(request.images))
        check_uploaded(self._uploads, catalogue, owner)
        check_places(request, settings)
        self._names: dict[Path, str] = {}  # the image that first got this name

    @property
    def late(self) -> bool:
        """Whether the time is over."""
        return time.monotonic() > self._ends_at

    def images(self) -> Iterator[Listed]:
        """All images of the run. Raises ``_OutOfTime``, and the errors of listing."""
        for identity in self._uploads:
            yield Listed(identity, uploaded=True)
        for step in found_files(self._request, self._settings):
            if self.late:
                raise _OutOfTime
            if step.image is not None:
                yield step.image

    def examined(self, image: Listed) -> _Examined:
        """The estimate of one image. Raises DataError if the run would refuse the image."""
        if image.error is not None:
            raise DataError(image.error.code, image.error.message)
        image_id, summary = self._summary(image)
        wanted = Deconvolve(
            image_id=image_id,
            psf_id=self._psf_id,
            context=self._context_id,
            **self._request.parameters.model_dump(),
        )
        resolved = resolved_deconvolution(wanted, summary, self._catalogue, self._owner)
        needs = resolved.model_dump(mode="json") | {"image_shape": summary["shape"]}
        estimate = estimates.checked("deconvolve", needs, self._catalogue, self._owner, self._settings)
        exists = image.uploaded and self._exists(resolved)
        output, target = self._request.output, None
        if output is not None:
            target = self._named(image, summary, resolved, output)
        if output is not None and not image.uploaded and "{product}" in (output.layout or "{product}"):
            target = None  # the name has the id of the product, which depends on the bytes of the file
        return _Examined(
            exists,
            0 if exists else product_bytes(summary["shape"], resolved.error_draws),
            0.0 if exists else estimate["seconds"],
            estimate["memory_mib"],
            None if target is None else archive_files.shown(target),
        )

    def _named(
        self, image: Listed, summary: dict[str, Any], resolved: ResolvedDeconvolve, output: Output
    ) -> Path:
        """The path of the product. Raises DataError if the layout gives no name, or the name of another examined image."""
        identity = product_identity(resolved)
        target = target_of(
            output,
            self._settings,
            name=summary["filename"] if image.uploaded else Path(image.source).name,
            source=None if image.uploaded else Path(image.source),
            summary=summary,
            identity=identity if image.uploaded else hashlib.sha256(image.source.encode()).hexdigest(),
            psf_id=resolved.psf_id,
        )
        first = self._names.setdefault(target, image.source)
        if first != image.source:
            raise DataError(
                "output-name-taken",
                f"expected a name of its own for each product; got {archive_files.shown(target)}, which is also the name for "
                f"{first}: use a layout with further fields, for example {{product}}",
            )
        return target

    def _exists(self, resolved: ResolvedDeconvolve) -> bool:
        return self._catalogue.get(ProductRow, product_identity(resolved), self._owner) is not None

    def _summary(self, image: Listed) -> tuple[str, dict[str, Any]]:
        if image.uploaded:
            row = self._catalogue.get(ImageRow, image.source, self._owner)
            if row is None:  # it was deleted meanwhile
                raise no_such("image", image.source)
            return row.id, row.summary | {"filename": row.filename or "image"}
        try:
            with beneath.opened(Path(image.source), archive_files.roots(self._settings.bulk_roots)) as file:
                found = read_summary(beneath.reopened(file), FitsLimits(max_pixels=self._settings.max_pixels))
        except OSError as error:
            raise archive_files.unreadable(error) from error
        return NO_ID, dataclasses.asdict(found)


def product_bytes(shape: Sequence[int], error_draws: int) -> int:
    """The expected size of a product's file, bytes. shape: (ny, nx) of the image, px."""
    pixels = shape[0] * shape[1]
    planes = [IMAGE_BYTES, QUALITY_BYTES] + ([ERROR_BYTES] if error_draws else [])
    return sum(HEADER_BYTES + -(-pixels * size // BLOCK_BYTES) * BLOCK_BYTES for size in planes)
