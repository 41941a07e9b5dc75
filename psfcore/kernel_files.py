"""Keep compiled kernels (fast functions) on disk. Several processes may compile at the same time.

numba's own cache is not safe when several processes compile. That cache keeps the machine code of a function in
numbered files; it reads, changes and writes the index of these files without a lock; and it names symbols by a counter
of the process. Two processes can compile two kernels of the same name at once, for example FFT passes of two radices
(`fft_kernels`). Both may then write file number 1 or use the same symbol. One kernel is then called in place of the
other, and the transforms are wrong without any error message. The cache in this module has no index. The name of a file
is a hash of what was compiled, and a function that is defined inside another function gets a unique name.

numba also does not notice when a kernel calls a function of another file and that file changes. In this module, every
kernel depends on all source files that define kernels. If a power failure left a kernel file incomplete, the file is
ignored.

A kernel file contains machine code, and loading it executes it. Therefore a folder is used only if nobody else can
write to it. Kernels are looked for in two folders: beside their source or in NUMBA_CACHE_DIR, where an administrator
may have compiled them for all users (`heliopsf doctor --compile`), and in a private folder of the user's cache. A new
kernel is written to the first of them to which this user can write. If there is none, each process compiles the kernels
again.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import logging
import os
import stat
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import NamedTuple

from psfcore.files import CACHE_VARIABLE, cache_folder
from psfcore.machine_code import MachineCode, processor

# The function that is called when this thread compiles a kernel. A new thread has no listener, so a kernel that another
# thread of a job compiles is not reported.
_LISTENER: ContextVar[Callable[[bool], None] | None] = ContextVar("listener", default=None)
FOLDER_VARIABLE = "NUMBA_CACHE_DIR"
SUFFIX = ".nbc"  # of kernel files
SEAL_BYTES = 2 * hashlib.sha256().digest_size
MARK = b"@compiled"  # the decorators of `psfcore.compiled`
SOURCE = Path(__file__)
log = logging.getLogger(__name__)


class Kept(NamedTuple):
    """A compiled kernel as it is kept.

    Attributes
    ----------
    machine_code
        What runs the kernel without numba; None: the kernel needs numba.
    for_numba
        What numba needs to compile other kernels that call this one, pickled by numba.
    """

    machine_code: MachineCode | None
    for_numba: bytes


@contextmanager
def listening(listener: Callable[[bool], None]) -> Iterator[None]:
    """In the block, call listener(False) when this thread begins to compile a kernel, and listener(True) when it has
    finished.

    The compilation of a kernel takes some seconds, once per installation. If the listener raises an exception, the
    kernel is not called.
    """
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def _tell(*, done: bool) -> None:
    listener = _LISTENER.get()
    if listener is not None:
        listener(done)


# Folders ----------------------------------------------------------------------------------------


def folders_of(source: Path) -> tuple[Path, Path]:
    """The folders in which the kernels of a source file are looked for. They may not exist: `KernelFiles` checks them.

    All kernels of this package are in one folder.
    """
    package = SOURCE.parent
    root = package if source.is_relative_to(package) else source.parent
    named = os.environ.get(FOLDER_VARIABLE)
    if not named:
        return root / "__pycache__", private_folder()
    # The source files of another installation have kernels of the same names.
    return Path(named) / f"{root.name}_{_short(str(root))}", private_folder()


def private_folder() -> Path:
    """The folder of the user's cache for the kernels of this installation; it may not exist."""
    return cache_folder() / f"kernels-{_short(str(SOURCE))}"


def folder_of_kernels() -> tuple[Path, bool]:
    """The folder of the compiled kernels of this package, and whether kernels can be kept there."""
    folders = folders_of(SOURCE)
    writable = writable_of(folders)
    return writable or folders[-1], writable is not None


def writable_of(folders: tuple[Path, ...]) -> Path | None:
    """The first folder in which kernels can be kept; it is made if it does not exist."""
    for folder in folders:
        with suppress(OSError):  # a folder that cannot be made is not trusted
            folder.mkdir(mode=0o700 if folder == private_folder() else 0o755, parents=True, exist_ok=True)
        if trusted(folder) and os.access(folder, os.W_OK | os.X_OK):
            return folder
    return None


def trusted(path: Path) -> bool:
    """Whether only this user, the administrator, and users who can change this module can change a file or folder.

    The folders above it are checked too, because a user who can rename one of them can replace it by another folder.
    """
    if not hasattr(os, "geteuid"):  # a system without the owners and modes of POSIX
        return True
    source = SOURCE.stat()
    owners = {0, os.geteuid(), source.st_uid, Path("/").stat().st_uid}
    shared_group = source.st_gid if source.st_mode & stat.S_IWGRP else None
    try:
        path = path.resolve(strict=True)
        states = [one.stat() for one in (path, *path.parents)]
    except OSError:  # the path does not exist, or this user may not read it
        return False
    for place, one in enumerate(states):
        if one.st_uid not in owners:
            return False
        others = one.st_mode & stat.S_IWOTH or (one.st_mode & stat.S_IWGRP and one.st_gid != shared_group)
        # In a folder with the sticky bit, such as /tmp, nobody can rename the folders of other users.
        if others and not (place > 0 and one.st_mode & stat.S_ISVTX):
            return False
    return True


