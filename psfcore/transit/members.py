"""The members of a .zip, .tar or .tar.gz, read one after the other by ``zipfile`` and ``tarfile``.

No field of an archive can be trusted: an attacker may have written it. The gate checks each member before its bytes are
read, and unpacked bytes are counted as they are read. The two libraries do not limit the memory and the time that they
use. This module gives them file objects that enforce limits (``_BoundedFile``, ``_TarInput``).

This module imports no numerical library, so that the web process can list an upload.
"""

from __future__ import annotations

import errno
import io
import re
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, BinaryIO, Literal, Self, cast

from psfcore.errors import DataError
from psfcore.files import GzipStream
from psfcore.transit.admission import Admitted, ArchiveLimits, Gate, not_plain, shown

Kind = Literal["zip", "tar", "tar.gz"]
START_BYTES = 262  # number of bytes at the start of a file that identify its kind
_CHUNK = 1 << 20
# The kinds of files, and bytes at a position that identify them.
_STARTS: tuple[tuple[Literal["zip", "tar", "gzip"], int, bytes], ...] = (
    ("zip", 0, b"PK\x03\x04"),
    ("zip", 0, b"PK\x05\x06"),
    ("gzip", 0, b"\x1f\x8b"),
    ("tar", 257, b"ustar"),
)
_MAX_HEADER_BYTES = 1 << 16  # limit for all headers of one member together: pax records, GNU long names
_MAX_GLOBAL_RECORDS = 64
_PAX_TYPES = (tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE)
_PAX_RECORD = re.compile(rb"([1-9]\d{0,5}) [^=\n]+=")
_MANY_DIGITS = re.compile(rb"\d{65}")
_ZIP_ENTRY = b"PK\1\2"
_DIRECTORY_BYTES_PER_MEMBER = (
    512  # upper estimate of the mean size of an entry in a zip file's table of contents
)
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
    """The kind of a file from its first START_BYTES, or None. ``opened`` checks that a gzip file contains a tar."""
    return next((kind for kind, at, known in _STARTS if start[at:].startswith(known)), None)


class Member:
    """A file in an archive. folder: the folder of the file in the archive.

    gate: counts the unpacked bytes; None if another object counts them.
    """

    def __init__(self, file: Admitted, size_bytes: int, stream: IO[bytes], gate: Gate | None = None) -> None:
        self.folder, self.name, self.size_bytes = file.folder, file.name, size_bytes
        self._stream, self._gate, self._read = stream, gate, 0

    def read(self, count: int) -> bytes:
        """Read the next bytes; b"" at the end. Raises DataError "archive-broken", "archive-too-large"."""
        got = self._stream.read(count)  # zipfile checks the CRC at the end
        self._read += len(got)
        if self._gate is not None:
            self._gate.count_unpacked(len(got))
        if self._read > self.size_bytes or (len(got) < count and self._read != self.size_bytes):
            message = (
                f"expected {self.size_bytes} bytes in {shown(self.name)}, as declared; got {self._read}: pack or copy the "
                "archive again"
            )
            raise DataError("archive-broken", message)
        return got


@dataclass(frozen=True)
class OpenArchive:
    """An archive that is open for reading, once, from its start to its end.

    members: the accepted members, which may include files that are not in the main folder of the gate. Each member must be
    read before the next member is requested.
    """

    kind: Kind
    gate: Gate
    members: Iterator[Member]


@contextmanager
def opened(path: Path, limits: ArchiveLimits) -> Iterator[OpenArchive]:
    """Open an archive. An error from a damaged archive, here or in the with block, becomes DataError "archive-broken".

    Raises DataError "not-an-archive", "archive-climbs", "archive-not-plain", "archive-too-large", "archive-broken".
    An OSError of the disk is raised unchanged.
    """
    with path.open("rb") as file:
        kind = archive_kind(file.read(START_BYTES))
        size = file.seek(0, io.SEEK_END)
        file.seek(0)
        gate = Gate(limits, size)
        try:
            if kind == "zip":
                with zipfile.ZipFile(cast(IO[bytes], _BoundedFile(file, gate))) as archive:
                    yield OpenArchive("zip", gate, _zip_members(archive, gate))
            elif kind == "tar":
                yield OpenArchive("tar", gate, _tar_members(_TarInput(file, gate, size), gate))
            elif kind == "gzip":
                stream = GzipStream(file)
                if archive_kind(stream.read(START_BYTES)) != "tar":
                    message = "expected a .zip, .tar or .tar.gz; got a gzip file that contains no tar"
                    raise DataError("not-an-archive", message)
                stream.rewind()
                yield OpenArchive("tar.gz", gate, _tar_members(_TarInput(cast(BinaryIO, stream), gate), gate))
            else:
                raise DataError("not-an-archive", "expected a .zip, .tar or .tar.gz; got another format")
        except DataError:
            raise
        except _DAMAGE as error:
            if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
                raise  # an error of the disk, not of the archive
            reason = " ".join(str(error).split()) or type(error).__name__
            raise DataError(
                "archive-broken", f"expected an intact archive; got: {reason:.120}: pack or copy it again"
            ) from None


