"""Compile kernels (`psfcore.compiled`) with numba. Only this module and the modules that it loads import numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numba.core.base import BaseContext
from numba.core.caching import _Cache
from numba.core.ccallback import CFunc
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps, loads
from numba.core.sigutils import normalize_signature
from numba.core.types import Type
from numba.core.typing.templates import Signature

from psfcore.kernel_files import Kept, KernelFiles
from psfcore.machine_code import MachineCode

Result = Any  # a CompileResult, whose attributes numba does not declare


def dispatcher(
    function: Callable[..., Any], options: dict[str, Any], files: KernelFiles
) -> Callable[..., Any]:
    """`numba.njit` of a function, which releases the interpreter's lock. Its machine code is kept in files."""
    # Without the wrapper for callers in C: nothing calls it, and it takes time to compile.
    options = {**options, "nogil": True, "no_cfunc_wrapper": True}
    kernel: Callable[..., Any] = njit(**options)(function)
    if isinstance(kernel, Dispatcher):  # it is a plain function if compilation is switched off
        kernel._cache = KernelCache(files)  # type: ignore[attr-defined]  # numba has no public way
    return kernel


def callback(
    function: Callable[..., Any], signature: str, options: dict[str, Any], files: KernelFiles
) -> CFunc:
    """`numba.cfunc` of a function, whose machine code is kept in files. It is compiled if it is not kept yet."""
    kernel = CFunc(function, normalize_signature(signature), {}, options)
    kernel._cache = KernelCache(files, signature)  # type: ignore[attr-defined]  # as above
    kernel.compile()
    return kernel


class KernelCache(_Cache):
    """Keeps the machine code of one function in its files, where numba looks for it.

    Parameters
    ----------
    files
        The files of the function.
    key
        The key of its only file. Default: the types of the arguments, as `psfcore.compiled.spelled` spells them.
    """

    def __init__(self, files: KernelFiles, key: str | None = None) -> None:
        self._files, self._key = files, key

    @property
    def cache_path(self) -> str:
        return str(self._files.folders[0])

    def load_overload(self, sig: Signature | tuple[Type, ...], target_context: BaseContext) -> Result:
        """The machine code for these types of arguments; None if it is not on disk.

        numba's own method first makes all types and functions known to the compiler, which takes longer than to load
        all kernels of a deconvolution. Machine code only needs the memory of numba's arrays; the compiler prepares
        itself.
        """
        rtsys.initialize(target_context)
        kept = self._files.load(self._key_of(sig))
        if kept is None:
            return None
        return CompileResult._rebuild(target_context, *loads(kept.for_numba))

    def save_overload(self, sig: Signature | tuple[Type, ...], cres: Result) -> None:
        if not (cres.lifted or cres.library.has_dynamic_globals):  # else an address of this process is in it
            parts = cres._reduce()
            kept = Kept(_machine_code(cres, parts[0], by_address=self._key is not None), dumps(parts))
            self._files.save(self._key_of(sig), kept)

    def _key_of(self, sig: Signature | tuple[Type, ...]) -> str:
        return self._key or ", ".join(str(one) for one in normalize_signature(sig)[0])

    def enable(self) -> None:
        """Do nothing: the cache is always used."""

    disable = flush = enable


def _machine_code(
    result: Result, library: tuple[str, str, tuple[bytes, bytes]], *, by_address: bool
) -> MachineCode | None:
    """What runs a kernel without numba; None if numba must prepare something each time.

    Parameters
    ----------
    library
        Name, kind and content of the object code, as numba keeps it.
    by_address
        Whether the kernel is called by its address.
    """
    environments = {
        one.env_name: one.consts for one in (result.environment, *result._find_referenced_environments())
    }
    values = [value for some in environments.values() for value in some]
    if result.reload_init or result.objectmode or not all(isinstance(value, np.dtype) for value in values):
        return None
    names = result.fndesc
    module = result.library._final_module
    outside = (one.name for one in (*module.functions, *module.global_variables) if one.is_declaration)
    return MachineCode(
        code=library[2][0],
        entry=names.llvm_cfunc_wrapper_name if by_address else names.llvm_cpython_wrapper_name,
        environments=[(name, [kind.str for kind in kinds]) for name, kinds in environments.items()],
        needed=[name for name in outside if not name.startswith("llvm.")],
    )
