"""Compile kernels (fast functions) with numba and keep them on disk. Several processes may compile at the same time.

numba's own cache is not safe when several processes compile. It keeps the machine code of a function in numbered
files; it reads, changes and writes the index of these files without a lock; and it names symbols by a counter of the
process. Two processes can compile two kernels of the same name at once, for example FFT passes of two lengths
(`fft_kernels`). Both may then write file number 1 or use the same symbol. One kernel is then called in place of the
other, and the transforms are wrong without any error message. The cache in this module has no index. The name of a
file is a hash of what was compiled, and a function that is defined inside another function gets a unique name.

numba also does not notice when a kernel calls a function of another file and that file changes. In this module, every
kernel depends on all source files that define kernels. If a power failure left a kernel file incomplete, the file is
ignored.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.caching import IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

SEAL_BYTES = 2 * hashlib.sha256().digest_size
MARK = b"@compiled("
log = logging.getLogger(__name__)


def compiled(
    *, name: str | None = None, **options: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: `numba.njit` with these options. The kernel releases the interpreter's lock and is kept on disk.

    name: required for a function that uses constants of its enclosing function. Each set of constants needs another
    name. Raises TypeError if the name is required and missing.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        if function.__closure__ is not None and name is None:
            raise TypeError(
                f"expected an argument name: {function.__qualname__} uses constants of its enclosing function"
            )
        function.__qualname__ = name or function.__qualname__
        kernel: Any = njit(nogil=True, cache=True, **options)(function)
        if isinstance(kernel, Dispatcher):  # it is a plain function if compilation is switched off
            cache = kernel._cache  # type: ignore[attr-defined]
            cache._cache_file = KernelFiles(
                cache.cache_path, cache._impl.filename_base, cache._impl.locator.get_source_stamp()
            )
        return kernel

    return decorate


class KernelFiles(IndexDataCacheFile):
    """The kernel files of one function. A file is named by its key and ends with a hash of sources and content.

    The key consists of the argument types, the processor and the constants of a closure.
    """

    def save(self, key: Any, data: Any) -> None:
        """Write a kernel to disk in one step. If this fails, log a warning; the kernel can still be used."""
        payload = self._dump(data)
        try:
            with self._open_for_write(self._data_path(self._name(key))) as file:
                file.write(payload + self._seal(payload))
        except OSError as error:
            log.warning(
                "cannot write a compiled kernel to disk; each process will compile it again: %s", error
            )

    def load(self, key: Any) -> Any:
        """The kernel for this key, compiled from the present sources; None if it is not on disk yet."""
        name = self._name(key)
        if not self._is_good(name):
            return None
        data = self._load_data(name)
        # Meanwhile, a process of another version may have replaced the file.
        return data if self._is_good(name) else None

    def _is_good(self, name: str) -> bool:
        try:
            kept = Path(self._data_path(name)).read_bytes()
        except FileNotFoundError:
            return False
        return kept[-SEAL_BYTES:] == self._seal(kept[:-SEAL_BYTES])

    def _seal(self, payload: bytes) -> bytes:
        stamp = repr((self._version, self._source_stamp, sources_sha256()))
        return hashlib.sha256(stamp.encode()).digest() + hashlib.sha256(payload).digest()

    def _name(self, key: Any) -> str:
        told = repr((self._version, key))
        return self._index_name.removesuffix("nbi") + hashlib.sha256(told.encode()).hexdigest()[:24] + ".nbc"


@cache
def sources_sha256() -> str:
    """SHA-256 of all source files of psfcore that define kernels."""
    sources = sorted(path.read_bytes() for path in Path(__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(source for source in sources if MARK in source)).hexdigest()
