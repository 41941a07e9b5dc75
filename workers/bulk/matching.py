"""Finds the files that match the patterns and the header conditions of a bulk run."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote_to_bytes

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from workers.catalogue.bulk_tables import MOST_LETTERS
from workers.catalogue.bulks import NOT_UTF_8, TOO_LONG, Listed
from workers.contract.bulk import BulkWork, Condition
from workers.contract.phases import Fault, JobError
from workers.files import archive as archive_files
from workers.files import beneath
from workers.settings import Settings

MOST_IMAGES = 1_000_000


@dataclass(frozen=True)
class Place:
    """How far the search for the files of a run has come. pattern: number of the pattern. names: see ``archive.Looked``."""

    pattern: int
    names: archive_files.Place

    def stored(self) -> dict[str, Any]:
        """The place as JSON. Names may have bytes that are not UTF-8, which PostgreSQL refuses; they are written as %FF."""
        return {"pattern": self.pattern, "names": [quote(os.fsencode(name), safe="") for name in self.names]}

    @classmethod
    def of(cls, stored: dict[str, Any]) -> Place:
        """The place that was stored."""
        names = tuple(os.fsdecode(unquote_to_bytes(name)) for name in stored["names"])
        return cls(stored["pattern"], names)


@dataclass(frozen=True)
class Step:
    """A step of the search, which looks at one folder or entry. image: the image that was found there, or None."""

    place: Place
    image: Listed | None = None


def found_files(
    request: BulkWork,
    settings: Settings,
    after: Place | None = None,
    known: frozenset[str] = frozenset(),
    listed: int = 0,
) -> Iterator[Step]:
    """Search the files that match the patterns of a request; each file is found once even if several patterns match it.

    A file that cannot be used comes with its error. after: continue a search that ended after this place. known: paths
    that it found, if there are several patterns. listed: number of images that are listed. Raises DataError "bad-path",
    "path-not-allowed", "unreadable-folder", "too-many-images".
    """
    allowed = archive_files.roots(settings.bulk_roots)
    limits = FitsLimits(max_pixels=settings.max_pixels)
    seen = set(known)
    first = 0 if after is None else after.pattern
    for number, files in enumerate(request.files[first:], first):
        names = after.names if after is not None and number == first else None
        for looked in archive_files.find(files.glob, allowed, names):
            path, image = str(looked.path), None
            if (looked.matches or looked.error) and path not in seen:
                image = _listed_one(allowed, limits, looked, files.where)
            if image is not None:
                listed += 1
                if len(request.files) > 1:
                    seen.add(path)
            if listed > MOST_IMAGES:
                raise DataError(
                    "too-many-images",
                    f"expected at most {MOST_IMAGES} images in a bulk run; the patterns match more: split the request",
                )
            yield Step(Place(number, looked.place), image)


def _listed_one(
    allowed: Sequence[Path], limits: FitsLimits, found: archive_files.Looked, where: dict[str, Condition]
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
