"""Writes files completely or not at all, even if the process is killed or the power fails; and the hash of a whole file."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

PARTIAL = ".part"
PROBE_BYTES = 4096  # the block size of most file systems: if the disk is full, the probe cannot be written


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
