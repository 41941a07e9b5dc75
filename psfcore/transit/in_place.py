"""A transit in a folder that is not packed first. It is checked and identified like its archive; nothing is written.

This module imports no numerical library, so that the web process can use it.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast

from psfcore.transit.archive import ArchiveContents, checked_folder, pack_into


@dataclass(frozen=True)
class FolderTransit:
    """A folder with a transit. sha256, bytes: hash and size of the .tar file that ``pack`` would write."""

    folder: Path
    sha256: str
    bytes: int
    contents: ArchiveContents


class _Digest:
    """A file object for writing. It keeps only the SHA-256 and the number of the bytes that are written to it."""

    def __init__(self) -> None:
        self.hash = hashlib.sha256()
        self.bytes = 0

    def write(self, content: bytes) -> int:
        """Take the next bytes."""
        self.hash.update(content)
        self.bytes += len(content)
        return len(content)

    def tell(self) -> int:
        """Number of bytes written."""
        return self.bytes


def transit_in(folder: str | Path) -> FolderTransit:
    """Check and identify the transit in a folder.

    Raises the DataErrors of ``checked_folder``.
    """
    folder = Path(folder).resolve()
    manifest, sizes = checked_folder(folder)
    digest = _Digest()
    pack_into(folder, manifest, cast(IO[bytes], digest))
    return FolderTransit(
        folder, digest.hash.hexdigest(), digest.bytes, ArchiveContents("tar", manifest, sizes)
    )
