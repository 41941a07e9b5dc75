"""The files to which the rows of the catalogue refer: check that the store has them, and remove all other files.

A job leaves a file without a row if it is killed before it adds its row. Recent files are not removed, because an
upload first stores its file and then adds the row that refers to it. An upload may also store a file again while the
collection removes it, and add the row a little later. Therefore the rows are read a second time before a file is
deleted for good: ``settle`` is the only place that deletes files of the store.

Kept solutions of transits can be made again, so old ones are removed too, with their rows. The same age limit applies.
``retain`` deletes what is older than the operator keeps it, with its files. PSFs and contexts are always kept.
"""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from psfcore.errors import DataError
from workers.catalogue.catalogue import Catalogue, Row
from workers.catalogue.quotas import KEPT, WITH_FILES, FileRow
from workers.catalogue.tables import ImageRow, SolutionRow, TransitRow
from workers.files.store import Blob, FileState, Store, StoreAway
from workers.settings import Settings

log = logging.getLogger(__name__)
DAY_S = 86_400.0

# A collection moves only old files aside. The second look finds a file that was sent again at the same moment.
SECOND_LOOK_AFTER_S = 10.0
# Other files may be new when they are moved aside. An upload adds its row directly after it has stored its file, a job
# within a minute, and both may wait for other writers of the database.
SETTLED_AFTER_S = 300.0
# The entries of a row's details that name the further files of a result, by the names of the files.
ENTRIES = {
    "tables": "tables_sha256",
    "report": "report_sha256",
    "html": "page_sha256",
    "texts": "page_texts_sha256",
    "changes": "changes_picture_sha256",
    "thumbnail": "thumbnail_sha256",
}


def files_of(row: FileRow) -> list[tuple[str, int | None]]:
    """SHA-256 and size (bytes; None: not recorded) of each file of a row; its main file comes first."""
    if isinstance(row, ImageRow | TransitRow):
        return [(row.id, row.bytes)]
    if isinstance(row, SolutionRow):
        return [(row.file_sha256, row.bytes)]
    named = [row.details.get(entry) for entry in (*ENTRIES.values(), "output_sha256")]
    further = [row.preview_sha256, *named, *row.details.get("figures_sha256", ())]
    return [(row.file_sha256, row.bytes), *((digest, None) for digest in further if digest is not None)]


def intact(store: Store, row: FileRow) -> bool:
    """Whether the store has all files of a row, each with its recorded size. The content of the files is not read.

    Raises ``StoreAway``.
    """
    sizes = ((store.size(digest), expected) for digest, expected in files_of(row))
    return all(size is not None and expected in (None, size) for size, expected in sizes)


def intact_row(catalogue: Catalogue, store: Store, table: type[Row], identity: str, owner: str) -> Row | None:
    """The row of a result with this identity; None if there is none, or if one of its files is lost. Raises
    ``StoreAway``.
    """
    row = catalogue.get(table, identity, owner)
    return row if row is not None and intact(store, row) else None


@dataclass(frozen=True)
class Fault:
    """A row of the catalogue with a lost or damaged file.

    Attributes
    ----------
    files
        SHA-256 and state of each lost or damaged file.
    """

    row: FileRow
    files: tuple[tuple[str, FileState], ...]


def examine(catalogue: Catalogue, store: Store, *, content: bool = True) -> Iterator[Fault]:
    """Find the rows whose files are lost or damaged. Raises ``StoreAway``.

    If several rows refer to a file, the file is read once.

    Parameters
    ----------
    content
        Whether to read each file and compare its SHA-256. Otherwise only the size of each file is compared with its
        recorded size, if any.
    """
    states: dict[str, FileState] = {}
    for table in WITH_FILES:
        for row in catalogue.named_files.kept(table):
            bad = []
            for digest, size in files_of(row):
                if digest not in states:
                    states[digest] = store.state(digest, size, content=content)
                if states[digest] != "good":
                    bad.append((digest, states[digest]))
            if bad:
                yield Fault(row, tuple(bad))


@dataclass(frozen=True)
class Collection:
    """The result of a collection: the files of the store, and the removed files.

    Attributes
    ----------
    files, bytes
        Number and size of the files in the store.
    removed
        The removed files; in a dry run, the files that would be removed.
    """

    files: int  # number of files in the store
    bytes: int
    removed: tuple[Blob, ...]

    @property
    def removed_bytes(self) -> int:
        """The size of the removed files."""
        return sum(blob.bytes for blob in self.removed)


