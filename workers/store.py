"""Files by the hash of their content, in a local folder.

A file is written beside its place under a temporary name, forced to disk and renamed, so that a file that
exists is whole. Names come from hashes alone, never from a client.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class Store:
    """A folder of content-addressed files."""

    def __init__(self, folder: Path) -> None:
        self._blobs = folder / "blobs"
        self._tmp = folder / "tmp"
        self._blobs.mkdir(parents=True, exist_ok=True)
        self._tmp.mkdir(parents=True, exist_ok=True)

    def sweep(self, older_than_s: float = 86_400.0) -> None:
        """Remove temporary files that a killed process left behind."""
        for path in self._tmp.iterdir():
            if time.time() - path.stat().st_mtime > older_than_s:
                if path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)  # another sweep may be at it too
                else:
                    path.unlink(missing_ok=True)

    def path(self, digest: str) -> Path:
        """Where the file of this SHA-256 is, or would be."""
        return self._blobs / digest[:2] / digest

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

    def keep(self, temporary: Path, digest: str | None = None) -> str:
        """Move a finished file to its place, durably; returns its SHA-256 (computed where not given)."""
        digest = digest or sha256_of(temporary)
        target = self.path(digest)
        target.parent.mkdir(exist_ok=True)
        _sync(temporary)
        os.replace(temporary, target)
        _sync(target.parent)
        return digest


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
