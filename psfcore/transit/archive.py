"""A transit in one archive file (.zip, .tar or .tar.gz), or in a folder: list, unpack, pack and identify it.

The first bytes of the file identify the kind of archive. The members must be plain files with plain names, at the top
level or in one folder. A limited process reads them (`members`), and `admission` decides which of them are accepted.
This process handles the names and plain bytes that come back. If an archive is refused, none of its files is left on
disk.

This module imports no numerical library, so that the web process can list an upload.
"""

from __future__ import annotations

import hashlib
import io
import re
import tarfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, BinaryIO, cast

from psfcore.errors import DataError, together
from psfcore.files import GZIP_START
from psfcore.limited import run_limited
from psfcore.transit.admission import ArchiveLimits, is_plain_name
from psfcore.transit.manifest import MANIFEST_NAME, TransitManifest, parse_manifest, read_manifest
from psfcore.transit.members import START_BYTES as START_BYTES
from psfcore.transit.members import Copied, Kind, copy_bytes, copy_files, plain_start
from psfcore.transit.members import archive_kind as archive_kind
from psfcore.transit.members import could_be_archive as could_be_archive

_FITS_STARTS = (b"SIMPLE  =", GZIP_START)
_HEADER_BYTES = 4 * 2880  # contain the header of the first image, also if it is compressed in an extension
_AXIS = re.compile(rb"(Z?NAXIS[12]) *= +(\d{1,9}) ")
SECONDS, BYTES_A_SECOND = (
    10,
    20_000_000,
)  # processor time that an archive may take; headers can be made to take long
BYTES_A_PIXEL = 4  # of a file whose start does not tell its shape


@dataclass(frozen=True)
class ArchiveContents:
    """The contents of an archive: its kind, its manifest, the name and the declared bytes of each file, and the number
    of pixels of all images that the manifest names.
    """

    kind: Kind
    manifest: TransitManifest
    files: dict[str, int]
    pixels: int


@dataclass(frozen=True)
class FolderTransit:
    """A folder with a transit that is not packed.

    Attributes
    ----------
    sha256, bytes
        Hash and size of the .tar file that ``pack`` would write.
    """

    folder: Path
    sha256: str
    bytes: int
    contents: ArchiveContents


def list_archive(path: str | Path, limits: ArchiveLimits) -> ArchiveContents:
    """List an archive. The function reads transit.json and the first bytes of every other file.

    A .zip has a table of contents, and in a .tar the data can be skipped. A .tar.gz must be decompressed from start to
    end, within the limits.
    Raises the DataErrors of ``unpack``, and these:

    - "no-manifest" if the archive contains no transit.json;
    - "bad-manifest" if transit.json cannot be read, or has wrong content;
    - "missing-file" if transit.json names a file that the archive does not contain;
    - "not-fits" if a file that transit.json names cannot be a FITS file.

    If several files are missing or cannot be FITS files, one error names all of them.
    """
    with _files_in(Path(path), limits, start_bytes=_HEADER_BYTES) as (kind, found, source):
        first = {}
        for file in found:
            source.seek(file.at)
            first[file.name] = source.read(file.length)
    described = first.pop(MANIFEST_NAME, None)
    if described is None:
        raise DataError("no-manifest", f"expected a file {MANIFEST_NAME} in the archive; add it")
    manifest = parse_manifest(described)
    files = {file.name: file.size_bytes for file in found}
    _check_files(manifest, first, "the archive")
    return ArchiveContents(kind, manifest, files, _pixels(manifest, first, files))


def unpack(path: str | Path, folder: str | Path, limits: ArchiveLimits) -> tuple[str, ...]:
    """Write the files of an archive into a folder; returns their names. The folder is created if needed.

    If all files are in one folder of the archive, that folder's name is dropped. Hidden files, files that operating
    systems add, and files of folders beside the transit's files are skipped.
    If the function fails, it first removes all files that it wrote. Raises OSError, and these DataErrors:

    - "not-an-archive" if the file is neither a .zip nor a .tar nor a .tar.gz;
    - "archive-climbs" if a name leads out of the folder;
    - "archive-not-plain" for links, devices, sparse or encrypted files, deeper folders, a name that occurs twice, and a
      name that is not a plain file name;
    - "archive-too-large" if there are more bytes or members than the limits allow;
    - "archive-broken" if the archive is damaged.
    """
    folder = Path(folder)
    with ExitStack() as undo:
        if not folder.exists():
            folder.mkdir(parents=True)
            undo.callback(folder.rmdir)
        with _files_in(Path(path), limits, scratch=folder) as (kind, found, source):
            for file in reversed(found):
                target = folder / file.name
                with target.open("xb") as plain:
                    undo.callback(target.unlink, missing_ok=True)
                    source.seek(file.at)
                    copy_bytes(source, plain, file.length, file.name)
                if kind != "tar":
                    source.truncate(file.at)  # no byte is on the disk twice
        undo.pop_all()  # success: keep the files
    return tuple(file.name for file in found)


