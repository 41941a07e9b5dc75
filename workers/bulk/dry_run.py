"""A dry run: what a bulk run would do, without starting it.

All files that the patterns match are counted. Of the images, a sample is examined: the header of each image is read,
its PSF is chosen, and its time and memory are estimated, with the functions that a worker uses. Pixels are not read.
Therefore an image whose pixels cannot be used is found only by the run.
"""

from __future__ import annotations

import hashlib
import random
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from pydantic import BaseModel, Field

from psfcore.errors import DataError
from psfcore.fits.blocks import BLOCK_BYTES
from psfcore.fits.header import read_summary
from workers.bulk.listing import found_files, no_images
from workers.bulk.outputs import Source, target_of
from workers.bulk.runs import new_run, resolved_image
from workers.catalogue.bulks import BulkImage
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, ProductRow
from workers.contract.bulk import BulkRequest
from workers.contract.documents import header_json
from workers.contract.identities import product_identity
from workers.contract.jobs import JobError
from workers.contract.requests import ResolvedDeconvolve
from workers.files import archive as archive_files
from workers.intake import estimates
from workers.lookup import row_of
from workers.settings import Settings

BUDGET_S = 20.0  # a dry run stops after this time, and reports what it found
MOST_REFUSED = 100  # refused images that are named
# Bytes of a product: float32 pixels, the plane QUALITY, and with errors the planes ERROR and PSF_ERROR.
IMAGE_BYTES, QUALITY_BYTES, ERROR_BYTES = 4, 1, 4
HEADER_BYTES = 2 * BLOCK_BYTES  # a usual header of an image; the headers of planes are as long
NO_ID = "0" * 64  # takes the place of the SHA-256 of a file, which is not read


class Refused(BaseModel):
    """An image that a bulk run would refuse."""

    source: str = Field(description="id of the upload, or path of the file")
    error: JobError


class BulkEstimate(BaseModel):
    """What a bulk run would do. Only a sample of the images is examined; the figures of the run are scaled up from
    it.
    """

    images: int = Field(description="images that were found")
    complete: bool = Field(
        description=f"false: {BUDGET_S:g} s were not enough to list all files and to examine the sample, so the run "
        "may have more images than are counted here, or the sample fewer than were asked for",
    )
    examined: int = Field(description="images of the sample whose headers were read")
    refused_images: int = Field(description="examined images that the run would refuse")
    refused: list[Refused] = Field(
        description=f"the first {MOST_REFUSED} images that the run would refuse, with the reasons"
    )
    existing: int = Field(
        description="examined uploads whose product exists already; for files this is not known before the run",
    )
    output_bytes: int = Field(description="expected size of all products, without their pictures")
    seconds: float = Field(description="expected time of the run with the workers that run at present")
    workers: int = Field(description="worker processes now; 1 if there are none")
    memory_mib: int = Field(description="memory that the largest examined image needs")
    example_output: str | None = Field(
        description="path of the product of an examined image in the output folder; null: there is no output folder, "
        "or the path has the id of the product, which is not known before the run",
    )


class _OutOfTime(Exception):
    """The time of the dry run is over."""


def dry_run(
    request: BulkRequest, catalogue: Catalogue, owner: str, settings: Settings, *, sample: int
) -> BulkEstimate:
    """Examine at most ``sample`` images of a bulk run, and estimate the whole run.

    Raises the same ``DataError`` as ``workers.bulk.runs.begin``, and "unreadable-folder", "too-many-images",
    "no-images".
    """
    return _DryRun(request, catalogue, owner, settings).estimate(sample)


