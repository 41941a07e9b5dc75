"""Compile kernels (fast functions) with numba and keep them on disk. Several processes may compile at the same time.

numba's own cache is not safe when several processes compile. This cache keeps the machine code of a function in
numbered files; it reads, changes and writes the index of these files without a lock; and it names symbols by a counter
of the process. Two processes can compile two kernels of the same name at once, for example FFT passes of two radices
(`fft_kernels`). Both may then write file number 1 or use the same symbol. One kernel is then called in place of the
other, and the transforms are wrong without any error message. The cache in this module has no index. The name of a file
is a hash of what was compiled, and a function that is defined inside another function gets a unique name.

numba also does not notice when a kernel calls a function of another file and that file changes. In this module, every
kernel depends on all source files that define kernels. If a power failure left a kernel file incomplete, the file is
ignored.

A kernel file contains machine code, and loading it executes it. Therefore a folder is used only if nobody else can
write to it; otherwise the kernels are kept in a private folder of the user's cache. If there is none either, each
process compiles the kernels again.
"""

from __future__ import annotations

import hashlib
import inspect
import logging
import os
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserWideCacheLocator,
)
from numba.core.ccallback import CFunc
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.typing.templates import Signature

from psfcore.files import CACHE_VARIABLE, cache_folder

# The function that is called when this thread compiles a kernel. A new thread has no listener, so a kernel that another
# thread of a job compiles is not reported.
_LISTENER: ContextVar[Callable[[bool], None] | None] = ContextVar("listener", default=None)
SEAL_BYTES = 2 * hashlib.sha256().digest_size
MARK = b"@compiled"  # the decorators of this module
SOURCE = Path(__file__)
log = logging.getLogger(__name__)


def compiled(
    *, name: str | None = None, **options: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: `numba.njit` with these options. The kernel releases the interpreter's lock and is kept on disk.

    Raises TypeError if the name is required and missing.

    Parameters
    ----------
    name
        Name of the kernel, which a function needs that uses constants of its enclosing function. Each set of constants
        needs another name.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        if function.__closure__ is not None and name is None:
            raise TypeError(
                f"expected an argument name: {function.__qualname__} uses constants of its enclosing function"
            )
        function.__qualname__ = name or function.__qualname__
        # Without the wrapper for callers in C: nothing calls it, and it takes time to compile.
        options.update(nogil=True, no_cfunc_wrapper=True)
        kernel: Callable[..., Any] = njit(**options)(function)
        if isinstance(kernel, Dispatcher):  # it is a plain function if compilation is switched off
            kernel._cache = KernelCache(function)  # type: ignore[attr-defined]  # numba has no public way
        return kernel

    return decorate


class Addressed:
    """A kernel that other kernels call by its address. Such kernels need not be compiled again if this one changes."""

    def __init__(
        self, function: Callable[..., None], signature: Signature, options: dict[str, object]
    ) -> None:
        self._function = function
        self._kernel = CFunc(function, (signature.args, signature.return_type), {}, options)
        self.__qualname__ = function.__qualname__

    @cached_property
    def address(self) -> int:
        """The address of the machine code, which is valid until this process ends. The kernel is loaded from disk, or
        compiled if it is not kept there.
        """
        kernel: Any = self._kernel
        kernel._cache = KernelCache(self._function)
        kernel.compile()
        return int(kernel.address)


def compiled_at_address(
    signature: Signature, *, name: str, **options: object
) -> Callable[[Callable[..., None]], Addressed]:
    """Decorator for a kernel that is called by its address: `numba.cfunc` with this signature and these options.

    The kernel is compiled when its address is asked for.

    Parameters
    ----------
    name
        Name of the kernel, see `compiled`; each kernel of a file needs another name.
    """

    def decorate(function: Callable[..., None]) -> Addressed:
        function.__qualname__ = name
        return Addressed(function, signature, options)

    return decorate


class _Private(UserWideCacheLocator):
    """The private folder for kernels. It may not exist: `KernelFiles` checks it."""

    def get_cache_path(self) -> str:
        """The path of the folder."""
        return str(private_folder())

    def ensure_cache_path(self) -> None:
        """Do nothing."""


class _Place(CompileResultCacheImpl):
    """The folder that numba chooses for the machine code of a function; the private one if it can write to none."""

    def __init__(self, function: Callable[..., object]) -> None:
        try:
            super().__init__(function)
        except RuntimeError:  # numba found no folder, and would not even compile the function
            self._locator = _Private(function, inspect.getfile(function))
            name = f"{function.__module__}.{function.__qualname__}"
            self._filename_base = self.get_filename_base(name, getattr(sys, "abiflags", ""))


class KernelCache(FunctionCache):
    """Keeps the machine code of one function in `KernelFiles`."""

    _impl_class = _Place

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)
        self._cache_file = KernelFiles(
            kernel_folder(Path(self.cache_path)),
            self._impl.filename_base,
            self._impl.locator.get_source_stamp(),
        )

    def load_overload(self, signature: object, target_context: object) -> object:
        """The machine code for these types of arguments; None if it is not on disk.

        numba's own method first makes all types and functions known to the compiler, which takes longer than to load
        all kernels of a deconvolution. Machine code only needs the memory of numba's arrays; the compiler prepares
        itself.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(signature, target_context)


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


@cache
def kernel_folder(usual: Path) -> str:
    """The folder for kernels: `usual` if nobody else can write to it, otherwise a private folder of the user's cache.

    If the private folder cannot be made, `KernelFiles` neither writes nor reads kernels.
    """
    if trusted(usual):
        return str(usual)
    private = private_folder()
    with suppress(OSError):  # a folder that cannot be made is not trusted
        private.mkdir(mode=0o700, parents=True, exist_ok=True)
    return str(private)


def private_folder() -> Path:
    """The folder of the user's cache for the kernels of this installation; it may not exist."""
    return cache_folder() / f"kernels-{hashlib.sha256(str(SOURCE).encode()).hexdigest()[:12]}"


