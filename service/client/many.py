"""Deconvolves many images into a folder, through a service or in this process.

The file of a product is named after the image's file and the product's identity. An image is skipped if the folder holds
the product of its bytes with the same PSF and parameters, under any name: the cards INPSHA and PRODID of the files decide.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from psfcore.errors import DataError, HeaderError
from psfcore.fits.header import FitsLimits, check_all_headers, first_image_header, optional_text
from service.client.errors import ServiceError
from service.client.operations import Operations, deconvolution
from service.client.outputs import check_output_folder, check_outputs
from workers.files.archive import safe_name

# Errors that concern every image, so that the run stops: key refused, scope missing, quota full.
FOR_ALL = (401, 403, 507)
BUSY = (429, 502, 503)  # statuses after which a request is sent again
PATIENCE_S, LONGEST_WAIT_S = 600.0, 60.0
LARGEST_PX = 2**26

_Found = dict[tuple[str, str], Path]
_Answer = TypeVar("_Answer")


@dataclass(frozen=True)
class Outcome:
    """What became of one image. output: the file of its product. existed: the folder held the product before.

    failure: why there is no product; None if there is one.
    """

    image: Path
    output: Path | None = None
    existed: bool = False
    failure: str | None = None


def deconvolve_many(
    service: Operations,
    images: Sequence[str | Path],
    folder: str | Path,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, of: None,
    **parameters: Any,
) -> Iterator[Outcome]:
    """Deconvolve images one after the other into a folder, and yield what became of each image.

    parameters: as for ``Operations.deconvolve``, except the pictures. If an image cannot be read, deconvolved or written,
    its outcome has the reason, and the next image follows. overwrite: replace files that have the name of a product but
    are not this product. progress(done, of) is called before each image and at the end.

    Raises ``ServiceError`` for an error that concerns every image: "output-not-writable", a refused key, a full quota, or
    no answer from the service.
    """
    check_output_folder(folder)
    Path(folder).mkdir(parents=True, exist_ok=True)
    found = _products_in(Path(folder))
    for number, image in enumerate(map(Path, images)):
        progress(number, len(images))
        try:
            yield _one(service, image, images, Path(folder), found, overwrite, parameters)
        except ServiceError as error:
            if error.code is None or error.status in FOR_ALL:
                raise
            yield Outcome(image, failure=str(error))
        except DataError as error:
            yield Outcome(image, failure=error.message)
        except OSError as error:
            yield Outcome(image, failure=error.strerror or str(error))
    progress(len(images), len(images))


def _one(
    service: Operations,
    image: Path,
    images: Iterable[str | Path],
    folder: Path,
    found: _Found,
    overwrite: bool,
    parameters: dict[str, Any],
) -> Outcome:
    with image.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    image_id = _patiently(lambda: service.image_id(image, sha256))
    wanted = deconvolution(image_id, **parameters)
    product_id = _patiently(lambda: service.result_id("deconvolve", **wanted))
    there = found.get((product_id, sha256))
    if there is not None:
        return Outcome(image, there, existed=True)
    output = folder / safe_name(image.name, product_id)
    check_outputs((output,), inputs=images if output.exists() else (), overwrite=overwrite)
    job = _patiently(lambda: service.submit("deconvolve", **wanted))
    product = service.get(service.wait(job)["result"])
    service.download(product["file"], output, overwrite=overwrite)
    service.release(product)
    found[product_id, sha256] = output
    return Outcome(image, output)


def _products_in(folder: Path) -> _Found:
    """The complete products in a folder: the file of each, by its identity and the SHA-256 of its image."""
    found: _Found = {}
    limits = FitsLimits(max_pixels=LARGEST_PX)
    for path in sorted(folder.glob("*.fits")):
        try:
            check_all_headers(path, limits)
            header = first_image_header(path, limits)
        except (HeaderError, OSError):
            continue  # not a complete FITS file, so not a product that can be used in place of a new one
        product_id, sha256 = optional_text(header, "PRODID"), optional_text(header, "INPSHA")
        if product_id is not None and sha256 is not None:
            found[product_id, sha256] = path
    return found


def _patiently(ask: Callable[[], _Answer]) -> _Answer:
    """The answer to a request. While the service is busy or the caller's rate is used up, the request is sent again."""
    give_up_at = time.monotonic() + PATIENCE_S
    while True:
        try:
            return ask()
        except ServiceError as error:
            if error.status not in BUSY or time.monotonic() > give_up_at:
                raise
            wait_s = 1.0 if error.retry_after_s is None else error.retry_after_s
            time.sleep(min(wait_s, LONGEST_WAIT_S))