def _truncated() -> DataError:
    return DataError(
        "archive-broken", "expected a complete archive; got one that ends too early: pack or copy it again"
    )


# --- zip --------------------------------------------------------------------------------------------------


class _BoundedFile:
    """The file that ``zipfile`` reads. A single read is limited to the size of the largest allowed central directory.

    zipfile reads the whole central directory in one read and makes an object for each entry. This class counts the
    entries by their signature before zipfile makes the objects.
    """

    def __init__(self, file: BinaryIO, gate: Gate) -> None:
        self._file = file
        self._gate = gate
        self._most = max(_CHUNK, gate.limits.max_files * _DIRECTORY_BYTES_PER_MEMBER)

    def read(self, count: int = -1) -> bytes:
        got = self._file.read(self._most + 1 if count < 0 else min(count, self._most + 1))
        if len(got) > self._most:
            message = (
                f"expected a table of contents of at most {self._most} bytes; got more: pack fewer files, or shorten their "
                "names"
            )
            raise DataError("archive-too-large", message)
        if got.startswith(_ZIP_ENTRY):
            self._gate.check_members(got.count(_ZIP_ENTRY))
        return got

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def seekable(self) -> bool:
        return True


def _zip_members(archive: zipfile.ZipFile, gate: Gate) -> Iterator[Member]:
    """Yield the accepted members; all entries are checked before the first member is read."""
    entries = archive.infolist()
    gate.count_members(len(entries))
    admitted = [(info, file) for info in entries if (file := _admit_entry(info, gate)) is not None]
    main = gate.main_folder()
    for info, file in admitted:
        if file.folder == main:
            with archive.open(info) as stream:
                yield Member(file, info.file_size, stream, gate)


def _admit_entry(info: zipfile.ZipInfo, gate: Gate) -> Admitted | None:
    """The file of an entry; None for a folder and for a file that must be skipped."""
    kind = stat.S_IFMT(info.external_attr >> 16) if info.create_system != 0 else 0
    if info.orig_filename.endswith("/") and kind in (0, stat.S_IFDIR):
        gate.check_folder(info.orig_filename)
        return None
    file = gate.admit(info.orig_filename, info.file_size)
    if file is None:
        return None
    if kind not in (0, stat.S_IFREG):
        raise not_plain(info.orig_filename, "expected only plain files, no links or devices")
    if info.flag_bits & _ZIP_ENCRYPTED:
        raise not_plain(info.orig_filename, "expected files that are not encrypted")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        message = f"expected stored or deflated files, not compression method {info.compress_type}"
        raise not_plain(info.orig_filename, message)
    # Deflate adds at most five bytes per block. If the compressed size is far larger, the declared size is wrong.
    if info.compress_size > 2 * info.file_size + 1024:
        got = f"{info.compress_size} compressed bytes for a declared size of {info.file_size} bytes"
        message = f"{shown(info.orig_filename)}: expected sizes that agree; got {got}"
        raise DataError("archive-broken", message)
    return file


# --- tar --------------------------------------------------------------------------------------------------


