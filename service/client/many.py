"""Deconvolves many images into a folder, through a service or in this process.

A few jobs are in flight at a time, so that the workers of a service need not wait for uploads and downloads. One
thread does everything in the order of the images: it begins images until enough jobs are in flight, then waits for
the oldest job.

The file of a product is named after the image's file and the product's identity. An image is skipped if the folder
already contains its product, made from the same bytes with the same PSF and parameters. Products in the folder are
recognised by their cards INPSHA and PRODID, whatever their names.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeVar, cast

from psfcore.errors import DataError, HeaderError
from psfcore.files import fits_in, sha256_of
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.cards import optional_text
from psfcore.fits.header import all_hdus, read_first_image
from service.client.answers import Product, Submitted
from service.client.errors import Answer, Patience, ServiceError, WaitInterrupted
from service.client.operations import Operations, deconvolution
from service.client.outputs import check_output_folder, check_outputs
from workers.files.archive import safe_name

# Errors that concern every image, so that the run stops: key refused, scope missing, quota full.
FOR_ALL = (401, 403, 507)
BUSY = (429, 502, 503)  # statuses after which a request is sent again
LARGEST_PX = 2**26

_Products = dict[tuple[str, str], Path]
_Step = TypeVar("_Step", bound="_Pending | Outcome")


@dataclass(frozen=True)
class Outcome:
    """The outcome for one image.

    Attributes
    ----------
    output
        The file of the product; None if there is none.
    existed
        Whether the folder contained the product before.
    failure
        Why there is no product; None if there is one.
    warnings
        What a user of the product must know; empty if the folder contained the product before.
    """

    image: Path
    output: Path | None = None
    existed: bool = False
    failure: str | None = None
    warnings: tuple[str, ...] = ()


def deconvolve_many(
    service: Operations,
    images: Sequence[str | Path],
    folder: str | Path,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, of: None,
    **parameters: object,
) -> Iterator[Outcome]:
    """Deconvolve images into a folder, and yield the outcome for each image, in the order of the images.

    At most ``service.jobs_at_once`` jobs are in flight. If an image cannot be read, deconvolved or written, its outcome
    has the reason, and the next image follows.

    Parameters
    ----------
    service
        The service, or this process, that deconvolves.
    images
        The files of the images.
    folder
        The folder of the products; it is made if needed.
    overwrite
        Whether to replace files that have the name of a product but are not this product.
    progress
        Function of the number of images that are done and the number of all images. It is called at the beginning and
        after each image.
    **parameters
        Parameters as for ``Operations.deconvolve``, except the pictures.

    Raises
    ------
    ServiceError
        An error concerns every image: "output-not-writable", a refused key, a full quota, or no answer from the
        service. If the service answers, images whose jobs are in flight are finished before the error is raised.
    WaitInterrupted
        Control-C was pressed. The jobs that this exception names continue.
    """
    check_output_folder(folder)
    Path(folder).mkdir(parents=True, exist_ok=True)
    run = _Run(service, images, Path(folder), overwrite, parameters, _products_in(Path(folder)))
    progress(0, len(images))
    for number, outcome in enumerate(run.outcomes(), 1):
        yield outcome
        progress(number, len(images))


@dataclass
class _Pending:
    """An image whose outcome is not yet known.

    Attributes
    ----------
    key
        Identity of the product, and SHA-256 of the image.
    job
        The job that makes the product; None if an earlier image in flight has the same product.
    """

    image: Path
    key: tuple[str, str]
    output: Path
    request: dict[str, object]
    job: Submitted | None


@dataclass
class _Run:
    """The images whose outcome is not yet known, in their order; the first image is finished first."""

    service: Operations
    images: Sequence[str | Path]
    folder: Path
    overwrite: bool
    parameters: dict[str, object]
    _products: _Products
    _pending: deque[_Pending | Outcome] = field(default_factory=deque)

    def outcomes(self) -> Iterator[Outcome]:
        """The outcome for each image. Raises the same errors as ``deconvolve_many``."""
        try:
            for image in map(Path, self.images):
                try:
                    self._pending.append(_outcome(image, partial(self._begin, image)))
                except ServiceError as error:
                    if error.status in FOR_ALL:
                        yield from self._finished(leave=0)
                    raise
                yield from self._finished(leave=self.service.jobs_at_once - 1)
            yield from self._finished(leave=0)
        except KeyboardInterrupt as stop:
            jobs = [one["id"] for one in self._in_flight()]
            if self.service.server is None or not jobs:
                raise
            raise WaitInterrupted("job", jobs[0], self.service.server, tuple(jobs[1:])) from stop

    def _in_flight(self) -> list[Submitted]:
        return [one.job for one in self._pending if isinstance(one, _Pending) and one.job is not None]

    def _finished(self, leave: int) -> Iterator[Outcome]:
        """Finish images, oldest first, until at most ``leave`` jobs are in flight and the oldest unfinished image has
        a job in flight.
        """
        while self._pending:
            first = self._pending[0]
            if isinstance(first, _Pending):
                if first.job is not None and len(self._in_flight()) <= leave:
                    return
                first = _outcome(first.image, partial(self._finish, first))
            self._pending.popleft()  # only now: an interruption before this line must name its job
            yield first

    def _begin(self, image: Path) -> _Pending | Outcome:
        """Upload an image and submit its job.

        No job is submitted if the folder already contains the product, or if the job of an earlier image makes the
        same product.
        """
        sha256 = sha256_of(image)
        image_id = _patiently(lambda: self.service.image_id(image, sha256))
        request = deconvolution(image_id, **self.parameters)
        product_id = _patiently(lambda: self.service.result_id("deconvolve", **request))
        key = (product_id, sha256)
        if key in self._products:
            return Outcome(image, self._products[key], existed=True)
        pending = _Pending(image, key, self.folder / safe_name(image.name, product_id), request, None)
        if not any(isinstance(one, _Pending) and one.key == key for one in self._pending):
            pending.job = self._submit(pending)
        return pending

    def _submit(self, pending: _Pending) -> Submitted:
        inputs = self.images if pending.output.exists() else ()
        check_outputs((pending.output,), inputs=inputs, overwrite=self.overwrite)
        return _patiently(lambda: self.service.submit("deconvolve", **pending.request))

    def _finish(self, pending: _Pending) -> Outcome:
        """Wait for the job of an image, and download its product."""
        if pending.key in self._products:
            return Outcome(pending.image, self._products[pending.key], existed=True)
        if pending.job is None:  # the earlier image failed
            pending.job = self._submit(pending)
        product = cast("Product", self.service.result_of(pending.job, self.service.wait(pending.job)))
        self.service.download(product["file"], pending.output, overwrite=self.overwrite)
        self.service.release(product)
        self._products[pending.key] = pending.output
        warnings = tuple(one["message"] for one in product["details"]["warnings"])
        return Outcome(pending.image, pending.output, warnings=warnings)


def _outcome(image: Path, step: Callable[[], _Step]) -> _Step | Outcome:
    """The answer of a step, or the outcome of the image if the step failed. Raises ``ServiceError`` if the error
    concerns every image.
    """
    try:
        return step()
    except ServiceError as error:
        if error.code is None or error.status in FOR_ALL:
            raise
        return Outcome(image, failure=str(error))
    except DataError as error:
        return Outcome(image, failure=error.message)
    except OSError as error:
        return Outcome(image, failure=error.strerror or str(error))


def _products_in(folder: Path) -> _Products:
    """Find the files of the complete products in a folder. Return a dictionary from (product id, SHA-256 of the input
    image) to the file.
    """
    products: _Products = {}
    limits = FitsLimits(max_pixels=LARGEST_PX)
    for path in fits_in(folder):
        try:
            all_hdus(path, limits)
            header = read_first_image(path, limits)[1].header
        except (HeaderError, OSError):
            continue  # not a complete FITS file, so not a product that can be used in place of a new one
        product_id, sha256 = optional_text(header, "PRODID"), optional_text(header, "INPSHA")
        if product_id is not None and sha256 is not None:
            products[product_id, sha256] = path
    return products


def _patiently(ask: Callable[[], Answer]) -> Answer:
    """The answer to a request. The request is repeated while the service is busy or the caller's rate limit is used
    up.
    """
    return Patience(say=lambda line: None, goes_on="").repeat(ask, BUSY)
