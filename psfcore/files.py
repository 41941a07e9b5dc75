"""Write files completely or not at all, even if the process is killed or the power fails; hash files; find FITS files
by their endings.
"""

from __future__ import annotations

import errno
import gzip
import hashlib
import os
import re
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from platformdirs import user_cache_path

# The endings of FITS files: plain, with compressed tiles (.fz), or in gzip.
FITS_ENDING = re.compile(r"\.((fits|fit|fts)(\.gz|\.fz)?|fz)$", re.IGNORECASE)
CACHE_VARIABLE = "HELIOPSF_CACHE_DIR"
PARTIAL = ".part"
PACKED = (".fz", ".bz2", ".xz", ".z")  # endings that promise a compression which is not written
PROBE_BYTES = 4096  # the block size of most file systems: if the disk is full, the probe cannot be written
GZIP_START = b"\x1f\x8b"
_GZIP_LEVEL = 6  # that of the program gzip


@contextmanager
def whole_path(target: Path) -> Iterator[Path]:
    """A temporary path beside `target`, for code that opens the file itself. At the end of the block the file replaces
    `target`. If that name ends in .gz, a file that is not in gzip yet is compressed.

    A symbolic link stays a link; the file that it leads to is replaced. A killed process leaves its temporary file
    behind; its name ends with `PARTIAL`. Raises OSError.
    """
    place = Path(os.path.realpath(target))
    partial = _partial(place)
    try:
        yield partial
        if target.suffix.lower() == ".gz":
            _compress(partial)
        with partial.open("rb") as written:
            os.fsync(written.fileno())
        partial.replace(place)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_file(target: Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `target`. This file replaces `target` when its whole content is on the disk.

    For the rest see `whole_path`. Raises OSError.
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


def check_ending(target: Path) -> None:
    """Raise OSError if the name of a file to write promises a compression which is not written."""
    if target.suffix.lower() in PACKED:
        message = (
            f"files in the compression of {target.suffix} are not written: end the name in .fits or .fits.gz"
        )
        raise OSError(errno.EINVAL, message, str(target))


def _compress(path: Path) -> None:
    """Replace a file by the same content in gzip, without name and time: equal contents give equal files."""
    with path.open("rb") as plain:
        if plain.read(2) == GZIP_START:
            return
        plain.seek(0)
        with whole_file(path) as file, gzip.GzipFile("", "wb", _GZIP_LEVEL, file, mtime=0) as packed:
            shutil.copyfileobj(plain, packed)


def _partial(target: Path) -> Path:
    return target.with_name(f".{target.name}.{uuid.uuid4().hex}{PARTIAL}")


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fits_in(folder: Path) -> list[Path]:
    """The FITS files of a folder by the endings of their names, sorted by name.

    Names that begin with a full stop are left out: macOS writes such files beside others on foreign disks. Raises
    OSError.
    """
    return sorted(
        one for one in folder.iterdir() if FITS_ENDING.search(one.name) and not one.name.startswith(".")
    )


def cache_folder() -> Path:
    """The folder that HELIOPSF_CACHE_DIR names, or the user's cache folder, such as ~/.cache/heliopsf."""
    named = os.environ.get(CACHE_VARIABLE)
    return Path(named).expanduser() if named else user_cache_path("heliopsf", appauthor=False)
