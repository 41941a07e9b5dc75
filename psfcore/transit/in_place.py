"""A transit in a folder that is not packed first. It is checked and identified like its archive; nothing is written.

This module imports no numerical library, so that the web process can use it.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast

from psfcore.errors import DataError
from psfcore.transit.archive import ArchiveContents, pack_into
from psfcore.transit.manifest import MANIFEST_NAME, read_manifest

_FITS_STARTS = (b"SIMPLE  =", b"\x1f\x8b")


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

    Raises DataError "no-manifest", "bad-manifest", "missing-file", and "not-fits" if a named file cannot be FITS.
    """
    folder = Path(folder).resolve()
    manifest = read_manifest(folder)
    sizes: dict[str, int] = {}
    for name in (MANIFEST_NAME, *manifest.files):
        path = folder / name
        if not path.is_file():
            message = f"expected every file that {MANIFEST_NAME} names in {folder}; missing: {name}"
            raise DataError("missing-file", message)
        sizes[name] = path.stat().st_size
        if name != MANIFEST_NAME:
            with path.open("rb") as file:
                start = file.read(len(_FITS_STARTS[0]))
            if not start.startswith(_FITS_STARTS):
                message = f"{name}: expected a FITS file, which starts with 'SIMPLE  ='; got {start!r}"
                raise DataError("not-fits", message)
    digest = _Digest()
    pack_into(folder, manifest, cast(IO[bytes], digest))
    return FolderTransit(
        folder, digest.hash.hexdigest(), digest.bytes, ArchiveContents("tar", manifest, sizes)
    )
