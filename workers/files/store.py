"""Files by the hash of their content, in a local folder; in ``workers.files.s3_store`` also in S3.

A file is written beside its place under a temporary name, forced to disk and renamed, so that a file that
exists is whole. Names come from hashes alone, never from a client.
"""

from __future__ import annotations

import hashlib
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
    """Where the files are does not answer; it may in a moment."""


@dataclass(frozen=True)
class Blob:
    """A file that is kept."""

    digest: str
    bytes: int
    kept_at: float  # when it was kept last, though it may have been there before


class Store:
    """A folder of content-addressed files."""

    def __init__(self, folder: Path, blobs: str = "blobs") -> None:
        self._blobs = folder / blobs
        self._tmp = folder / "tmp"
        self._blobs.mkdir(parents=True, exist_ok=True)
        self._tmp.mkdir(parents=True, exist_ok=True)

    def sweep(self, older_than_s: float = 86_400.0) -> None:
        """Remove temporary files that a killed process left behind."""
        for path in self._tmp.iterdir():
            # Whoever works beside this ends with its files, and another sweep may be at them too.
            with suppress(FileNotFoundError):
                if time.time() - path.stat().st_mtime > older_than_s:
                    if path.is_dir():
                        shutil.rmtree(path, ignore_errors=True)
                    else:
                        path.unlink()

    def path(self, digest: str) -> Path:
        """Where the file of this SHA-256 is, or would be, to be opened soon."""
        return self._blobs / digest[:2] / digest

    def check(self) -> None:
        """Raise OSError where files cannot be kept now."""
        with self.temporary() as probe:
            probe.write_bytes(b"heliopsf")

    @contextmanager
    def temporary(self) -> Iterator[Path]:
        """A free path to write to; whatever is still there at the end is removed."""
        path = self._tmp / uuid.uuid4().hex
        try:
            yield path
        finally:
            path.unlink(missing_ok=True)

    @contextmanager
    def temporary_folder(self) -> Iterator[Path]:
        """An empty folder to unpack into, removed at the end with all that it holds."""
        folder = self._tmp / uuid.uuid4().hex
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder)

    @contextmanager
    def unpacked(self, digest: str, limits: ArchiveLimits) -> Iterator[Path]:
        """The files of a stored archive, in a folder that is removed at the end. Raises DataError as ``unpack``."""
        with self.temporary_folder() as folder:
            unpack(self.path(digest), folder, limits)
            yield folder

    def keep(self, temporary: Path, digest: str | None = None) -> str:
        """Move a finished file to its place, durably; returns its SHA-256 (computed where not given)."""
        digest = digest or sha256_of(temporary)
        target = self.path(digest)
        target.parent.mkdir(exist_ok=True)
        sync(temporary)
        os.replace(temporary, target)
        sync(target.parent)
        return digest

    def blobs(self) -> Iterator[Blob]:
        """All files that are kept."""
        for folder in sorted(self._blobs.iterdir()):
            for path in sorted(folder.iterdir()):
                found = path.stat()
                yield Blob(path.name, found.st_size, found.st_mtime)

    def remove(self, digest: str, kept_before: float) -> bool:
        """Remove a file, unless it is gone or was kept again since; whether it was removed.

        It is put aside first and looked at there, so that a file that is kept at this very moment is not lost.
        """
        aside = self._tmp / uuid.uuid4().hex
        target = self.path(digest)
        try:
            os.replace(target, aside)
        except FileNotFoundError:
            return False
        if aside.stat().st_mtime >= kept_before:
            os.replace(aside, target)  # whatever was put there meanwhile is the same
            return False
        aside.unlink()
        return True

    def settle(self, named: Iterable[str], after_s: float = 0.0) -> set[str]:
        """End what ``remove`` began: of the files it left aside, those that are named go back, the others for good.

        ``named`` is read where something is aside, so many seconds later. Returns what was put back.
        """
        return set()  # in a folder, what is aside is looked at there and then


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync(path: Path) -> None:
    """Have a file, or a folder's names, on the disk before anything is said of it."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
