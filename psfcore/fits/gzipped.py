"""Decompress a file in gzip, in a process of its own (`psfcore.limited`). This module loads no numerical library."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from psfcore.errors import HeaderError
from psfcore.limited import run_limited, scratch_file

_PIECE_BYTES = 1 << 20


@contextmanager
def decompressed(path: Path, most_bytes: int) -> Iterator[tuple[BinaryIO, HeaderError | None]]:
    """A file without a name that holds the decompressed bytes, and the error of what lacks at its end, if anything
    does.

    Codes of the error: "truncated-gzip", "bad-gzip", and "too-many-bytes" beyond ``most_bytes``.
    """
    with scratch_file() as plain:
        answer = run_limited(
            decompress, path, plain, pixels=0, answer_bytes=most_bytes, most_bytes=most_bytes
        )
        plain.seek(0)
        yield plain, HeaderError(**answer) if answer else None


def decompress(target: BinaryIO, *, path: str, most_bytes: int) -> dict[str, object]:
    """Write the decompressed bytes to ``target``; returns the code and the message of the error that ended them."""
    left = most_bytes
    try:
        with gzip.open(path) as stream:
            while piece := stream.read(_PIECE_BYTES):
                left -= len(piece)
                if left < 0:
                    message = f"expected at most {most_bytes} bytes of decompressed data; got more: use a smaller file"
                    return {"code": "too-many-bytes", "message": message}
                target.write(piece)
    except EOFError:
        message = "expected a complete gzip stream; it ends too early: copy the file again"
        return {"code": "truncated-gzip", "message": message}
    except (gzip.BadGzipFile, zlib.error) as error:
        message = f"expected a readable gzip stream; got: {error!s:.120}: copy the file again"
        return {"code": "bad-gzip", "message": message}
    return {}
