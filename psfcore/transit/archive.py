"""A transit in one file, .zip, .tar or .tar.gz: looked into, taken apart and put together.

Nothing in an archive is believed. Members are plain files of plain names, at the top or in one folder; what comes
out is counted as it comes out, whatever sizes are declared; what is refused leaves nothing behind. The kind is
told by content. A tar is walked here, block by block (POSIX.1-2001 pax, section "pax Interchange Format", and
GNU long names), because ``tarfile`` takes a header's word for how much to read at once.

Standard library and the manifest only, so that the web process may look into an upload.
"""

from __future__ import annotations

import errno
import gzip
import io
import re
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, BinaryIO, Literal, Protocol

from psfcore.errors import DataError
from psfcore.transit.manifest import (
    MANIFEST_NAME,
    MAX_MANIFEST_BYTES,
    TransitManifest,
    is_plain_name,
    parse_manifest,
    read_manifest,
)

Kind = Literal["zip", "tar", "tar.gz"]
START_BYTES = 262  # of a file, enough to tell its kind
RATIO_FLOOR_BYTES = 64 * 2**20  # below this much coming out, the ratio does not count
_CHUNK = 1 << 20
_BLOCK = tarfile.BLOCKSIZE
_TAR_MAGIC = b"ustar"
_TAR_MAGIC_AT = 257
_LONGEST_TAR_TEXT = 1 << 16  # bytes of a pax header or of a GNU long name
_DIRECTORY_BYTES_A_MEMBER = 512  # of a zip's table of contents, a generous mean
_ZIP_ENCRYPTED = 0x1 | 0x40 | 0x2000
_ZIP_METHODS = {zipfile.ZIP_STORED: "stored", zipfile.ZIP_DEFLATED: "deflated"}
_TAR_FILES = (tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.CONTTYPE)
_HIDDEN = ("__MACOSX", "PaxHeader", "PaxHeaders", "Thumbs.db", "desktop.ini")
_FITS_STARTS = (b"SIMPLE  =", b"\x1f\x8b")
# What a damaged archive raises, depending on where the damage is.
_TROUBLE = (
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


@dataclass(frozen=True)
class ArchiveLimits:
    """Bounds on what comes out of an archive.

    max_files: members of any kind, the hidden ones too. max_bytes: all together. max_member_bytes: one of them. max_ratio: what comes out
    over the archive's own size, once that is more than RATIO_FLOOR_BYTES.
    """

    max_files: int = 16_384
    max_bytes: int = 8 * 2**30
    max_ratio: float = 200.0
    max_member_bytes: int = 2**30

    def budget_bytes(self, archive_bytes: int) -> int:
        """All that may come out of an archive of this size."""
        return min(self.max_bytes, max(RATIO_FLOOR_BYTES, int(self.max_ratio * archive_bytes)))


@dataclass(frozen=True)
class ArchiveContents:
    """What an archive's table of contents shows: its kind, its manifest, and each file's name and declared bytes."""

    kind: Kind
    manifest: TransitManifest
    files: dict[str, int]


def could_be_archive(start: bytes) -> bool:
    """False as soon as the first bytes of a file (any number of them) rule out every kind."""
    if _starts_like(start, b"PK\x03\x04") or _starts_like(start, b"PK\x05\x06"):
        return True
    if _starts_like(start, b"\x1f\x8b"):
        return True
    return _starts_like(start[_TAR_MAGIC_AT:], _TAR_MAGIC)


def archive_kind(start: bytes) -> Literal["zip", "tar", "gzip"] | None:
    """The kind by the first START_BYTES of a file, or None. What a gzip holds is seen when it is read."""
    if start.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return "zip"
    if start.startswith(b"\x1f\x8b"):
        return "gzip"
    return "tar" if start[_TAR_MAGIC_AT:].startswith(_TAR_MAGIC) else None


def list_archive(path: str | Path, limits: ArchiveLimits) -> ArchiveContents:
    """What is in an archive, by its table of contents; transit.json is read, the images are not.

    Of an image the first bytes are looked at. A .tar.gz has no table: it is inflated from end to end, within
    the limits, and nothing is kept.
    Raises DataError as ``unpack`` does, and "no-manifest", "bad-manifest", "missing-file" where transit.json
    names a file that is not there, "not-fits" where a file named cannot be FITS.
    """
    files: dict[str, int] = {}
    starts: dict[str, bytes] = {}
    content: bytes | None = None
    with _opened(Path(path), limits) as archive:
        for member in archive.members():
            files[member.name] = member.size_bytes
            if member.name == MANIFEST_NAME:
                content = member.read(MAX_MANIFEST_BYTES + 1)
            else:
                starts[member.name] = member.read(len(_FITS_STARTS[0]))
        kind = archive.kind
    if content is None:
        raise DataError("no-manifest", f"expected a file {MANIFEST_NAME} in the archive; got none")
    manifest = parse_manifest(content)
    for name in manifest.files:
        if name not in files:
            message = f"expected every file that {MANIFEST_NAME} names in the archive; missing: {name}"
            raise DataError("missing-file", message)
        if not starts[name].startswith(_FITS_STARTS):
            message = f"{name}: expected a FITS file, which starts with 'SIMPLE  ='; got {starts[name]!r}"
            raise DataError("not-fits", message)
    return ArchiveContents(kind, manifest, files)


def unpack(path: str | Path, folder: str | Path, limits: ArchiveLimits) -> tuple[str, ...]:
    """Write an archive's files into a folder, which is made where it is not there; returns their names.

    A single folder at the top of the archive is taken off; hidden files and those that systems add are left out.
    Raises DataError and leaves nothing behind: "not-an-archive"; "archive-climbs" for a name that leads
    elsewhere; "archive-not-plain" for links, devices, encryption, further folders, the same name twice, names that
    cannot be a file's; "archive-too-large" where more comes out than the limits allow, or too many members;
    "archive-broken". Passes on OSError of the disk.
    """
    folder = Path(folder)
    names: list[str] = []
    with ExitStack() as undo:
        if not folder.exists():
            folder.mkdir(parents=True)
            undo.callback(folder.rmdir)
        with _opened(Path(path), limits) as archive:
            for member in archive.members():
                target = folder / member.name
                with target.open("xb") as file:
                    undo.callback(target.unlink)
                    while chunk := member.read(_CHUNK):
                        file.write(chunk)
                names.append(member.name)
        undo.pop_all()  # all is well: keep the files
    return tuple(names)


def pack(folder: str | Path, path: str | Path) -> TransitManifest:
    """Write the transit in a folder as a .tar: transit.json and what it names; equal files give equal bytes.

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
                entry = tarfile.TarInfo(name)  # owner, mode and time are constants
                entry.size = file.seek(0, io.SEEK_END)
                file.seek(0)
                archive.addfile(entry, file)


# --- members ----------------------------------------------------------------------------------------------


class _Member(Protocol):
    """A file in an archive; ``read`` gives its next bytes, and none at its end."""

    name: str
    size_bytes: int

    def read(self, count: int) -> bytes: ...


class _Archive(Protocol):
    kind: Kind

    def members(self) -> Iterator[_Member]: ...


@contextmanager
def _opened(path: Path, limits: ArchiveLimits) -> Iterator[_Archive]:
    """The archive at a path. What damage raises, here and in the block, becomes DataError "archive-broken"."""
    with path.open("rb") as file:
        kind = archive_kind(file.read(START_BYTES))
        size = file.seek(0, io.SEEK_END)
        file.seek(0)
        gate = _Gate(limits, size)
        try:
            if kind == "zip":
                with zipfile.ZipFile(_BoundedReads(file, limits)) as archive:
                    yield _Zip(archive, gate)
            elif kind == "tar":
                yield _Tar("tar", _Plain(file, size), gate)
            elif kind == "gzip":
                with gzip.GzipFile(fileobj=file, mode="rb") as stream:
                    yield _Tar("tar.gz", _Inflating(stream, gate), gate)
            else:
                raise DataError("not-an-archive", "expected a .zip, .tar or .tar.gz; got none of them")
        except DataError:
            raise
        except _TROUBLE as error:
            if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
                raise  # the disk's, not the archive's
            reason = " ".join(str(error).split()) or type(error).__name__
            raise DataError("archive-broken", f"expected a whole archive; got: {reason:.120}") from None


class _Gate:
    """What every member passes: its name, its number, its size, and what has come out so far."""

    def __init__(self, limits: ArchiveLimits, archive_bytes: int) -> None:
        self._limits = limits
        self._budget = limits.budget_bytes(archive_bytes)
        self._declared = self._out = self._members = 0
        self._top: str | None = None
        self._names: set[str] = set()

    def count_member(self) -> None:
        """One more member, of whatever kind."""
        self._members += 1
        if self._members > self._limits.max_files:
            message = f"expected at most {self._limits.max_files} members; got more"
            raise DataError("archive-too-large", message)

    def count_out(self, count: int) -> None:
        """More bytes have come out."""
        self._out += count
        self._check(self._out)

    def admit(self, raw_name: str, size: int) -> str | None:
        """The plain name of a file, or None for one to be left out."""
        parts = _parts(raw_name)
        if not parts:
            raise _not_plain(raw_name, "expected the name of a file")
        if _is_hidden(parts):
            return None
        if len(parts) > 2:
            raise _not_plain(raw_name, "expected files at the top or in one folder")
        top = parts[0] if len(parts) == 2 else ""
        if self._top is not None and top != self._top:
            raise _not_plain(raw_name, "expected all files in one place")
        self._top = top
        name = parts[-1]
        if not is_plain_name(name):
            raise _not_plain(raw_name, "expected a plain file name")
        if name in self._names:
            raise _not_plain(raw_name, "expected each file once")
        self._names.add(name)
        if size > self._limits.max_member_bytes:
            message = (
                f"{_shown(raw_name)}: expected at most {self._limits.max_member_bytes} bytes; got {size}"
            )
            raise DataError("archive-too-large", message)
        self._declared += size
        self._check(self._declared)
        return name

    def pass_folder(self, raw_name: str) -> None:
        """A folder's own entry: nothing is made of it, but it may not climb or be nested."""
        parts = _parts(raw_name)
        if len(parts) > 1 and not _is_hidden(parts):
            raise _not_plain(raw_name, "expected files at the top or in one folder")

    def _check(self, count: int) -> None:
        if count > self._budget:
            message = f"expected at most {self._budget} bytes to come out of this archive; got more"
            raise DataError("archive-too-large", message)


def _parts(raw_name: str) -> list[str]:
    """Folders and file of a member's name. Raises DataError "archive-climbs"."""
    parts = [part for part in raw_name.split("/") if part not in ("", ".")]
    climbs = raw_name.startswith("/") or "\\" in raw_name or ".." in parts
    if climbs or any(re.match(r"[A-Za-z]:", part) for part in parts):
        message = f"expected names inside the archive's own folder; got {_shown(raw_name)}"
        raise DataError("archive-climbs", message)
    return parts


def _is_hidden(parts: list[str]) -> bool:
    return any(part.startswith(".") or part.split(".")[0] in _HIDDEN or part in _HIDDEN for part in parts)


def _not_plain(raw_name: str, message: str) -> DataError:
    return DataError("archive-not-plain", f"{message}; got {_shown(raw_name)}")


def _shown(raw_name: str) -> str:
    return ascii(raw_name[:80])


# --- zip --------------------------------------------------------------------------------------------------


class _BoundedReads:
    """A file that gives no more at once than a table of contents may have."""

    def __init__(self, file: BinaryIO, limits: ArchiveLimits) -> None:
        self._file = file
        self._most = max(_CHUNK, limits.max_files * _DIRECTORY_BYTES_A_MEMBER)

    def read(self, count: int = -1) -> bytes:
        got = self._file.read(self._most + 1 if count < 0 else min(count, self._most + 1))
        if len(got) > self._most:
            message = f"expected a table of contents of at most {self._most} bytes; got more"
            raise DataError("archive-too-large", message)
        return got

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def seekable(self) -> bool:
        return True


class _Zip:
    kind: Kind = "zip"

    def __init__(self, archive: zipfile.ZipFile, gate: _Gate) -> None:
        self._archive, self._gate = archive, gate

    def members(self) -> Iterator[_Member]:
        admitted = [
            (info, name) for info in self._archive.infolist() if (name := self._admit(info)) is not None
        ]
        for info, name in admitted:
            with self._archive.open(info) as stream:
                yield _ZipMember(name, info.file_size, stream, self._gate)

    def _admit(self, info: zipfile.ZipInfo) -> str | None:
        self._gate.count_member()
        kind = stat.S_IFMT(info.external_attr >> 16) if info.create_system != 0 else 0
        if info.orig_filename.endswith("/") and kind in (0, stat.S_IFDIR):
            self._gate.pass_folder(info.orig_filename)
            return None
        name = self._gate.admit(info.orig_filename, info.file_size)
        if name is None:
            return None
        if kind not in (0, stat.S_IFREG):
            raise _not_plain(info.orig_filename, "expected files alone, no links or devices")
        if info.flag_bits & _ZIP_ENCRYPTED:
            raise _not_plain(info.orig_filename, "expected files that are not encrypted")
        if info.compress_type not in _ZIP_METHODS:
            wanted = " or ".join(_ZIP_METHODS.values())
            raise _not_plain(info.orig_filename, f"expected files {wanted}, not method {info.compress_type}")
        # Deflate adds five bytes a block at worst: more than that, and the size declared is a lie.
        if info.compress_size > 2 * info.file_size + 1024:
            message = (
                f"{_shown(info.orig_filename)}: {info.compress_size} bytes are said to hold {info.file_size}"
            )
            raise DataError("archive-broken", f"expected sizes that fit each other; {message}")
        return name


class _ZipMember:
    def __init__(self, name: str, size: int, stream: IO[bytes], gate: _Gate) -> None:
        self.name, self.size_bytes = name, size
        self._stream, self._gate, self._out = stream, gate, 0

    def read(self, count: int) -> bytes:
        got = self._stream.read(count)  # checks the CRC at the end
        self._out += len(got)
        self._gate.count_out(len(got))
        if self._out > self.size_bytes or (len(got) < count and self._out != self.size_bytes):
            message = f"expected {self.size_bytes} bytes in {_shown(self.name)}, as declared; got {self._out}"
            raise DataError("archive-broken", message)
        return got


# --- tar --------------------------------------------------------------------------------------------------


class _Source(Protocol):
    """Bytes in order: read some (fewer at the end), or pass over some."""

    def read(self, count: int) -> bytes: ...

    def skip(self, count: int) -> None: ...


class _Plain:
    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size

    def read(self, count: int) -> bytes:
        return self._file.read(count)

    def skip(self, count: int) -> None:
        if self._file.tell() + count > self._size:
            raise _short()
        self._file.seek(count, io.SEEK_CUR)


class _Inflating:
    """Counts all that is inflated, what is passed over too."""

    def __init__(self, stream: gzip.GzipFile, gate: _Gate) -> None:
        self._stream, self._gate = stream, gate

    def read(self, count: int) -> bytes:
        got = self._stream.read(count)
        self._gate.count_out(len(got))
        return got

    def skip(self, count: int) -> None:
        while count > 0:
            got = self.read(min(count, _CHUNK))
            if not got:
                raise _short()
            count -= len(got)


def _short() -> DataError:
    return DataError("archive-broken", "expected a whole archive; it stops short")


class _Tar:
    def __init__(self, kind: Kind, source: _Source, gate: _Gate) -> None:
        self.kind, self._source, self._gate = kind, source, gate

    def members(self) -> Iterator[_Member]:
        said: dict[str, str] = {}  # of the next member, by the headers before it
        everyone: dict[str, str] = {}  # of all members after a global header
        first = True
        while (info := self._header(first=first)) is not None:
            first = False
            self._gate.count_member()
            if info.type in (tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE):
                target = everyone if info.type == tarfile.XGLTYPE else said
                target.update(_pax_records(self._text(info)))
                continue
            if info.type in (tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK):
                text = self._text(info).rstrip(b"\0").decode("utf-8", "surrogateescape")
                if info.type == tarfile.GNUTYPE_LONGNAME:
                    said["path"] = text
                continue
            yield from self._member(info, {**everyone, **said})
            said = {}

    def _member(self, info: tarfile.TarInfo, said: dict[str, str]) -> Iterator[_Member]:
        raw_name = said.get("path", info.name)
        size = int(said.get("size", info.size))
        if "sparse" in said:
            raise _not_plain(raw_name, "expected files alone, none sparse")
        if info.type == tarfile.DIRTYPE or (info.type == tarfile.AREGTYPE and raw_name.endswith("/")):
            self._gate.pass_folder(raw_name)
            return
        if info.type not in _TAR_FILES or size < 0:
            raise _not_plain(raw_name, "expected files alone, no links or devices")
        name = self._gate.admit(raw_name, size)
        if name is None:
            self._source.skip(size + -size % _BLOCK)
            return
        member = _TarMember(name, size, self._source, counted=self.kind == "tar.gz", gate=self._gate)
        yield member
        self._source.skip(member.left + -size % _BLOCK)

    def _header(self, *, first: bool) -> tarfile.TarInfo | None:
        """The next header, or None at the block of zeros that ends an archive."""
        block = self._source.read(_BLOCK)
        if first and block[_TAR_MAGIC_AT : _TAR_MAGIC_AT + len(_TAR_MAGIC)] != _TAR_MAGIC:
            raise DataError("not-an-archive", "expected a .zip, .tar or .tar.gz; got a gzip file of no tar")
        if len(block) < _BLOCK:
            raise _short()
        if not any(block):
            return None
        return tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")

    def _text(self, info: tarfile.TarInfo) -> bytes:
        """What an extended header holds."""
        if not 0 <= info.size <= _LONGEST_TAR_TEXT:
            message = f"expected an extended header of at most {_LONGEST_TAR_TEXT} bytes; got {info.size}"
            raise DataError("archive-broken", message)
        text = self._source.read(info.size)
        if len(text) < info.size:
            raise _short()
        self._source.skip(-info.size % _BLOCK)
        return text


class _TarMember:
    def __init__(self, name: str, size: int, source: _Source, *, counted: bool, gate: _Gate) -> None:
        self.name, self.size_bytes, self.left = name, size, size
        self._source, self._counted, self._gate = source, counted, gate

    def read(self, count: int) -> bytes:
        wanted = min(count, self.left)
        got = self._source.read(wanted)
        if len(got) < wanted:
            raise _short()
        self.left -= len(got)
        if not self._counted:
            self._gate.count_out(len(got))
        return got


def _pax_records(text: bytes) -> dict[str, str]:
    """Of the records "length key=value\\n" of a pax header: path, size, and sparse where it speaks of holes.

    Raises ValueError where they are no records.
    """
    records: dict[str, str] = {}
    at = 0
    while at < len(text) and text[at] != 0:
        blank = text.index(b" ", at, at + 20)
        length = int(text[at:blank])
        record = text[blank + 1 : at + length]
        if length <= blank + 1 - at or not record.endswith(b"\n"):
            raise ValueError("a pax record that does not end where it says")
        key, _, value = record[:-1].partition(b"=")
        if key in (b"path", b"size"):
            records[key.decode()] = value.decode("utf-8", "surrogateescape")
        elif key.startswith(b"GNU.sparse"):
            records["sparse"] = ""
        at += length
    return records


def _starts_like(start: bytes, known: bytes) -> bool:
    """True where ``start`` is the beginning of ``known``, or the other way round."""
    return start.startswith(known) or known.startswith(start)
