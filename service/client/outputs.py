"""Checks output files before the work starts, and writes each of them completely or not at all."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from psfcore.files import check_ending, probe, whole_path
from service.client.errors import ServiceError
from workers.texts import printable

Name = str | Path
_File = tuple[int, int] | str


def check_outputs(
    outputs: Iterable[Name | None], *, inputs: Iterable[Name | None] = (), overwrite: bool = False
) -> None:
    """Raise ``ServiceError`` if one of the output files must not or cannot be written. None: no file.

    Codes: "output-is-input" if an output is the same file as an input, or as a file in an input folder, also through a
    symbolic or hard link; "outputs-equal" if two outputs are the same file; "output-exists" if an output exists and
    ``overwrite`` is false; "output-not-writable" if a file cannot be written there now (a small file is written and
    removed).
    """
    read = {_file(path): path for one in inputs if one is not None for path in _files_in(Path(one))}
    taken: dict[_File, Path] = {}
    for output in (Path(one) for one in outputs if one is not None):
        if _is_device(output):
            continue
        file = _file(output)
        if file in read:
            raise ServiceError(
                f"cannot write {output}: it is the same file as the input {read[file]}; name another output file",
                code="output-is-input",
            )
        if file in taken:
            raise ServiceError(
                f"cannot write {output}: it is the same file as the output {taken[file]}; name two different files",
                code="outputs-equal",
            )
        taken[file] = output
        _check_writable(output)
        _check_free(output, overwrite)


def check_output_folder(folder: Name) -> None:
    """Raise ``ServiceError`` "output-not-writable" if files cannot be written into a folder.

    If the folder does not exist, the nearest existing folder above it is checked. No folder is made.
    """
    there = Path(folder)
    with _not_writable(there):
        while not there.exists():
            there = there.parent
        if not there.is_dir():
            raise NotADirectoryError(None, f"expected a folder; {there} is a file")
        probe(there / "output")


@contextmanager
def written(output: Name, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary path for the content of ``output``. The file replaces ``output`` if the block ends without an
    exception.

    A name that ends in .gz gets a file in gzip. A symbolic link stays a link; the file that it leads to is replaced. A
    device or a pipe, such as /dev/stdout, is written directly. Raises ``ServiceError`` "output-exists" if the file
    exists and ``overwrite`` is false.
    """
    target = Path(output)
    if _is_device(target):
        yield target
        return
    _check_free(target, overwrite)
    with whole_path(target) as partial:
        yield partial
        _check_free(target, overwrite)  # another process may have written it during the work


def base_name(name: str) -> str:
    """The last part of a file name that somebody else chose: at most 200 printable characters, and no dot at its start.

    The result can be empty.
    """
    last = re.split(r"[/\\]", name)[-1]
    return printable(last).lstrip(".")[:200]


def _files_in(path: Path) -> Iterator[Path]:
    """The files of a folder; a file itself."""
    if path.is_dir():
        yield from (inside for inside in path.iterdir() if inside.is_file())
    else:
        yield path


def _file(path: Path) -> _File:
    """What identifies a file: its device and inode, or the resolved path of a file that does not exist."""
    try:
        found = path.stat()
    except OSError:
        return os.path.realpath(path)
    return found.st_dev, found.st_ino


def _is_device(path: Path) -> bool:
    return path.exists() and not path.is_file() and not path.is_dir()


def _check_free(output: Path, overwrite: bool) -> None:
    if output.exists() and not overwrite:
        raise ServiceError(
            f"cannot write {output}: the file exists; name another file, or replace it (--overwrite, in Python "
            "overwrite=True)",
            code="output-exists",
        )


def _check_writable(output: Path) -> None:
    target = Path(os.path.realpath(output))
    with _not_writable(output):
        if target.is_dir():
            raise IsADirectoryError(None, "expected a file; this is a folder")
        if not target.parent.is_dir():
            raise NotADirectoryError(None, f"there is no folder {target.parent}: make it first")
        check_ending(output)
        probe(target)


@contextmanager
def _not_writable(output: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ServiceError(
            f"cannot write {output}: {error.strerror or error}", code="output-not-writable"
        ) from error
