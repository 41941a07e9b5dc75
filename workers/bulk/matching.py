"""Finds the files that match the patterns and the header conditions of a bulk run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from workers.catalogue.bulk_tables import MOST_LETTERS
from workers.catalogue.bulks import NOT_UTF_8, TOO_LONG, Listed
from workers.contract.bulk import BulkWork, Condition
from workers.contract.phases import Fault, JobError
from workers.files import archive as archive_files
from workers.files import beneath
from workers.settings import Settings

MOST_IMAGES = 1_000_000
TELL_EVERY_S = 1.0  # interval at which a search reports its progress, so that it can be stopped


def found_files(request: BulkWork, settings: Settings, tell: Callable[[int, int], None]) -> Iterator[Listed]:
    """The files that match the patterns of a request, each once even if several patterns match it.

    A file that cannot be used comes with its error. tell(found, looked_at) is called for every file that was looked at, and
    at least every ``TELL_EVERY_S`` while no file is found; if it raises an exception, the search ends. Raises DataError
    "bad-path", "path-not-allowed", "unreadable-folder", "too-many-images".
    """
    allowed = archive_files.roots(settings.bulk_roots)
    limits = FitsLimits(max_pixels=settings.max_pixels)
    seen: set[Path] = set()
    looked_at, told_at = 0, 0.0

    def told() -> None:
        nonlocal told_at
        told_at = time.monotonic()
        tell(len(seen), looked_at)

    def tick() -> None:
        """Report while a long search finds no files, so that the search can be stopped."""
        if time.monotonic() - told_at >= TELL_EVERY_S:
            told()

    for files in request.files:
        for found in archive_files.find(files.glob, allowed, tick):
            looked_at += 1
            told()
            if found.path in seen:
                continue
            listed = _listed_one(allowed, limits, found, files.where)
            if listed is None:
                continue
            seen.add(found.path)
            if len(seen) > MOST_IMAGES:
                raise DataError(
                    "too-many-images",
                    f"expected at most {MOST_IMAGES} images in a bulk run; the patterns match more: split the request",
                )
            yield listed


def _listed_one(
    allowed: Sequence[Path], limits: FitsLimits, found: archive_files.Found, where: dict[str, Condition]
) -> Listed | None:
    """The found file as an image of the run, with an error if the file cannot be used; None if its header does not match."""
    failure = found.error
    if failure is None and where:
        try:
            with beneath.opened(found.path, allowed) as file:
                if not archive_files.matches(beneath.reopened(file), where, limits):
                    return None
        except DataError as unusable:
            failure = unusable
        except OSError as unreadable:
            failure = archive_files.unreadable(unreadable)
    source = archive_files.shown(found.path)
    error = _path_error(found.path, source)
    if len(source) > MOST_LETTERS:
        source = source[: MOST_LETTERS - 1] + "…"
    if error is None and failure is not None:
        error = JobError(fault=Fault.USER, code=failure.code, message=failure.message)
    return Listed(source, uploaded=False, error=error)


def _path_error(path: Path, source: str) -> JobError | None:
    """The error for a path that the catalogue cannot store; None if the catalogue can store it."""
    if source != str(path):
        code, message = (
            NOT_UTF_8,
            f"expected a path in UTF-8; got a path that ends in {source[-100:]}: rename the file",
        )
    elif len(source) > MOST_LETTERS:
        code = TOO_LONG
        message = f"expected a path of at most {MOST_LETTERS} characters; got {len(source)}, ending in {source[-100:]}"
    else:
        return None
    return JobError(fault=Fault.USER, code=code, message=message)
