"""Copy the files of a .zip, .tar or .tar.gz into one file, in a process of its own (`psfcore.limited`).

No field of an archive can be trusted: an attacker may have written it. ``zipfile`` and ``tarfile`` limit neither the
memory nor the time that they use; the process limits both. `admission` decides which members are accepted.
"""

from __future__ import annotations

import errno
import gzip
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import IO, BinaryIO, Literal, NamedTuple, cast

from psfcore.errors import DataError
from psfcore.files import GZIP_START
from psfcore.transit.admission import (
    MANIFEST_NAME,
    MAX_MANIFEST_BYTES,
    Admitted,
    ArchiveLimits,
    Gate,
    not_plain,
    shown,
)

Kind = Literal["zip", "tar", "tar.gz"]
START_BYTES = 262  # number of bytes at the start of a file that identify its kind
_PIECE_BYTES = 1 << 16  # a larger piece gets new memory from the system each time
# The kinds of files, and bytes at a position that identify them.
_STARTS: tuple[tuple[Literal["zip", "tar", "gzip"], int, bytes], ...] = (
    ("zip", 0, b"PK\x03\x04"),
    ("zip", 0, b"PK\x05\x06"),
    ("gzip", 0, GZIP_START),
    ("tar", 257, b"ustar"),
)
_NO_PLAIN_FILE = "expected only plain files, no links, devices or sparse files"
_ZIP_ENCRYPTED = 0x1 | 0x40 | 0x2000
# The exceptions that a damaged archive raises, depending on where the damage is.
_DAMAGE = (
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    ValueError,
    LookupError,
    ArithmeticError,
    NotImplementedError,
    RuntimeError,
)


def could_be_archive(start: bytes) -> bool:
    """False if the first bytes of a file rule out every kind of archive. `start` may have any length."""
    return any(known.startswith(start[at : at + len(known)]) for _, at, known in _STARTS)


def archive_kind(start: bytes) -> Literal["zip", "tar", "gzip"] | None:
    """The kind of a file from its first START_BYTES, or None. ``copy_files`` checks that a gzip file contains a tar."""
    return next((kind for kind, at, known in _STARTS if start[at:].startswith(known)), None)


class Copied(NamedTuple):
    """A file of an archive, and where its bytes are: ``length`` bytes from position ``at`` of the target of
    ``copy_files``, or of the archive itself if whole files of a .tar were asked for, which holds plain bytes.

    Attributes
    ----------
    size_bytes
        The declared size of the file.
    """

    name: str
    size_bytes: int
    at: int
    length: int


@dataclass(frozen=True)
class _Entry:
    """A member of an archive.

    Attributes
    ----------
    fault
        The reason why the member is not a plain file; empty: it is a plain file.
    at
        The position of the plain bytes of the member in a .tar; None in other archives, where ``open`` gives these
        bytes.
    """

    name: str
    size_bytes: int
    is_folder: bool
    fault: str
    at: int | None
    open: Callable[[], IO[bytes]]


def copy_files(
    target: BinaryIO, *, path: str, limits: dict[str, int], start_bytes: int | None
) -> dict[str, object]:
    """Find the files of a transit in its archive, and copy them to ``target``. Call it in a limited process.

    Returns "kind", and "files" with the values of a ``Copied`` for each file. Files of folders beside the transit are
    checked too; their bytes in ``target`` mean nothing.

    Raises DataError "not-an-archive", "archive-climbs", "archive-not-plain", "archive-too-large", "archive-broken". An
    OSError of the disk is raised unchanged.

    Parameters
    ----------
    target
        The open file to which the bytes are written.
    path
        The file of the archive.
    limits
        The values of ``ArchiveLimits``.
    start_bytes
        How many bytes to copy of the start of each file, see `plain_start`; None: all bytes. Of transit.json,
        MAX_MANIFEST_BYTES and one more are copied.
    """
    gate = Gate(ArchiveLimits(**limits))
    found: list[tuple[Admitted, Copied]] = []
    with _damage_told():
        kind = _kind(path)
        for entry in _zip_entries(path) if kind == "zip" else _tar_entries(path, kind):
            gate.count(entry.size_bytes)
            if entry.is_folder:
                gate.check_folder(entry.name)
                continue
            file = gate.admit(entry.name, entry.size_bytes)
            if file is not None and entry.fault:
                raise not_plain(entry.name, entry.fault)
            if file is None or gate.is_beside(file):
                continue
            at, count = entry.at, entry.size_bytes
            if start_bytes is not None:
                with entry.open() as stream:
                    start = plain_start(
                        stream, MAX_MANIFEST_BYTES + 1 if file.name == MANIFEST_NAME else start_bytes
                    )
                at, count = target.tell(), target.write(start)
            elif at is None:
                at = target.tell()
                with entry.open() as stream:  # it ends at the declared size; zipfile then checks the CRC
                    copy_bytes(stream, target, count, entry.name)
            found.append((file, Copied(file.name, entry.size_bytes, at, count)))
        main = gate.main_folder()
    return {"kind": kind, "files": [copied for file, copied in found if file.folder == main]}