@contextmanager
def _files_in(
    path: Path, limits: ArchiveLimits, *, scratch: Path | None = None, start_bytes: int | None = None
) -> Iterator[tuple[Kind, list[Copied], BinaryIO]]:
    """The kind of an archive, its files in their order, and the file with their plain bytes.

    Parameters
    ----------
    scratch
        The folder of a temporary file.
    start_bytes
        The number of bytes that are needed of each file (``copy_files``).
    """
    with path.open("rb") as archive, TemporaryFile(dir=scratch) as temporary:
        content = cast(BinaryIO, temporary)
        size = path.stat().st_size
        bounds = asdict(limits.of_archive(size))
        seconds = SECONDS + size // BYTES_A_SECOND
        try:
            answer = run_limited(
                copy_files,
                path,
                content,
                pixels=0,
                seconds=seconds,
                answer_bytes=bounds["max_bytes"] + bounds["max_files"] * (start_bytes or 0),
                limits=bounds,
                start_bytes=start_bytes,
            )
        except DataError as error:
            if error.code != "unreadable-pixels":
                raise
            message = (
                "expected an archive that is read in the memory and time that its size explains; got one that "
                "needs more"
            )
            raise DataError(
                "archive-broken", f"{message}: pack the files again, for example as .zip"
            ) from None
        found = [Copied(*row) for row in answer["files"]]
        if not all(is_plain_name(file.name) for file in found):  # the process may have been misused
            raise DataError("archive-broken", "expected plain file names; got others: pack the archive again")
        in_archive = answer["kind"] == "tar" and start_bytes is None
        yield answer["kind"], found, archive if in_archive else content


def pack(folder: str | Path, path: str | Path) -> TransitManifest:
    """Write the transit in a folder as a .tar: transit.json and the files that it names.

    Equal files give equal bytes, so the hash of the archive is the identity of the transit.

    Raises the DataErrors of ``checked_folder``, before anything is written.
    """
    manifest = checked_folder(Path(folder)).manifest
    with Path(path).open("wb") as file:
        _pack_into(Path(folder), manifest, file)
    return manifest


def checked_folder(folder: Path) -> ArchiveContents:
    """The contents of the transit in a folder.

    Raises DataError "no-manifest", "bad-manifest", "missing-file" and "not-fits", as ``list_archive`` does.
    """
    manifest = read_manifest(folder)
    starts: dict[str, bytes] = {}
    for name in manifest.files:
        if (folder / name).is_file():
            with (folder / name).open("rb") as file:
                starts[name] = plain_start(file, _HEADER_BYTES)
    _check_files(manifest, starts, str(folder))
    files = {name: (folder / name).stat().st_size for name in (MANIFEST_NAME, *manifest.files)}
    return ArchiveContents("tar", manifest, files, _pixels(manifest, starts, files))


def _pixels(manifest: TransitManifest, starts: Mapping[str, bytes], files: Mapping[str, int]) -> int:
    """The pixels of all images, from the starts of their files."""
    count = 0
    for name in {image.file for image in manifest.images}:
        start = starts[name]
        axes = {key: int(length) for key, length in _AXIS.findall(start)}
        ny, nx = (axes.get(b"ZNAXIS" + n, axes.get(b"NAXIS" + n, 0)) for n in (b"2", b"1"))
        count += ny * nx or files[name] // BYTES_A_PIXEL
    return count


def _check_files(manifest: TransitManifest, starts: Mapping[str, bytes], where: str) -> None:
    """Raise DataError if files that the manifest names are missing, or cannot be FITS by their first bytes."""
    missing = [
        DataError(
            "missing-file",
            f"{name}: expected this file in {where}, because {MANIFEST_NAME} names it; it is missing: add it",
        )
        for name in manifest.files
        if name not in starts
    ]
    no_fits = [
        DataError(
            "not-fits",
            f"{name}: expected a FITS file, which begins with 'SIMPLE  ='; got {start[: len(_FITS_STARTS[0])]!r}",
        )
        for name, start in starts.items()
        if name in manifest.files and not start.startswith(_FITS_STARTS)
    ]
    if missing or no_fits:
        raise together([*missing, *no_fits])


def transit_in(folder: str | Path) -> FolderTransit:
    """Check and identify the transit in a folder, like its archive; nothing is written.

    Raises the DataErrors of ``checked_folder``.
    """
    folder = Path(folder).resolve()
    contents = checked_folder(folder)
    digest = _Digest()
    _pack_into(folder, contents.manifest, cast(IO[bytes], digest))
    return FolderTransit(folder, digest.hash.hexdigest(), digest.bytes, contents)


class _Digest:
    """A file object for writing. It keeps only the SHA-256 and the number of the bytes that are written to it."""

    def __init__(self) -> None:
        self.hash = hashlib.sha256()
        self.bytes = 0

    def write(self, content: bytes) -> int:
        self.hash.update(content)
        self.bytes += len(content)
        return len(content)

    def tell(self) -> int:
        return self.bytes


def _pack_into(folder: Path, manifest: TransitManifest, target: IO[bytes]) -> None:
    """Write the .tar of ``pack`` into an open file. Only ``write`` and ``tell`` of this file are called."""
    with tarfile.open(fileobj=target, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for name in (MANIFEST_NAME, *manifest.files):
            with (folder / name).open("rb") as file:
                entry = tarfile.TarInfo(name)  # owner, mode and time keep their defaults, which are constants
                entry.size = file.seek(0, io.SEEK_END)
                file.seek(0)
                archive.addfile(entry, file)
