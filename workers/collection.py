"""Files that no row names any more, found and removed: what a job left that was killed between keeping and writing down.

What was kept of late is left alone: an upload keeps its file before it writes its row.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from psfcore.errors import DataError
from workers.catalogue import Catalogue
from workers.store import Blob, Store


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


def collect(catalogue: Catalogue, store: Store, older_than_s: float, *, dry_run: bool = False) -> Collected:
    """Remove files that were kept last before so many seconds, and that nothing names.

    Raises DataError "nothing-named" where no file at all is named: then the database is another one.
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
    gone = tuple(
        blob
        for blob in left.values()
        if blob.kept_at < kept_before and (dry_run or store.remove(blob.digest, kept_before))
    )
    return Collected(len(there), sum(blob.bytes for blob in there.values()), gone)