def plain_start(file: IO[bytes], count: int) -> bytes:
    """The first bytes of a file, decompressed if it is in gzip; as they stand if that fails."""
    start = file.read(count)
    if start.startswith(GZIP_START):
        with suppress(zlib.error):
            return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(start, count)
    return start


def copy_bytes(source: IO[bytes], target: IO[bytes], count: int, name: str) -> None:
    """Copy the next bytes of an open file.

    Raises DataError "archive-broken" if there are fewer.

    Parameters
    ----------
    name
        Name of the file, for the error.
    """
    while count and (piece := source.read(min(count, _PIECE_BYTES))):
        target.write(piece)
        count -= len(piece)
    if count:
        message = f"expected {count} more bytes in {shown(name)}, as declared; got its end"
        raise DataError("archive-broken", f"{message}: pack or copy the archive again")


@contextmanager
def _damage_told() -> Iterator[None]:
    """Make a DataError "archive-broken" of the exceptions that a damaged archive causes in the libraries."""
    try:
        yield
    except DataError:
        raise
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise  # an error of the disk, not of the archive
        reason = " ".join(str(error).split()) or type(error).__name__
        message = f"expected an intact archive; got: {reason:.120}: pack or copy it again"
        raise DataError("archive-broken", message) from None


def _kind(path: str) -> Kind:
    """The kind of an archive by its first bytes. Raises DataError "not-an-archive"."""
    with open(path, "rb") as file:
        kind = archive_kind(file.read(START_BYTES))
    if kind == "gzip":
        with gzip.open(path) as stream:
            if archive_kind(stream.read(START_BYTES)) == "tar":
                return "tar.gz"
    elif kind is not None:
        return kind
    message = (
        "expected a .zip, .tar or .tar.gz; got "
        f"{'a gzip file that contains no tar' if kind else 'another format'}"
    )
    raise DataError("not-an-archive", message)


def _zip_entries(path: str) -> Iterator[_Entry]:
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            kind = stat.S_IFMT(info.external_attr >> 16) if info.create_system != 0 else 0
            is_folder = info.orig_filename.endswith("/") and kind in (0, stat.S_IFDIR)
            fault = ""
            if kind not in (0, stat.S_IFREG):
                fault = _NO_PLAIN_FILE
            elif info.flag_bits & _ZIP_ENCRYPTED:
                fault = "expected files that are not encrypted"
            elif info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                fault = f"expected stored or deflated files, not compression method {info.compress_type}"
            yield _Entry(
                info.orig_filename, info.file_size, is_folder, fault, None, partial(archive.open, info)
            )


def _tar_entries(path: str, kind: Kind) -> Iterator[_Entry]:
    with tarfile.open(path, "r:gz" if kind == "tar.gz" else "r:", encoding="utf-8") as archive:
        while (info := archive.next()) is not None:
            if info.size < 0:  # the next member would be one of those before
                raise not_plain(info.name, "expected a size of 0 bytes or more")
            is_sparse = info.issparse() or any(key.startswith("GNU.sparse") for key in info.pax_headers)
            fault = "" if info.isreg() and not is_sparse else _NO_PLAIN_FILE
            at = info.offset_data if kind == "tar" else None
            yield _Entry(info.name, info.size, info.isdir(), fault, at, partial(_content, archive, info))
        # tarfile takes an incomplete or damaged header for the end of the archive, which is an empty block.
        file = cast(BinaryIO, archive.fileobj)
        file.seek(archive.offset)
        if file.read(tarfile.BLOCKSIZE) != bytes(tarfile.BLOCKSIZE):
            raise EOFError("a damaged header, or the file ends too early")


def _content(archive: tarfile.TarFile, info: tarfile.TarInfo) -> IO[bytes]:
    return cast(IO[bytes], archive.extractfile(info))