def collect(
    catalogue: Catalogue,
    store: Store,
    older_than_s: float,
    *,
    dry_run: bool = False,
    even_most: bool = False,
    second_look_after_s: float = SECOND_LOOK_AFTER_S,
) -> Collection:
    """Remove files that were last stored more than ``older_than_s`` seconds ago, if no row, or only the row of an old
    solution, refers to them.

    Run only one collection at a time. Raises DataError "nothing-named" if no row refers to any file of the store: the
    database then probably belongs to another store. Raises DataError "most-unnamed" if more than half of the files
    would be removed and ``even_most`` is False, because killed jobs rarely leave so many files.
    """
    kept_before = time.time() - older_than_s
    there = {blob.digest: blob for blob in store.blobs()}
    left = dict(there)
    solutions = catalogue.quotas.solutions_before(kept_before)
    for digest in catalogue.named_files.all(solutions_from=kept_before):
        left.pop(digest, None)
    if there and len(left) == len(there):
        raise DataError(
            "nothing-named",
            f"expected a database that refers to some of the {len(there)} files of the store; this one refers to "
            "none of them: check that the settings name the right database",
        )
    old = [blob for blob in left.values() if blob.kept_at < kept_before]
    made_again = {row.file_sha256 for row in solutions}
    lost = [blob for blob in old if blob.digest not in made_again]
    if not dry_run and not even_most and 2 * len(lost) > len(there):
        raise DataError(
            "most-unnamed",
            f"expected a database that refers to most of the {len(there)} files of the store; this one does not "
            f"refer to {len(lost)} old files: check that the settings name the right database. Nothing was removed; "
            "to remove them all, add --even-most",
        )
    if not dry_run:
        catalogue.quotas.forget_solutions(solutions)
        old = _removed(old, catalogue, store, kept_before, second_look_after_s)
    return Collection(len(there), sum(blob.bytes for blob in there.values()), tuple(old))


def remove_unnamed(catalogue: Catalogue, store: Store, digests: Iterable[str]) -> None:
    """Move these files aside, except the files to which a row of any owner refers (``NamedFiles.among``).

    ``settle`` deletes them later. While the store is away, they stay; then only ``collect`` removes them.
    """
    wanted = frozenset(digests)
    before = time.time()
    for digest in wanted - catalogue.named_files.among(wanted):
        try:
            store.remove(digest, before)
        except StoreAway as away:  # the row is deleted already, so the request must not fail
            log.warning("file %s stays until `heliopsf store collect`: %s", digest, away)


def settle(catalogue: Catalogue, store: Store, digests: set[str]) -> set[str]:
    """Bring back those of the files moved aside to which a row refers, and delete the others.

    A file to which a row refers is deleted aside only after the store shows it in its place. Returns the hashes of the
    files that were brought back. If this is interrupted, the next call finds the files that are left. Raises
    ``StoreAway``.
    """
    if not digests:
        return set()
    named = digests.intersection(catalogue.named_files.all())
    back = set()
    for digest in digests:
        if digest in named:
            if store.bring_back(digest):
                back.add(digest)
            if store.kept_at(digest) is None:
                continue
        store.delete_aside(digest)
    return back


def settle_old(catalogue: Catalogue, store: Store) -> None:
    """``settle`` the files that were moved aside more than ``SETTLED_AFTER_S`` seconds ago."""
    settle(catalogue, store, store.aside(time.time() - SETTLED_AFTER_S))


def _removed(
    old: list[Blob], catalogue: Catalogue, store: Store, kept_before: float, second_look_after_s: float
) -> list[Blob]:
    """Remove the files ``old``; returns the removed files.

    If a row refers to a file after the removal, the file is brought back.
    """
    # An earlier collection may have been killed after it moved files aside.
    settle_old(catalogue, store)
    gone = [blob for blob in old if store.remove(blob.digest, kept_before)]
    if gone:
        time.sleep(second_look_after_s)
    back = settle(catalogue, store, {blob.digest for blob in gone})
    return [blob for blob in gone if blob.digest not in back]


def retain(catalogue: Catalogue, store: Store, settings: Settings) -> dict[tuple[str, str], list[int]]:
    """Delete what is older than ``settings.kept_days`` allows, and log it. In a dry run, only log what would be
    deleted.

    Returns the bytes of each deleted thing, by owner and kind.
    """
    deleted: dict[tuple[str, str], list[int]] = defaultdict(list)
    for (owner, kind), days in settings.kept_days.items():
        others = [other for other, of in settings.kept_days if other and of == kind]
        for of, identity, size in catalogue.quotas.old(kind, time.time() - days * DAY_S, owner, others):
            if settings.keep_dry_run or _delete(catalogue, store, kind, of, identity):
                deleted[of, kind].append(size)
    done = "would delete" if settings.keep_dry_run else "deleted"
    for (owner, kind), sizes in deleted.items():
        fields = {"owner": owner, "kind": kind, "count": len(sizes), "bytes": sum(sizes)}
        log.info("retention: %s %d of kind %s", done, len(sizes), kind, extra={"fields": fields})
    return dict(deleted)


def _delete(catalogue: Catalogue, store: Store, kind: str, owner: str, identity: str) -> bool:
    if kind == "job":
        return catalogue.uws.destroy(identity)
    if kind == "bulk":
        return catalogue.bulks.delete(identity)
    row = catalogue.delete(KEPT[kind], identity, owner)
    if row is not None:
        remove_unnamed(catalogue, store, [digest for digest, _ in files_of(row)])
    return row is not None
