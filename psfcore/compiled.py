"""Kernels compiled by numba, kept on disk so that processes that start at the same moment cannot mix them up.

numba numbers the machine code of a function in an index that is read, changed and written without a lock, and names its
symbols by a counter of the process. Two processes that compile two kernels of one name at once, as passes of two
lengths are (``fft_kernels``), can both write number 1, and give two kernels one symbol. Either is then called for the
other: transforms come out wrong, and nothing says so. Here a file is named after what was compiled, without an index,
and functions that a function makes have names of their own.

Nor does numba see that a function in another file, which a kernel calls and holds, has changed: here kernels go by all
files that define any. A file that a loss of power has cut is none.
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
    """Decorator: ``numba.njit`` with these options, without the interpreter's lock, and kept on disk.

    name: for functions that hold constants of the function around them, another for each set of constants.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        if function.__closure__ is not None and name is None:
            raise TypeError(f"expected a name of its own for {function.__qualname__}, which holds constants")
        function.__qualname__ = name or function.__qualname__
        kernel: Any = njit(nogil=True, cache=True, **options)(function)
        if isinstance(kernel, Dispatcher):  # a plain function where compiling is switched off
            cache = kernel._cache  # type: ignore[attr-defined]
            cache._cache_file = KernelFiles(
                cache.cache_path, cache._impl.filename_base, cache._impl.locator.get_source_stamp()
            )
        return kernel

    return decorate


class KernelFiles(IndexDataCacheFile):
    """The files of a function's kernels, each named after its key; inside, what it was compiled from and its hash.

    A key tells the types of the arguments, the processor, and the constants that a closure holds.
    """

    def save(self, key: Any, data: Any) -> None:
        """Keep a kernel; whoever looks sees all of its file, or none. Where it cannot be kept, it is used all the same."""
        payload = self._dump(data)
        try:
            with self._open_for_write(self._data_path(self._name(key))) as file:
                file.write(payload + self._seal(payload))
        except OSError as error:
            log.warning("a compiled kernel cannot be kept, and is compiled again by each process: %s", error)

    def load(self, key: Any) -> Any:
        """The kernel of this key and of the sources as they are now; None where it was not compiled yet."""
        name = self._name(key)
        if not self._is_good(name):
            return None
        data = self._load_data(name)
        # A process of another version may have put its own there meanwhile.
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
    """The SHA-256 of all files of this package that define kernels."""
    sources = sorted(path.read_bytes() for path in Path(__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(source for source in sources if MARK in source)).hexdigest()
