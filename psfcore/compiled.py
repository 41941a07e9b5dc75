"""Kernels compiled by numba, kept on disk so that processes that start at the same moment cannot mix them up.

numba numbers the machine code of a function in an index that is read, changed and written without a lock, and names its
symbols by a counter of the process. Two processes that compile two kernels of one name at once, as passes of two
lengths are (``fft_kernels``), can both write number 1, and give two kernels one symbol. Either is then called for the
other: transforms come out wrong, and nothing says so. Here a file is named after what was compiled, without an index,
and functions that a function makes have names of their own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import numba
from numba import njit
from numba.core.caching import IndexDataCacheFile
from numba.core.dispatcher import Dispatcher


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
    """The files of a function's kernels: each named after its key, with the source that it was compiled from inside.

    A key tells the types of the arguments, the processor, and the constants that a closure holds.
    """

    def save(self, key: Any, data: Any) -> None:
        """Keep a kernel; whoever looks sees all of its file, or none."""
        self._save_data(self._name(key), (self._source_stamp, data))

    def load(self, key: Any) -> Any:
        """The kernel of this key and of the source as it is now; None where it was not compiled yet."""
        try:
            stamp, data = self._load_data(self._name(key))
        except FileNotFoundError:
            return None
        return data if stamp == self._source_stamp else None

    def _name(self, key: Any) -> str:
        told = repr((numba.__version__, key))
        return self._index_name.removesuffix("nbi") + hashlib.sha256(told.encode()).hexdigest()[:24] + ".nbc"
