"""Files in a local folder, named by the hash of their content. ``workers.files.s3_store`` does the same with S3.

A file is written under a temporary name, forced to the disk and then renamed. An existing file is therefore complete.
File names are hashes; they never come from a client.

A file is removed in two steps, because an upload or a job stores its file before it adds the row that names the file.
``remove`` moves the file aside. From there ``path`` brings it back as soon as something needs it. Later
``workers.files.garbage.settle`` reads the rows: it brings back the files that a row names, and deletes the others.
"""

from __future__ import annotations

import errno
import fcntl
import math
import os
import shutil
import time
import uuid
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sqlalchemy.exc import SQLAlchemyError

from psfcore.errors import DataError, module_of_extra
from psfcore.files import sha256_of
from psfcore.transit.admission import ArchiveLimits
from psfcore.transit.archive import unpack
from workers.settings import Settings

ADVICE = (
    "if it was uploaded, upload it again; if a job made it, submit the same request again, and the job makes it "
    "again; if this does not help, tell the operator, who finds such files with `heliopsf store check`"
)
DAMAGED = f"its content has changed on the disk: {ADVICE}"
STORAGE_FULL = "storage-full"  # the code of such an error
NO_ROOM = (
    "expected free space on the disk of the service; the disk is full: ask the operator to make room, then try "
    "again"
)
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})


class StoreAway(ConnectionError):
    """The storage gives no answer, or a wrong one: whether it has a file cannot be found out now.

    A later attempt may succeed. Nothing that cannot be undone may follow from this error.
    """


FileState = Literal["good", "lost", "damaged"]


class BadFile(DataError):
    """A file of the store is lost, or its content has changed. code: "file-lost" or "file-damaged"."""


@dataclass(frozen=True)
class Blob:
    """A file of the store."""

    digest: str
    bytes: int
    kept_at: float  # time when the file was last stored; it may also have been stored before