@cache
def _tell_not_kept(folder: Path, reason: object) -> None:
    log.warning(
        "compiled kernels cannot be kept in %s (%s), so each process compiles them again, which takes longer: set "
        "%s or %s to a folder to which nobody else can write",
        folder,
        reason,
        FOLDER_VARIABLE,
        CACHE_VARIABLE,
    )


# Files ------------------------------------------------------------------------------------------


class KernelFiles:
    """The kernel files of one function. A file is named by its key and ends with a hash of sources and content.

    Parameters
    ----------
    folders
        Folders in which the files are looked for.
    stem
        How the names of the files begin.
    stamp
        Hash of the source of the function.
    code
        The code of the function and its constants, which depend on its enclosing function.
    """

    def __init__(self, folders: tuple[Path, ...], stem: str, stamp: str, code: str = "") -> None:
        self.folders = folders
        self._stem, self._stamp, self._code = f"{stem}.{sys.implementation.cache_tag}", stamp, code

    def load(self, key: str) -> Kept | None:
        """The kernel for these types of arguments, compiled from the current sources for this processor; None if it is
        not on disk and must be compiled.
        """
        kept = self.find(key)
        if kept is None:
            _tell(done=False)
        return kept

    def find(self, key: str) -> Kept | None:
        """As `load`, but nobody is told that the kernel must be compiled."""
        for folder in self.folders:
            path = folder / self._name(key)
            content = self._content(path) if trusted(folder) and trusted(path) else None
            if content is not None:
                return _unpacked(content)
        return None

    def save(self, key: str, kept: Kept) -> None:
        """Write a kernel to disk in one step. If this fails, log a warning once; the kernel can still be used."""
        _tell(done=True)
        folder = writable_of(self.folders)
        if folder is None:
            _tell_not_kept(self.folders[-1], "it cannot be made, or others can write to it")
            return
        payload = _packed(kept)
        path = folder / self._name(key)
        partial = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
        try:
            try:
                partial.write_bytes(payload + self._seal(payload))
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
        except OSError as error:
            _tell_not_kept(folder, error.strerror)

    def any_kept(self) -> bool:
        """Whether any kernel file of the function was compiled from the current sources."""
        return any(
            self._content(path) is not None
            for folder in self.folders
            for path in folder.glob(f"{self._stem}.*{SUFFIX}")
        )

    def _content(self, path: Path) -> bytes | None:
        """The content of a file without its seal; None if this user can read no such file, or it is of other sources,
        or not whole.
        """
        try:
            content = path.read_bytes()
        except (FileNotFoundError, PermissionError):
            return None
        payload = content[:-SEAL_BYTES]
        return payload if content[-SEAL_BYTES:] == self._seal(payload) else None

    def _seal(self, payload: bytes) -> bytes:
        stamp = repr((compiler_version(), self._stamp, sources_sha256()))
        return hashlib.sha256(stamp.encode()).digest() + hashlib.sha256(payload).digest()

    def _name(self, key: str) -> str:
        return f"{self._stem}.{_short(repr((compiler_version(), processor(), self._code, key)))}{SUFFIX}"


def _packed(kept: Kept) -> bytes:
    """The content of a kernel file: a line of JSON, the object code, and what numba needs."""
    machine = kept.machine_code
    about = None if machine is None else machine._asdict()
    code = b"" if about is None else about.pop("code")
    return json.dumps({"machine_code": about, "bytes": len(code)}).encode() + b"\n" + code + kept.for_numba


def _unpacked(content: bytes) -> Kept:
    head, _, rest = content.partition(b"\n")
    fields = json.loads(head)
    about, size = fields["machine_code"], fields["bytes"]
    return Kept(None if about is None else MachineCode(code=rest[:size], **about), rest[size:])


def _short(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:24]


@cache
def source_stamp(source: Path) -> str:
    """SHA-256 of a source file."""
    return hashlib.sha256(source.read_bytes()).hexdigest()


@cache
def sources_sha256() -> str:
    """SHA-256 of all source files of psfcore that define kernels."""
    sources = sorted(path.read_bytes() for path in SOURCE.parent.rglob("*.py"))
    return hashlib.sha256(b"".join(source for source in sources if MARK in source)).hexdigest()


@cache
def compiler_version() -> str:
    """A hash of the versions of numba and LLVM, which are not imported for it."""
    folders = (Path(str(importlib.util.find_spec(name).origin)).parent for name in ("numba", "llvmlite"))  # type: ignore[union-attr]  # they are required
    return _short("".join((folder / "_version.py").read_text("utf-8") for folder in folders))
