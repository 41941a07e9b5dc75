"""Lists the files that match the patterns and the header conditions of a bulk run, and adds them to its images.

A turn lists files in a thread of its own while it processes the images that are already listed. The transaction that
adds images also stores how far the search has come, so that the next turn continues the search from there.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote, unquote_to_bytes

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from workers.catalogue.bulks import NOT_UTF_8, TOO_LONG, BulkImage
from workers.catalogue.tables import MOST_LETTERS, BulkRow
from workers.contract.bulk import BulkWork, Condition
from workers.contract.documents import PositionJson
from workers.contract.jobs import JobError
from workers.files import archive as archive_files
from workers.settings import Settings

if TYPE_CHECKING:
    from workers.tasks.catalogue_workspace import CatalogueWorkspace

MOST_IMAGES = 1_000_000
LIST_AT_ONCE = 200
ADD_EVERY_S = (
    0.5  # images are added after this time even if they are fewer, so that the first ones are processed soon
)


@dataclass(frozen=True)
class SearchPosition:
    """How far the search for the files of a run has come.

    Attributes
    ----------
    pattern
        Number of the pattern.
    names
        The position within the search for this pattern; see ``archive.Entry``.
    """

    pattern: int
    names: archive_files.Position

    def stored(self) -> PositionJson:
        """The position as JSON. Names may have bytes that are not UTF-8, which PostgreSQL refuses; they are written as
        %FF.
        """
        return {"pattern": self.pattern, "names": [quote(os.fsencode(name), safe="") for name in self.names]}

    @classmethod
    def of(cls, stored: PositionJson) -> SearchPosition:
        """The position that was stored."""
        names = tuple(os.fsdecode(unquote_to_bytes(name)) for name in stored["names"])
        return cls(stored["pattern"], names)


def list_files(
    workspace: CatalogueWorkspace, bulk: BulkRow, added: Callable[[], None], stops: Callable[[], bool]
) -> None:
    """Add the files that the patterns of a bulk run match to its images, from the position where an earlier search
    ended.

    An error that concerns all files stops the run. Images that were added before the error stay.

    Parameters
    ----------
    bulk
        The row that ``Bulks.begin_listing`` returned for the lease of the workspace.
    added
        Function that is called after images were added.
    stops
        Function that says whether the search must end now; another turn then continues it.
    """
    bulks = workspace.catalogue.bulks
    assert workspace.lease is not None
    try:
        if not _add_all(workspace, bulk, added, stops):
            return
        now = bulks.get(bulk.id)
        if now is not None and now.total == 0:
            raise no_images()
    except DataError as error:
        bulks.stop_with(bulk.id, JobError.of(error))
        return
    bulks.end_listing(bulk.id, workspace.lease)


def no_images() -> DataError:
    """The error of a run whose patterns match no file."""
    return DataError(
        "no-images",
        "expected files that match the patterns and the header conditions; found no files: check the globs and `where`",
    )


def _add_all(
    workspace: CatalogueWorkspace, bulk: BulkRow, added: Callable[[], None], stops: Callable[[], bool]
) -> bool:
    """Search and add images in batches. Returns whether the search came to its end. Raises DataError."""
    bulks, request, lease = workspace.catalogue.bulks, BulkWork.model_validate(bulk.request), workspace.lease
    assert lease is not None
    position = None if bulk.listed_to is None else SearchPosition.of(bulk.listed_to)
    several = position is not None and len(request.files) > 1
    # A path that the catalogue cannot store is not known again: it may then fail twice, once for each pattern.
    known = bulks.progress.sources(bulk.id) if several else frozenset[str]()
    batch: list[BulkImage] = []
    add_at = time.monotonic() + ADD_EVERY_S

    def add() -> bool:
        nonlocal add_at
        add_at = time.monotonic() + ADD_EVERY_S
        if position is None:
            return True
        if not bulks.add_listed(bulk.id, lease, batch, position.stored()):
            return False
        batch.clear()
        added()
        return True

    try:
        for reached, image in found_files(request, workspace.settings, position, known, bulk.total):
            position = reached
            if image is not None:
                batch.append(image)
            stop = stops()
            if (stop or len(batch) >= LIST_AT_ONCE or time.monotonic() >= add_at) and not add():
                return False
            if stop:
                return False
    except DataError:
        add()
        raise
    return add()


def found_files(
    request: BulkWork,
    settings: Settings,
    after: SearchPosition | None = None,
    known: frozenset[str] = frozenset(),
    listed: int = 0,
) -> Iterator[tuple[SearchPosition, BulkImage | None]]:
    """Search the files that match the patterns of a request; each file is found once even if several patterns match it.

    Each step of the search looks at one folder or entry: its position comes with the image that was found there, or
    None. A file that cannot be used comes with its error.

    Parameters
    ----------
    after
        The position after which an earlier search ended, and this one continues; None: from the beginning.
    known
        Paths that the earlier search found, if there are several patterns.
    listed
        Number of images that are already listed.

    Raises
    ------
    DataError
        "bad-path", "path-not-allowed", "unreadable-folder", "too-many-images".
    """
    allowed = archive_files.roots(settings.bulk_roots)
    seen = set(known)
    first = 0 if after is None else after.pattern
    for number, files in enumerate(request.files[first:], first):
        names = after.names if after is not None and number == first else None
        for entry in archive_files.find(files.glob, allowed, names):
            path, image = str(entry.path), None
            if (entry.matches or entry.error) and path not in seen:
                image = _listed_one(allowed, settings.image_limits, entry, files.where)
            if image is not None:
                listed += 1
                if len(request.files) > 1:
                    seen.add(path)
            if listed > MOST_IMAGES:
                raise DataError(
                    "too-many-images",
                    f"expected at most {MOST_IMAGES} images in a bulk run; the patterns match more: split the request",
                )
            yield SearchPosition(number, entry.position), image


def _listed_one(
    allowed: Sequence[Path], limits: FitsLimits, entry: archive_files.Entry, where: dict[str, Condition]
) -> BulkImage | None:
    """An entry of a folder as an image of the run, with an error if the file cannot be used; None if its header does
    not match.
    """
    failure = entry.error
    if failure is None and where:
        try:
            with archive_files.opened(entry.path, allowed) as file:
                if not archive_files.matches(archive_files.reopened(file), where, limits):
                    return None
        except DataError as unusable:
            failure = unusable
        except OSError as unreadable:
            failure = archive_files.unreadable(unreadable)
    source = archive_files.shown(entry.path)
    failure = _path_error(entry.path, source) or failure
    if len(source) > MOST_LETTERS:
        source = source[: MOST_LETTERS - 1] + "…"
    return BulkImage(source, uploaded=False, error=None if failure is None else JobError.of(failure))


def _path_error(path: Path, source: str) -> DataError | None:
    """The error for a path that the catalogue cannot store; None if the catalogue can store it."""
    if source != str(path):
        message = f"expected a path in UTF-8; got a path that ends in {source[-100:]}: rename the file"
        return DataError(NOT_UTF_8, message)
    if len(source) > MOST_LETTERS:
        message = (
            f"expected a path of at most {MOST_LETTERS} characters; got {len(source)}, ending in {source[-100:]}: use "
            "shorter names"
        )
        return DataError(TOO_LONG, message)
    return None
