"""The files that a result consists of, and whether the store still has them."""

from __future__ import annotations

from collections.abc import Iterator

from workers.catalogue.tables import ProductRow, PsfRow, ReportRow
from workers.files.store import Store

# Entries of a row's details that name further files.
NAMED_IN_DETAILS = (
    "changes_picture_sha256",
    "output_sha256",
    "page_sha256",
    "report_sha256",
    "tables_sha256",
    "thumbnail_sha256",
)


def files_of(row: ProductRow | PsfRow | ReportRow) -> Iterator[tuple[str, int | None]]:
    """SHA-256 and size (bytes; None: not recorded) of each file of a result; its main file comes first."""
    yield row.file_sha256, row.bytes
    if row.preview_sha256 is not None:
        yield row.preview_sha256, None
    for name in NAMED_IN_DETAILS:
        if row.details.get(name) is not None:
            yield row.details[name], None


def intact(store: Store, row: ProductRow | PsfRow | ReportRow) -> bool:
    """Whether the store has all files of a result, each with its recorded size. The content of the files is not read.

    Raises ``workers.files.store.StoreAway``.
    """
    for digest, expected in files_of(row):
        size = store.size(digest)
        if size is None or expected not in (None, size):
            return False
    return True
