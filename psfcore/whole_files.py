"""Writes files completely or not at all, even if the process is killed or the power fails."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

PARTIAL = ".part"


@contextmanager
def whole_file(target: Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `target`. It replaces `target` when its whole content is on the disk.

    A killed process leaves its temporary file behind; its name ends with `PARTIAL`. Raises OSError.
    """
    partial = target.with_name(f".{target.name}.{uuid.uuid4().hex}{PARTIAL}")
    try:
        with partial.open("wb") as unfinished:
            yield unfinished
            unfinished.flush()
            os.fsync(unfinished.fileno())
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(target: Path, text: str) -> None:
    """Write a text file completely or not at all. Raises OSError."""
    with whole_file(target) as file:
        file.write(text.encode())