class _TarInput:
    """The file that ``tarfile`` reads. It is read only forward, every byte is counted, and the size of headers is limited.

    tarfile trusts the sizes in headers. It reads a pax header or a GNU long name of any size in one read. It follows any
    number of such headers by recursion, and it collects the maps of sparse files without a limit. Here all headers of
    one member together may have at most _MAX_HEADER_BYTES. This bounds memory and time in all three cases. Seeking
    backwards is refused, because a .tar.gz would be decompressed again from its start. tarfile does not seek backwards
    if members are read in order.

    size: the size of the file, if data can be skipped by seeking. None: data cannot be skipped by seeking, so skipped
    data is also read and counted.
    """

    def __init__(self, file: BinaryIO, gate: Gate, size: int | None = None) -> None:
        self._file, self._gate, self._size = file, gate, size
        self._at = 0
        self.header_bytes_left: int | None = _MAX_HEADER_BYTES  # None: the data of a member are read
        self.pax_text_is_next = False

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int) -> int:
        if offset < self._at:
            raise ValueError("a member that starts before the end of the previous member")
        if self._size is not None:
            if offset > self._size:
                raise _truncated()
            self._at = self._file.seek(offset)
        while self._at < offset:
            if not self._counted(min(offset - self._at, _CHUNK)):
                raise _truncated()
        return self._at

    def read(self, count: int) -> bytes:
        if self.header_bytes_left is not None:
            if not 0 <= count <= self.header_bytes_left:
                message = (
                    f"expected at most {_MAX_HEADER_BYTES} bytes of headers for one member; got more: pack the files again, "
                    "for example as .zip"
                )
                raise DataError("archive-broken", message)
            self.header_bytes_left -= count
        got = self._counted(count)
        if self.pax_text_is_next:
            self.pax_text_is_next = False
            _check_pax_records(got)
        return got

    def _counted(self, count: int) -> bytes:
        got = self._file.read(count)
        self._at += len(got)
        self._gate.count_unpacked(len(got))
        return got


def _check_pax_records(text: bytes) -> None:
    """Raise DataError "archive-broken" if a pax header contains anything but records "length key=value\\n".

    On some other texts, such as long runs of digits, the regular expressions of tarfile need quadratic time and memory
    (CVE-2024-6232).
    """
    at = 0
    while at < len(text) and text[at] != 0:
        record = _PAX_RECORD.match(text, at)
        end = at + int(record[1]) if record else at
        if record is None or end <= record.end() or text[end - 1 : end] != b"\n":
            raise DataError(
                "archive-broken",
                "expected pax records 'length key=value'; got other text: pack or copy the archive again",
            )
        at = end
    if _MANY_DIGITS.search(text):
        raise DataError(
            "archive-broken",
            "expected pax records with at most 64 digits in a row; got more: pack the files again, for example as .zip",
        )


def _checked_headers(source: _TarInput, gate: Gate) -> type[tarfile.TarInfo]:
    """A TarInfo class that checks every header block: tarfile calls its ``frombuf`` for each block."""

    class Header(tarfile.TarInfo):
        @classmethod
        def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
            if len(buf) < tarfile.BLOCKSIZE:
                # tarfile would accept an incomplete or damaged header as the end of the archive.
                raise _truncated()
            if not any(buf):
                # An empty block ends the archive: tarfile raises the exception that it expects at the end.
                return super().frombuf(buf, encoding, errors)
            gate.count_members()
            try:
                header = super().frombuf(buf, encoding, errors)
            except tarfile.HeaderError as error:
                raise DataError(
                    "archive-broken", f"expected a tar header; got a {error}: pack or copy the archive again"
                ) from None
            if header.type == tarfile.GNUTYPE_SPARSE:
                raise not_plain(header.name, "expected only plain files, no sparse ones")
            source.pax_text_is_next = header.type in _PAX_TYPES
            return header

    return Header


def _tar_members(source: _TarInput, gate: Gate) -> Iterator[Member]:
    """Yield the accepted members, each after its header was checked."""
    with tarfile.TarFile(  # the constructor reads the first header
        fileobj=cast(IO[bytes], source),
        tarinfo=_checked_headers(source, gate),
        encoding="utf-8",
        errors="surrogateescape",
    ) as archive:
        while True:
            source.header_bytes_left = _MAX_HEADER_BYTES
            info = archive.next()
            source.header_bytes_left = None
            if info is None:
                return
            # Each member gets a copy of the global records.
            if len(archive.pax_headers) > _MAX_GLOBAL_RECORDS:
                message = (
                    f"expected at most {_MAX_GLOBAL_RECORDS} global pax records; got more: pack the files again, for "
                    "example as .zip"
                )
                raise DataError("archive-broken", message)
            file = _admit_header(info, gate)
            info.pax_headers = {}  # to save memory, because tarfile keeps each TarInfo
            stream = None if file is None else archive.extractfile(info)
            if file is not None and stream is not None:
                with stream:
                    yield Member(file, info.size, stream)


def _admit_header(info: tarfile.TarInfo, gate: Gate) -> Admitted | None:
    """The file of a header; None for a folder and for a file that must be skipped."""
    if any(key.startswith("GNU.sparse") for key in info.pax_headers):
        raise not_plain(info.name, "expected only plain files, no sparse ones")
    if info.isdir():
        gate.check_folder(info.name)
        return None
    if not info.isreg() or info.size < 0:
        raise not_plain(info.name, "expected only plain files, no links or devices")
    return gate.admit(info.name, info.size)
