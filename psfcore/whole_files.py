"""Files of which there is all or nothing, whatever is killed and whenever the power goes."""

from __future__ import annotations

import glob
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

PARTIAL = ".part"


@contextmanager
def whole_file(target: Path) -> Iterator[BinaryIO]:
    """A file to write to, beside its place; it takes that, over what is there, once all of it is on the disk.

    A process that is killed leaves what ``partials`` finds. Raises OSError.
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
    """Write a text so. Raises OSError."""
    with whole_file(target) as file:
        file.write(text.encode())


def partials(target: Path) -> Iterator[Path]:
    """What processes that were killed left of this file."""
    return target.parent.glob(f".{glob.escape(target.name)}.*{PARTIAL}")