class Store:
    """A folder of content-addressed files."""

    def __init__(self, folder: Path, blobs: str = "blobs") -> None:
        self._blobs = folder / blobs
        self._tmp = folder / "tmp"
        self._aside = folder / "aside"
        self._damaged = folder / "damaged"
        self._writers = folder / "writers"
        for needed in (self._blobs, self._tmp, self._aside, self._writers):
            needed.mkdir(parents=True, exist_ok=True)
        self._writer = self._new_writer()

    def _new_writer(self) -> str:
        """The name of a new locked file. It says that the temporary files whose names begin with it are in use.

        The system drops the lock when this process and its forked children have ended.
        """
        while True:
            file = (self._writers / uuid.uuid4().hex).open("wb")
            fcntl.flock(file, fcntl.LOCK_EX)
            if os.fstat(file.fileno()).st_nlink:  # otherwise a sweep removed it before it was locked
                weakref.finalize(self, file.close)
                return Path(file.name).name
            file.close()

    def sweep(self) -> None:
        """Remove the temporary files of processes that have ended. No clock is read: clocks may be wrong."""
        for path in self._writers.iterdir():
            # Another sweep may run now. An exclusive lock on a network file system needs a file open for writing.
            with suppress(FileNotFoundError, BlockingIOError), path.open("r+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
        for path in self._tmp.iterdir():
            if (self._writers / path.name.partition(".")[0]).exists():
                continue
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    def _new_temporary(self) -> Path:
        return self._tmp / f"{self._writer}.{uuid.uuid4().hex}"

    def path(self, digest: str) -> Path:
        """The path of the file with this SHA-256. The file may not exist."""
        path = self._place(digest)
        if not path.exists():
            self.bring_back(digest)
        return path

    def _place(self, digest: str) -> Path:
        return self._blobs / digest[:2] / digest

    def size(self, digest: str) -> int | None:
        """The size of the file with this SHA-256, bytes; None if the store has no such file."""
        try:
            return self.path(digest).stat().st_size
        except FileNotFoundError:
            return None

    def state(self, digest: str, size: int | None, *, content: bool) -> FileState:
        """Whether the file with this SHA-256 is good, lost or damaged.

        Parameters
        ----------
        size
            Recorded size of the file, bytes; None: not recorded.
        content
            Whether to also read the file and compare its SHA-256.
        """
        there = self.size(digest)
        if there is None:
            return "lost"
        if size not in (None, there):
            return "damaged"
        try:
            good = not content or self._content_sha256(digest) == digest
        except FileNotFoundError:  # it was removed meanwhile
            return "lost"
        return "good" if good else "damaged"

    def _content_sha256(self, digest: str) -> str:
        return sha256_of(self.path(digest))

    def verified(self, digest: str) -> Path:
        """The path of the file with this SHA-256, after its content was checked. Raises ``BadFile``."""
        try:
            path = self.path(digest)
            found = sha256_of(path)
        except FileNotFoundError:
            raise lost(digest) from None
        if found != digest:
            raise BadFile("file-damaged", f"expected the file {digest} as it was stored; {DAMAGED}")
        return path

    def set_aside(self, digest: str) -> bool:
        """Move a damaged file out of the store, into the folder ``damaged``, where nothing reads it.

        Returns False if the file does not exist, or if its content is good. A good file that is stored at the same
        moment is kept.
        """
        self._damaged.mkdir(exist_ok=True)
        target, aside = self.path(digest), self._damaged / f"{digest}.{uuid.uuid4().hex}"
        try:
            os.replace(target, aside)
        except FileNotFoundError:
            return False
        if sha256_of(aside) == digest:
            os.replace(aside, target)
            return False
        sync(target.parent)
        return True

    def check(self) -> None:
        """Raise OSError if files cannot be stored now."""
        with self.temporary() as probe:
            probe.write_bytes(b"heliopsf")

    @contextmanager
    def temporary(self) -> Iterator[Path]:
        """A path for a temporary file. If the file still exists at the end, it is removed."""
        path = self._new_temporary()
        try:
            yield path
        finally:
            path.unlink(missing_ok=True)

    @contextmanager
    def temporary_folder(self) -> Iterator[Path]:
        """An empty folder. At the end it is removed with its content."""
        folder = self._new_temporary()
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder)

    @contextmanager
    def unpacked(self, digest: str, limits: ArchiveLimits) -> Iterator[Path]:
        """Unpack a stored archive into a folder that is removed at the end. Raises ``BadFile`` and the errors of
        ``unpack``.
        """
        with self.temporary_folder() as folder:
            unpack(self.verified(digest), folder, limits)
            yield folder

    def keep(self, temporary: Path, digest: str | None = None) -> str:
        """Move a complete file into the store and force it to the disk; returns its SHA-256.

        Parameters
        ----------
        digest
            The SHA-256, if it is already known; None: it is computed.
        """
        digest = digest or sha256_of(temporary)
        target = self._place(digest)
        target.parent.mkdir(exist_ok=True)
        self._force(temporary)
        # The time is set to the nanosecond, so that remove() can distinguish this file from an identical file that is
        # stored almost at the same moment. The system itself sets times only to a few milliseconds.
        os.utime(temporary, ns=(time.time_ns(), time.time_ns()))
        os.replace(temporary, target)
        self._force(target.parent)
        return digest

    def _force(self, path: Path) -> None:
        """Force a file, or the names in a folder, to the disk."""
        sync(path)

    def kept_at(self, digest: str) -> float | None:
        """The time when a file was last stored; None if it is not in the store."""
        try:
            return self._place(digest).stat().st_mtime
        except FileNotFoundError:
            return None

    @contextmanager
    def kept_if(self, temporary: Path, digest: str) -> Iterator[None]:
        """Keep a complete file while the block adds its row to the catalogue. If the block fails, the file is removed
        again.

        The file is not removed if it existed before, or if it is stored again during the block: another row may need
        it.
        """
        known = self.kept_at(digest) is not None
        self.keep(temporary, digest)
        kept_at = self.kept_at(digest)
        try:
            yield
        except BaseException:
            if not known and kept_at is not None:
                self.remove(digest, kept_before=math.nextafter(kept_at, math.inf))
            raise

    def blobs(self) -> Iterator[Blob]:
        """All files of the store."""
        for folder in sorted(self._blobs.iterdir()):
            for path in sorted(folder.iterdir()):
                found = path.stat()
                yield Blob(path.name, found.st_size, found.st_mtime)

    def remove(self, digest: str, kept_before: float) -> bool:
        """Move a file aside. If the file was stored again since ``kept_before``, or no longer exists, do nothing.

        Returns whether the file was moved. The time of a file is checked after the move. Otherwise a file that is
        stored at the same moment could be moved too.
        """
        target, aside = self._place(digest), self._aside / digest
        try:
            os.replace(target, aside)
            if aside.stat().st_mtime >= kept_before:
                os.replace(aside, target)  # if a file was stored there meanwhile, its content is the same
                return False
            os.utime(aside)
        except FileNotFoundError:  # it is not in the store, or something needed it meanwhile
            return False
        return True

    def aside(self, before: float = math.inf) -> set[str]:
        """The hashes of the files that were moved aside before this time."""
        found = set()
        for path in self._aside.iterdir():
            with suppress(FileNotFoundError):
                if path.stat().st_mtime < before:
                    found.add(path.name)
        return found

    def bring_back(self, digest: str) -> bool:
        """Move a file that was moved aside back to its place; returns False if it is not aside or was stored again."""
        target = self._place(digest)
        if target.exists():  # it was stored again
            return False
        try:
            os.replace(self._aside / digest, target)
        except FileNotFoundError:
            return False
        self._force(target.parent)
        return True

    def delete_aside(self, digest: str) -> None:
        """Delete a file that was moved aside."""
        (self._aside / digest).unlink(missing_ok=True)


def open_store(settings: Settings, *, within_requests: bool = False) -> Store:
    """The store that the settings name: a local folder, or S3. Raises ``MissingExtra`` if the packages for S3 are
    missing.

    Parameters
    ----------
    within_requests
        Whether people wait for the answers; calls of S3 then give up earlier.
    """
    if settings.store_url is None:
        return Store(settings.data_dir)
    remote = module_of_extra("workers.files.s3_store").RemoteStore
    copies_bytes = settings.store_cache_mib * 2**20
    store: Store = remote(
        settings.store_url, settings.data_dir, copies_bytes, within_requests=within_requests
    )
    return store


def lost(digest: str) -> BadFile:
    """The error for a file that is not in the store, although the catalogue refers to it."""
    return BadFile("file-lost", f"expected the file {digest} in the store; it is not there: {ADVICE}")


def sync(path: Path) -> None:
    """Force the content of a file, or the file names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def is_disk_full(error: BaseException) -> bool:
    """Whether an exception says that a disk is full, or that a quota of the file system is used up.

    While a library handles the OSError of the system, it may raise another OSError; the error of the system is then the
    context of the new error. Databases have codes of their own: SQLITE_FULL of SQLite, 53100 of PostgreSQL.
    """
    if isinstance(error, SQLAlchemyError):
        original = getattr(error, "orig", None)
        return (
            getattr(original, "sqlite_errorname", None) == "SQLITE_FULL"
            or getattr(original, "sqlstate", None) == "53100"
        )
    cause: BaseException | None = error
    while isinstance(cause, OSError):
        if cause.errno in _FULL:
            return True
        cause = cause.__cause__ or cause.__context__
    return False
