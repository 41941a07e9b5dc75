"""Reads gzip files of strangers in a time that their size bounds.

Source: RFC 1952 (Deutsch 1996). Python's `gzip`, and so astropy, reads the name and the comment of a member, and the zeros
after it, byte by byte: a name of 20 MB takes seconds. Here zlib reads them, and files with long ones are refused.
"""

from __future__ import annotations

import gzip
import zlib
from typing import BinaryIO

MOST_MEMBERS = 200_000  # programs that compress in parallel write a member for each 64 kB
MOST_EMPTY_BYTES = 1 << 16  # consecutive bytes without content: names, comments, empty members, zeros
_CHUNK = 1 << 14  # bytes; a larger chunk is copied more often if members are small
_WITH_HEADER = 31  # zlib reads the header and checks the sum of each member


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
