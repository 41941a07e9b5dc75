"""Files that no row names any more, found and removed: what a job left that was killed between keeping and writing down.

What was kept of late is left alone: an upload keeps its file before it writes its row. A file that is kept at the very
moment it is removed has its row a little later, so the rows are looked at a second time before it is gone for good.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from psfcore.errors import DataError
from workers.catalogue.catalogue import Catalogue
from workers.files.store import Blob, Store

SECOND_LOOK_AFTER_S = 10.0  # uploads write their rows at once after their files, jobs in seconds


@dataclass(frozen=True)
class Collected:
    """What was found; of a dry run, what would be removed."""

    files: int  # that are kept
    bytes: int
    removed: tuple[Blob, ...]

    @property
    def removed_bytes(self) -> int:
        """What the removed files took."""
        return sum(blob.bytes for blob in self.removed)


def collect(
    catalogue: Catalogue,
    store: Store,
    older_than_s: float,
    *,
    dry_run: bool = False,
    even_most: bool = False,
    second_look_after_s: float = SECOND_LOOK_AFTER_S,
) -> Collected:
    """Remove files that were kept last before so many seconds, and that nothing names; one collection at a time.

    Raises DataError "nothing-named" where no file at all is named: then the database is another one; "most-unnamed" where
    more than half would go, which jobs that are killed do not leave, unless ``even_most``.
    """
    kept_before = time.time() - older_than_s
    there = {blob.digest: blob for blob in store.blobs()}
    left = dict(there)
    for digest in catalogue.named_files.all():
        left.pop(digest, None)
    if there and len(left) == len(there):
        raise DataError(
            "nothing-named",
            f"expected a database that names some of the {len(there)} files; this one names none: is it the right one?",
        )
    old = [blob for blob in left.values() if blob.kept_at < kept_before]
    if not dry_run and not even_most and 2 * len(old) > len(there):
        raise DataError(
            "most-unnamed",
            f"expected a database that names most of the {len(there)} files; {len(old)} old ones are named by nothing in "
            "this one: is it the right one? Nothing was removed; if all of them are to go, say --even-most",
        )
    if not dry_run:
        old = _removed(old, catalogue, store, kept_before, second_look_after_s)
    return Collected(len(there), sum(blob.bytes for blob in there.values()), tuple(old))


def _removed(
    old: list[Blob], catalogue: Catalogue, store: Store, kept_before: float, second_look_after_s: float
) -> list[Blob]:
    """Those of the files that were removed, and that nothing named even then."""
    # First: what a killed collection left aside is missing until here, where it is named.
    store.settle(catalogue.named_files.all())
    gone = [blob for blob in old if store.remove(blob.digest, kept_before)]
    put_back = store.settle(catalogue.named_files.all(), after_s=second_look_after_s)
    return [blob for blob in gone if blob.digest not in put_back]
