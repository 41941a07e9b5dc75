"""Write files completely or not at all, even if the process is killed or the power fails; hash files; read gzip files.

A gzip file of strangers is read in a time that its size bounds. Source: RFC 1952 (Deutsch 1996). Python's `gzip`, and so
astropy, reads the name and the comment of a member, and the zeros after it, byte by byte: a name of 20 MB takes seconds.
Here zlib reads them, and files with long ones are refused.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import uuid
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

PARTIAL = ".part"
PROBE_BYTES = 4096  # the block size of most file systems: if the disk is full, the probe cannot be written
MOST_MEMBERS = 200_000  # programs that compress in parallel write a member for each 64 kB
MOST_EMPTY_BYTES = 1 << 16  # consecutive bytes without content: names, comments, empty members, zeros
_CHUNK = 1 << 14  # bytes; a larger chunk is copied more often if members are small
_WITH_HEADER = 31  # zlib reads the header and checks the sum of each member


@contextmanager
def whole_path(target: Path) -> Iterator[Path]:
    """A temporary path beside `target`, for code that opens the file itself. At the end of the block the file replaces
    `target`.

    A killed process leaves its temporary file behind; `partials` finds it. Raises OSError.
    """
    partial = _partial(target)
    try:
        yield partial
        with partial.open("rb") as written:
            os.fsync(written.fileno())
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_file(target: Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `target`. This file replaces `target` when its whole content is on the disk.

    A killed process leaves its temporary file behind; its name ends with `PARTIAL`. Raises OSError.
    """
    with whole_path(target) as partial, partial.open("wb") as unfinished:
        yield unfinished


def probe(target: Path) -> None:
    """Write and remove a temporary file beside `target`. Raises OSError if `whole_file` could not write there now."""
    partial = _partial(target)
    try:
        with partial.open("wb") as file:
            file.write(bytes(PROBE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    finally:
        partial.unlink(missing_ok=True)


def write_whole(target: Path, text: str) -> None:
    """Write a text file completely or not at all. Raises OSError."""
    with whole_file(target) as file:
        file.write(text.encode())


def _partial(target: Path) -> Path:
    return target.with_name(f".{target.name}.{uuid.uuid4().hex}{PARTIAL}")


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class GzipStream:
    """The decompressed bytes of a gzip file, which may have several members."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.rewind()

    def rewind(self) -> None:
        """Continue at the first byte."""
        self._file.seek(0)
        self._member, self._left, self._members = zlib.decompressobj(_WITH_HEADER), b"", 1
        self._empty_bytes = 0

    def read(self, count: int) -> bytes:
        """The next `count` bytes; fewer only at the end.

        Raises EOFError if the file ends too early, zlib.error or BadGzipFile if it is damaged.
        """
        parts = []
        while count and (part := self._next(count)):
            parts.append(part)
            count -= len(part)
        return b"".join(parts)

    def _next(self, most: int) -> bytes:
        """Some of the next bytes, at most `most`; empty at the end."""
        while not self._member.eof or self._begin_member():
            data = self._left or self._file.read(_CHUNK)
            content = self._member.decompress(data, most)
            self._left = self._member.unconsumed_tail
            if content:
                self._empty_bytes = 0
                return content
            self._count_empty(len(data) - len(self._left) - len(self._member.unused_data))
            if not data and not self._member.eof:
                raise EOFError("the file ends before the end of the compressed data")
        return b""

    def _begin_member(self) -> bool:
        """Go to the next member; False if there is none. Zeros may stand between members."""
        self._left = self._member.unused_data.lstrip(b"\0")
        while not self._left:
            chunk = self._file.read(_CHUNK)
            if not chunk:
                return False
            self._left = chunk.lstrip(b"\0")
            self._count_empty(len(chunk) - len(self._left))
        self._members += 1
        if self._members > MOST_MEMBERS:
            raise gzip.BadGzipFile(f"expected at most {MOST_MEMBERS} gzip members in a file; got more")
        self._member = zlib.decompressobj(_WITH_HEADER)
        return True

    def _count_empty(self, count: int) -> None:
        self._empty_bytes += count
        if self._empty_bytes > MOST_EMPTY_BYTES:
            raise gzip.BadGzipFile(
                f"expected at most {MOST_EMPTY_BYTES} bytes for the name and the comment of a gzip member; got more"
            )