def folder_of_kernels() -> tuple[Path, bool]:
    """The folder of the compiled kernels of this package, and whether kernels can be kept there."""
    folder = Path(KernelCache(trusted)._cache_file._cache_path)
    return folder, trusted(folder) and os.access(folder, os.W_OK | os.X_OK)


@cache
def _tell_not_kept(folder: str, reason: object) -> None:
    log.warning(
        "compiled kernels cannot be kept in %s (%s), so each process compiles them again, which takes longer: set "
        "NUMBA_CACHE_DIR or %s to a folder to which nobody else can write",
        folder,
        reason,
        CACHE_VARIABLE,
    )


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


def is_kept(kernel: object) -> bool:
    """Whether the disk has machine code of a kernel, compiled from the current sources, for any types of its
    arguments.
    """
    return not isinstance(kernel, Dispatcher) or kernel._cache._cache_file.any_kept()  # type: ignore[attr-defined]  # as above


class KernelFiles(IndexDataCacheFile):
    """The kernel files of one function. A file is named by its key and ends with a hash of sources and content.

    The key consists of the argument types, the processor and the constants of a closure.
    """

    def save(self, key: object, data: object) -> None:
        """Write a kernel to disk in one step. If this fails, log a warning once; the kernel can still be used."""
        _tell(done=True)
        if not trusted(Path(self._cache_path)):
            _tell_not_kept(self._cache_path, "it cannot be made, or others can write to it")
            return
        payload = self._dump(data)
        try:
            with self._open_for_write(self._data_path(self._name(key))) as file:
                file.write(payload + self._seal(payload))
        except OSError as error:
            _tell_not_kept(self._cache_path, error.strerror)

    def load(self, key: object) -> object:
        """The kernel for this key, compiled from the current sources; None if it is not on disk and must be
        compiled.
        """
        data = self._found(self._name(key))
        if data is None:
            _tell(done=False)
        return data

    def any_kept(self) -> bool:
        """Whether any kernel file of the function was compiled from the current sources."""
        pattern = self._index_name.removesuffix("nbi") + "*.nbc"
        return any(self._is_good(path.name) for path in Path(self._cache_path).glob(pattern))

    def _found(self, name: str) -> object:
        if not (
            self._is_good(name) and trusted(Path(self._cache_path)) and trusted(Path(self._data_path(name)))
        ):
            return None
        data = self._load_data(name)
        # A process of another version may have replaced the file in the meantime.
        return data if self._is_good(name) else None

    def _is_good(self, name: str) -> bool:
        try:
            content = Path(self._data_path(name)).read_bytes()
        except FileNotFoundError:
            return False
        return content[-SEAL_BYTES:] == self._seal(content[:-SEAL_BYTES])

    def _seal(self, payload: bytes) -> bytes:
        stamp = repr((self._version, self._source_stamp, sources_sha256()))
        return hashlib.sha256(stamp.encode()).digest() + hashlib.sha256(payload).digest()

    def _name(self, key: object) -> str:
        text = repr((self._version, key))
        return self._index_name.removesuffix("nbi") + hashlib.sha256(text.encode()).hexdigest()[:24] + ".nbc"


@cache
def sources_sha256() -> str:
    """SHA-256 of all source files of psfcore that define kernels."""
    sources = sorted(path.read_bytes() for path in Path(__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(source for source in sources if MARK in source)).hexdigest()
