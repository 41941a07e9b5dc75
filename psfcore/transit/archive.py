"""A transit in one file, .zip, .tar or .tar.gz: list it, unpack it, and pack one.

The first bytes tell the kind. The members must be plain files with plain names, at the top level or in one folder.
``members`` reads them, ``admission`` says which are accepted. If an archive is refused, nothing of it is left on disk.

Standard library and the manifest only, so that the web process can list an upload.
"""

from __future__ import annotations

import io
import tarfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from psfcore.errors import DataError
from psfcore.transit.admission import ArchiveLimits
from psfcore.transit.manifest import (
    MANIFEST_NAME,
    MAX_MANIFEST_BYTES,
    TransitManifest,
    parse_manifest,
    read_manifest,
)
from psfcore.transit.members import START_BYTES, Kind, archive_kind, could_be_archive, opened

_CHUNK = 1 << 20
_FITS_STARTS = (b"SIMPLE  =", b"\x1f\x8b")


@dataclass(frozen=True)
class ArchiveContents:
    """What a list of an archive tells: its kind, its manifest, and the name and declared bytes of each file."""

    kind: Kind
    manifest: TransitManifest
    files: dict[str, int]


def list_archive(path: str | Path, limits: ArchiveLimits) -> ArchiveContents:
    """List an archive. It reads transit.json and the first bytes of every other file, and writes nothing.

    A .zip has a table of contents, and in a .tar the data can be skipped. A .tar.gz must be inflated from start
    to end, within the limits.
    Raises DataError as ``unpack`` does, and "no-manifest", "bad-manifest", "missing-file" if transit.json names a
    file that the archive does not contain, "not-fits" if a named file cannot be FITS.
    """
    files: dict[str, int] = {}
    starts: dict[str, bytes] = {}
    content: bytes | None = None
    with opened(Path(path), limits) as archive:
        for member in archive.members():
            files[member.name] = member.size_bytes
            if member.name == MANIFEST_NAME:
                content = member.read(MAX_MANIFEST_BYTES + 1)
            else:
                starts[member.name] = member.read(len(_FITS_STARTS[0]))
        kind = archive.kind
    if content is None:
        raise DataError("no-manifest", f"expected a file {MANIFEST_NAME} in the archive; add it")
    manifest = parse_manifest(content)
    for name in manifest.files:
        if name not in files:
            message = (
                f"expected the archive to contain every file that {MANIFEST_NAME} names; missing: {name}"
            )
            raise DataError("missing-file", message)
        if not starts[name].startswith(_FITS_STARTS):
            message = f"{name}: expected a FITS file, which begins with 'SIMPLE  ='; got {starts[name]!r}"
            raise DataError("not-fits", message)
    return ArchiveContents(kind, manifest, files)


def unpack(path: str | Path, folder: str | Path, limits: ArchiveLimits) -> tuple[str, ...]:
    """Write the files of an archive into a folder; returns their names. The folder is created if needed.

    If all files are in one folder of the archive, that folder's name is dropped. Hidden files and files that operating
    systems add are skipped.
    Raises DataError, and then leaves nothing behind: "not-an-archive"; "archive-climbs" for a name that leads out of
    the folder; "archive-not-plain" for links, devices, sparse or encrypted files, nested folders, a name that occurs
    twice, a name that no file may have; "archive-too-large" if there are more bytes or members than the limits allow;
    "archive-broken". Passes on OSError of the disk.
    """
    folder = Path(folder)
    names: list[str] = []
    with ExitStack() as undo:
        if not folder.exists():
            folder.mkdir(parents=True)
            undo.callback(folder.rmdir)
        with opened(Path(path), limits) as archive:
            for member in archive.members():
                target = folder / member.name
                with target.open("xb") as file:
                    undo.callback(target.unlink)
                    while chunk := member.read(_CHUNK):
                        file.write(chunk)
                names.append(member.name)
        undo.pop_all()  # success: keep the files
    return tuple(names)


def pack(folder: str | Path, path: str | Path) -> TransitManifest:
    """Write the transit in a folder as a .tar: transit.json and the files that it names.

    Equal files give equal bytes: the hash of the archive is the identity of the transit.

    Raises DataError "no-manifest", "bad-manifest", "missing-file".
    """
    manifest = read_manifest(Path(folder))
    with Path(path).open("wb") as file:
        pack_into(Path(folder), manifest, file)
    return manifest


def pack_into(folder: Path, manifest: TransitManifest, target: IO[bytes]) -> None:
    """Write the .tar that ``pack`` writes to an open file, of which only ``write`` and ``tell`` are called."""
    with tarfile.open(fileobj=target, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for name in (MANIFEST_NAME, *manifest.files):
            if not (folder / name).is_file():
                message = f"expected every file that {MANIFEST_NAME} names; missing: {name}"
                raise DataError("missing-file", message)
            with (folder / name).open("rb") as file:
                entry = tarfile.TarInfo(name)  # with its default owner, mode and time: constants
                entry.size = file.seek(0, io.SEEK_END)
                file.seek(0)
                archive.addfile(entry, file)


__all__ = [
    "START_BYTES",
    "ArchiveContents",
    "ArchiveLimits",
    "archive_kind",
    "could_be_archive",
    "list_archive",
    "pack",
    "unpack",
]