class _DryRun:
    """A run whose images are found and examined within ``BUDGET_S``."""

    def __init__(self, request: BulkRequest, catalogue: Catalogue, owner: str, settings: Settings) -> None:
        self._request, self._catalogue, self._settings = request, catalogue, settings
        self._ends_at = time.monotonic() + BUDGET_S
        self._run, self._uploads = new_run(request, catalogue, owner, settings)
        self._names: dict[Path, str] = {}  # the image that first got this name
        self._images, self._examined, self._existing, self._complete = 0, 0, 0, True
        self._refused: list[Refused] = []
        self._seconds, self._bytes, self._memory_mib = 0.0, 0, 0
        self._example_output: str | None = None

    def estimate(self, sample: int) -> BulkEstimate:
        """Examine at most ``sample`` images, and scale their figures up."""
        try:
            for image in self._chosen(sample):
                self._check_time()
                self._examined += 1
                try:
                    self._examine(image)
                except DataError as error:
                    self._refused.append(Refused(source=image.source, error=JobError.of(error)))
        except _OutOfTime:
            self._complete = False
        scale = self._images / max(1, self._examined)
        workers = max(1, len(self._catalogue.census.workers(self._settings.lease_s)))
        return BulkEstimate(
            images=self._images,
            complete=self._complete,
            examined=self._examined,
            refused_images=len(self._refused),
            refused=self._refused[:MOST_REFUSED],
            existing=self._existing,
            output_bytes=round(scale * self._bytes),
            seconds=round(scale * self._seconds / workers, 1),
            workers=workers,
            memory_mib=self._memory_mib,
            example_output=self._example_output,
        )

    def _check_time(self) -> None:
        if time.monotonic() > self._ends_at:
            raise _OutOfTime

    def _chosen(self, sample: int) -> list[BulkImage]:
        """Count all images of the run, and choose a random sample of them. Raises the errors of listing."""
        chosen: list[BulkImage] = []
        chance = random.Random(0)  # noqa: S311  # a sample
        try:
            for image in self._found():
                self._images += 1
                if len(chosen) < sample:
                    chosen.append(image)
                elif (place := chance.randrange(self._images)) < sample:
                    chosen[place] = image
        except _OutOfTime:
            self._complete = False
            return chosen
        if not self._images:
            raise no_images()
        return chosen

    def _found(self) -> Iterator[BulkImage]:
        for identity in self._uploads:
            yield BulkImage(identity, uploaded=True)
        for _, image in found_files(self._request, self._settings):
            self._check_time()
            if image is not None:
                yield image

    def _examine(self, image: BulkImage) -> None:
        """Add the estimate of one image. Raises DataError if the run would refuse the image."""
        if image.error is not None:
            raise DataError(image.error.code, image.error.message)
        catalogue = self._catalogue
        source = self._source(image)
        resolved = resolved_image(self._run, source.sha256, source.summary, catalogue)
        shape = source.summary["shape"]
        needs = resolved.model_dump(mode="json") | {"image_shape": shape}
        estimate = estimates.checked("deconvolve", needs, catalogue, self._run.owner, self._settings)
        exists = image.uploaded and (
            catalogue.get(ProductRow, product_identity(resolved), self._run.owner) is not None
        )
        if self._request.output is not None:
            target = self._target(image, source, resolved)
            # The id of a file's product depends on the bytes of the file.
            if image.uploaded or "{product}" not in (self._request.output.layout or "{product}"):
                self._example_output = self._example_output or archive_files.shown(target)
        self._existing += exists
        self._memory_mib = max(self._memory_mib, int(estimate["memory_mib"]))
        if not exists:
            start_s = estimate["start_s"]
            self._seconds += start_s * estimates.factor(estimates.BULK, start_s, catalogue)
            self._bytes += product_bytes(shape, resolved.error_draws)

    def _target(self, image: BulkImage, source: Source, resolved: ResolvedDeconvolve) -> Path:
        """The path of the product. Raises DataError if the layout gives no name, or the name of another examined
        image.
        """
        assert self._request.output is not None
        identity = product_identity(resolved)
        target = target_of(
            self._request.output,
            self._settings,
            source,
            identity=identity if image.uploaded else hashlib.sha256(image.source.encode()).hexdigest(),
            psf_id=resolved.psf_id,
        )
        first = self._names.setdefault(target, image.source)
        if first != image.source:
            raise DataError(
                "output-name-taken",
                f"expected a name of its own for each product; got {archive_files.shown(target)}, which is also the "
                f"name for {first}: use a layout with further fields, for example {{product}}",
            )
        return target

    def _source(self, image: BulkImage) -> Source:
        if image.uploaded:
            row = row_of(self._catalogue, ImageRow, image.source, self._run.owner)
            return Source(row.id, row.summary, row.filename or "image")
        path = Path(image.source)
        try:
            with archive_files.opened(path, archive_files.roots(self._settings.bulk_roots)) as file:
                summary = read_summary(archive_files.reopened(file), self._settings.image_limits)
                return Source(NO_ID, header_json(asdict(summary)), path.name, path)
        except OSError as error:
            raise archive_files.unreadable(error) from error


def product_bytes(shape: Sequence[int], error_draws: int) -> int:
    """The expected size of a product's file, bytes, for an image of the shape (ny, nx), px."""
    pixels = shape[0] * shape[1]
    planes = [IMAGE_BYTES, QUALITY_BYTES] + ([ERROR_BYTES] if error_draws else [])
    return sum(HEADER_BYTES + -(-pixels * size // BLOCK_BYTES) * BLOCK_BYTES for size in planes)
