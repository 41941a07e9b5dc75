"""Files in a local folder, named by the hash of their content. ``workers.files.s3_store`` does the same with S3.

A file is written under a temporary name, forced to the disk and then renamed. An existing file is therefore complete.
File names are hashes; they never come from a client.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from psfcore.transit.archive import ArchiveLimits, unpack


class StoreAway(ConnectionError):
    """The storage does not respond now; a later attempt may succeed."""


@dataclass(frozen=True)
class Blob:
    """A file of the store."""

    digest: str
    bytes: int
    kept_at: float  # time when the file was last stored; it may have been stored earlier, too


class Store:
    """A folder of content-addressed files."""

    def __init__(self, folder: Path, blobs: str = "blobs") -> None:
        self._blobs = folder / blobs
        self._tmp = folder / "tmp"
        self._blobs.mkdir(parents=True, exist_ok=True)
        self._tmp.mkdir(parents=True, exist_ok=True)

    def sweep(self, older_than_s: float = 86_400.0) -> None:
        """Remove temporary files older than ``older_than_s`` seconds. Killed processes leave such files."""
        for path in self._tmp.iterdir():
            # A file may disappear meanwhile: a task removes its files when it ends, and another sweep may run now.
            with suppress(FileNotFoundError):
                if time.time() - path.stat().st_mtime > older_than_s:
                    if path.is_dir():
                        shutil.rmtree(path, ignore_errors=True)
                    else:
                        path.unlink()

    def path(self, digest: str) -> Path:
        """The path of the file with this SHA-256. Open the file soon, because it may be removed. It need not exist."""
        return self._blobs / digest[:2] / digest

    def check(self) -> None:
        """Raise OSError if files cannot be stored now."""
        with self.temporary() as probe:
            probe.write_bytes(b"heliopsf")

    @contextmanager
    def temporary(self) -> Iterator[Path]:
        """A path for a temporary file. If the file still exists at the end, it is removed."""
        path = self._tmp / uuid.uuid4().hex
        try:
            yield path
        finally:
            path.unlink(missing_ok=True)

    @contextmanager
    def temporary_folder(self) -> Iterator[Path]:
        """An empty folder. At the end it is removed with its content."""
        folder = self._tmp / uuid.uuid4().hex
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder)

    @contextmanager
    def unpacked(self, digest: str, limits: ArchiveLimits) -> Iterator[Path]:
        """Unpack a stored archive into a folder that is removed at the end. Raises the errors of ``unpack``."""
        with self.temporary_folder() as folder:
            unpack(self.path(digest), folder, limits)
            yield folder

    def keep(self, temporary: Path, digest: str | None = None) -> str:
        """Move a complete file into the store and force it to the disk; returns its SHA-256.

        digest: the SHA-256, if it is already known.
        """
        digest = digest or sha256_of(temporary)
        target = self.path(digest)
        target.parent.mkdir(exist_ok=True)
        sync(temporary)
        # To the nanosecond, so that remove() can tell this file from an equal one that is stored at the same moment. The
        # system itself sets times only to a few milliseconds.
        os.utime(temporary, ns=(time.time_ns(), time.time_ns()))
        os.replace(temporary, target)
        sync(target.parent)
        return digest

    def kept_at(self, digest: str) -> float | None:
        """The time when a file was last stored; None if it is not in the store."""
        try:
            return (self._blobs / digest[:2] / digest).stat().st_mtime
        except FileNotFoundError:
            return None

    @contextmanager
    def kept_if(self, temporary: Path, digest: str) -> Iterator[None]:
        """Keep a complete file while the block adds its row to the catalogue. If the block fails, the file is removed again.

        The file stays if it was there before, or if it is stored again meanwhile: then another row may need it.
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
        """Remove a file, unless it no longer exists or was stored again since ``kept_before``.

        Returns whether the file was removed. The file is first moved aside and checked there, so that a file that is
        stored at the same moment is not lost.
        """
        aside = self._tmp / uuid.uuid4().hex
        target = self.path(digest)
        try:
            os.replace(target, aside)
        except FileNotFoundError:
            return False
        if aside.stat().st_mtime >= kept_before:
            os.replace(aside, target)  # if a file was stored there meanwhile, its content is the same
            return False
        aside.unlink()
        return True

    def settle(self, named: Iterable[str], after_s: float = 0.0) -> set[str]:
        """Finish ``remove``: of the files that were moved aside, restore those in ``named`` and delete the others.

        If there are such files, ``named`` is read after ``after_s`` seconds. Returns the hashes of the restored files.
        """
        # In a local folder there is nothing to finish: remove() itself checks the file that it moved aside.
        return set()


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync(path: Path) -> None:
    """Force the content of a file, or the file names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
