"""Uploads that are not complete yet: one folder of files, shared by all servers that share the data folder.

An upload has two files: ``ID.json`` says who uploads what, ``ID.part`` has the bytes received so far. The size of the
second file is the offset at which the upload continues, so a server that was killed loses no received byte.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

from psfcore.errors import DataError
from psfcore.files import write_whole

EXPIRES_S = 86_400.0  # an upload that got no byte for this time is removed
MOST_OPEN = 20  # open uploads of one owner


@dataclass(frozen=True)
class PartialUpload:
    """An upload that is not complete yet.

    Attributes
    ----------
    kind
        "transit" or "image".
    length
        Size of the whole file, bytes.
    sha256
        The SHA-256 that the client declares for the whole file, in hexadecimal; None if the client declares none.
    """

    id: str
    owner: str
    kind: str
    length: int
    filename: str | None
    sha256: str | None


class PartialUploads:
    """The folder of all uploads that are not complete yet."""

    def __init__(self, data_dir: Path) -> None:
        self._folder = data_dir / "uploads"

    @contextmanager
    def one_at_a_time(self) -> Iterator[None]:
        """Let other threads and servers that want to begin an upload wait until the ``with`` block ends."""
        self._folder.mkdir(mode=0o700, exist_ok=True)
        with (self._folder / "lock").open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def create(
        self, owner: str, kind: str, length: int, filename: str | None, sha256: str | None
    ) -> PartialUpload:
        """Begin an upload. Call this function within ``one_at_a_time``.

        Raises DataError "too-many-uploads" if the owner has ``MOST_OPEN`` open uploads.
        """
        self.sweep()
        if sum(one.owner == owner for one in self._all()) >= MOST_OPEN:
            raise DataError(
                "too-many-uploads",
                f"expected at most {MOST_OPEN} open uploads; this would be one more: complete or delete one of them",
            )
        upload = PartialUpload(uuid.uuid4().hex, owner, kind, length, filename, sha256)
        self.path(upload).touch(mode=0o600)
        write_whole(self._described(upload.id), json.dumps(asdict(upload)))
        return upload

    def find(self, upload_id: str, owner: str) -> PartialUpload | None:
        """The open upload of this owner with this id; None if there is none."""
        upload = self._read(self._described(upload_id))
        return upload if upload is not None and upload.owner == owner else None

    def equal(self, owner: str, kind: str, length: int, sha256: str) -> PartialUpload | None:
        """An open upload of the same file; None if there is none."""
        wanted = (owner, kind, length, sha256)
        return next((u for u in self._all() if (u.owner, u.kind, u.length, u.sha256) == wanted), None)

    def declared_bytes(self, owner: str, but: str | None = None) -> int:
        """The sum of the lengths of the owner's open uploads, without the upload whose id is ``but``."""
        self.sweep()
        return sum(one.length for one in self._all() if one.owner == owner and one.id != but)

    def offset(self, upload: PartialUpload) -> int:
        """Number of bytes received so far. Raises FileNotFoundError if the upload was removed meanwhile."""
        return self.path(upload).stat().st_size

    def expires_at(self, upload: PartialUpload) -> float:
        """The time at which the upload is removed if it gets no more bytes, seconds since 1970.

        Raises FileNotFoundError as ``offset`` does.
        """
        return self.path(upload).stat().st_mtime + EXPIRES_S

    def path(self, upload: PartialUpload) -> Path:
        """The file with the bytes received so far."""
        return self._folder / f"{upload.id}.part"

    @contextmanager
    def opened(self, upload: PartialUpload) -> Iterator[BinaryIO]:
        """The file with the bytes received so far, for appending. Raises DataError "upload-locked" if another request
        appends to it, and FileNotFoundError as ``offset`` does.
        """
        with self.path(upload).open("r+b") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise DataError(
                    "upload-locked",
                    "expected one request at a time for an upload; another request sends bytes now: ask for its "
                    "offset, then try again",
                ) from None
            file.seek(0, os.SEEK_END)
            yield file

    def remove(self, upload: PartialUpload) -> None:
        """Remove an upload. Its bytes may have been moved to the store before."""
        self._described(upload.id).unlink(missing_ok=True)
        self.path(upload).unlink(missing_ok=True)

    def sweep(self) -> None:
        """Remove expired uploads, except those to which a request appends now: the clock may be wrong."""
        if not self._folder.is_dir():
            return
        for path in self._folder.glob("*.part"):
            # It may be completed meanwhile.
            with suppress(FileNotFoundError, BlockingIOError):
                if time.time() - path.stat().st_mtime <= EXPIRES_S:
                    continue
                with path.open("r+b") as file:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    path.with_suffix(".json").unlink(missing_ok=True)
                    path.unlink(missing_ok=True)

    def _all(self) -> Iterator[PartialUpload]:
        if self._folder.is_dir():
            for path in self._folder.glob("*.json"):
                upload = self._read(path)
                if upload is not None:
                    yield upload

    def _read(self, path: Path) -> PartialUpload | None:
        try:
            upload = PartialUpload(**json.loads(path.read_text()))
        except FileNotFoundError:
            return None
        return upload if self.path(upload).exists() else None

    def _described(self, upload_id: str) -> Path:
        return self._folder / f"{upload_id}.json"
