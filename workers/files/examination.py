"""Compare the files of the store with the rows of the catalogue."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.owners import FileRow
from workers.catalogue.tables import ImageRow, ProductRow, PsfRow, ReportRow, SolutionRow, TransitRow
from workers.files.intact import files_of
from workers.files.store import FileState, Store

NAMES: dict[type[Any], str] = {
    ImageRow: "image",
    TransitRow: "transit",
    PsfRow: "psf",
    ProductRow: "product",
    ReportRow: "report",
    SolutionRow: "solution",
}


@dataclass(frozen=True)
class Fault:
    """A row of the catalogue with a lost or damaged file. files: SHA-256 and state of each lost or damaged file."""

    row: FileRow
    files: tuple[tuple[str, FileState], ...]

    @property
    def what(self) -> str:
        """The kind of the row whose file is lost or damaged, for example "product"."""
        return NAMES[type(self.row)]


def examine(catalogue: Catalogue, store: Store, *, content: bool = True) -> Iterator[Fault]:
    """Find the rows whose files are lost or damaged.

    content: read each file and compare its SHA-256. Otherwise only compare the size of each file with its recorded
    size, if any. If several rows refer to a file, the file is read once. Raises ``workers.files.store.StoreAway``.
    """
    states: dict[str, FileState] = {}
    for table in NAMES:
        for row in catalogue.named_files.kept(table):
            bad = []
            for digest, size in _files(row):
                if digest not in states:
                    states[digest] = store.state(digest, size, content=content)
                if states[digest] != "good":
                    bad.append((digest, states[digest]))
            if bad:
                yield Fault(row, tuple(bad))


def _files(row: FileRow) -> Iterator[tuple[str, int | None]]:
    match row:
        case ImageRow() | TransitRow():
            yield row.id, row.bytes
        case SolutionRow():
            yield row.file_sha256, row.bytes
        case _:
            yield from files_of(row)
