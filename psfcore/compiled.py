"""Kernels: functions that numba compiles. Their machine code is kept on disk (`psfcore.kernel_files`).

A kernel that is kept runs without numba (`psfcore.machine_code`). numba is imported only to compile: if a kernel is not
kept for the types of its arguments, or if they are of types that `spelled` does not know.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import update_wrapper
from importlib import import_module
from pathlib import Path
from threading import RLock
from types import FunctionType
from typing import TYPE_CHECKING, Any

import numpy as np

from psfcore.kernel_files import KernelFiles, folders_of, source_stamp
from psfcore.machine_code import Linked, Unlinkable

if TYPE_CHECKING:
    from numba.core.ccallback import CFunc

# One thread at a time loads or compiles kernels.
_LOADING = RLock()
KERNELS: list[Kernel | Addressed] = []  # those of the modules that are imported
# How numba spells numbers.
_NUMBERS: dict[np.dtype[np.generic], str] = {
    np.dtype(name): name
    for name in (
        "bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64",
        "complex64", "complex128",
    )
}  # fmt: skip
_SCALARS: dict[type, str] = {
    bool: "bool",
    int: "int64",
    float: "float64",
    complex: "complex128",
    type(None): "none",
    **{kind.type: name for kind, name in _NUMBERS.items()},
}


class Unknown(TypeError):
    """A value whose type only numba can spell."""


def spelled(value: object) -> str:
    """The type of an argument, spelled as numba spells it.

    Raises Unknown for types that kernels rarely get.
    """
    kind = type(value)
    if isinstance(value, np.ndarray) and kind is np.ndarray:
        flags = value.flags
        layout = "C" if flags.c_contiguous else "F" if flags.f_contiguous else "A"
        number = _NUMBERS.get(value.dtype)
        if number is None or not flags.aligned:
            raise Unknown(str(value.dtype))
        return f"{'' if flags.writeable else 'readonly '}array({number}, {value.ndim}d, {layout})"
    if isinstance(value, tuple):
        kinds = [spelled(one) for one in value]
        same = bool(kinds) and kinds.count(kinds[0]) == len(kinds)
        inner = f"{kinds[0]} x {len(kinds)}" if same else ", ".join(kinds)
        if kind is tuple:
            return f"{'UniTuple' if same else 'Tuple'}({inner})"
        return f"{kind.__name__}({inner})"
    if kind not in _SCALARS:
        raise Unknown(kind.__name__)
    return _SCALARS[kind]


class Later:
    """A module that only the compiler needs. It is imported when a kernel that names it is compiled."""

    def __init__(self, module: str) -> None:
        self._module = module

    @property
    def for_compiler(self) -> object:
        """The module."""
        return import_module(self._module)


class Kernel:
    """A function that is compiled for each combination of types of its arguments, when it is first called with them."""

    __qualname__: str

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self._function, self._options = function, options
        self._entries: dict[str, Callable[..., Any]] = {}
        self._for_compiler: Callable[..., Any] | None = None
        self.files = _files_of(function)
        KERNELS.append(self)

    def __call__(self, *arguments: Any) -> Any:
        try:
            kinds = ", ".join([spelled(one) for one in arguments])
        except Unknown:
            return self.for_compiler(*arguments)
        entry = self._entries.get(kinds)
        if entry is None:
            with _LOADING:
                entry = self._entries.setdefault(kinds, self._entry(kinds))
        return entry(*arguments)

    def _entry(self, kinds: str) -> Callable[..., Any]:
        linked = _linked(self.files, kinds)
        return self.for_compiler if linked is None else linked.function(self.__qualname__)

    @property
    def for_compiler(self) -> Callable[..., Any]:
        """The kernel as numba knows it: numba compiles it for further types, and into kernels that call it."""
        with (
            _LOADING
        ):  # not a cached_property, whose own lock another thread may hold while it waits for this one
            if self._for_compiler is None:
                from psfcore.compiling import dispatcher

                self._for_compiler = dispatcher(_for_compiler(self._function), self._options, self.files)
            return self._for_compiler


class Addressed:
    """A kernel that other kernels call by its address. Such kernels need not be compiled again if this one changes."""

    def __init__(self, function: Callable[..., None], signature: str, options: dict[str, Any]) -> None:
        self._function, self._signature, self._options = function, signature, options
        self._code: Linked | CFunc[Callable[..., None]] | None = None
        self.__qualname__ = function.__qualname__
        self.files = _files_of(function)
        KERNELS.append(self)

    @property
    def address(self) -> int:
        """The address of the machine code, which is valid until this process ends. The kernel is loaded from disk, or
        compiled if it is not kept there.
        """
        with _LOADING:
            if self._code is None:
                self._code = _linked(self.files, self._signature)
            if self._code is None:
                from psfcore.compiling import callback

                twin = _for_compiler(self._function)
                self._code = callback(twin, self._signature, self._options, self.files)
            assert self._code.address is not None  # it is compiled
            return self._code.address


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
        return Kernel(function, options)

    return decorate


def compiled_at_address(
    signature: str, *, name: str, **options: Any
) -> Callable[[Callable[..., None]], Addressed]:
    """Decorator for a kernel that is called by its address: `numba.cfunc` with this signature and these options.

    The kernel is compiled when its address is asked for.

    Parameters
    ----------
    signature
        The types of result and arguments, as numba spells them.
    name
        Name of the kernel, see `compiled`; each kernel of a file needs another name.
    """

    def decorate(function: Callable[..., None]) -> Addressed:
        function.__qualname__ = name
        return Addressed(function, signature, options)

    return decorate


def is_kept(kernel: object) -> bool:
    """Whether the disk has machine code of a kernel, compiled from the current sources, for any types of its
    arguments.
    """
    assert isinstance(kernel, Kernel | Addressed)
    return kernel.files.any_kept()


def _files_of(function: Callable[..., Any]) -> KernelFiles:
    source, code = Path(function.__code__.co_filename), function.__code__
    constants = tuple(cell.cell_contents for cell in function.__closure__ or ())
    stem = f"{function.__module__}.{function.__qualname__}-{code.co_firstlineno}"
    return KernelFiles(folders_of(source), stem, source_stamp(source), repr((code.co_code, constants)))


def _linked(files: KernelFiles, kinds: str) -> Linked | None:
    """The machine code of a kernel, if it is kept and can run without numba."""
    kept = None if "NUMBA_DISABLE_JIT" in os.environ else files.find(kinds)
    if kept is None or kept.machine_code is None:
        return None
    try:
        return Linked(kept.machine_code)
    except Unlinkable:
        return None


def _for_compiler(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with the names that numba knows in place of kernels and later modules."""
    assert isinstance(function, FunctionType)
    names = function.__globals__
    known = {
        name: names[name].for_compiler
        for name in function.__code__.co_names
        if isinstance(names.get(name), Kernel | Later)
    }
    twin = FunctionType(
        function.__code__, names | known, function.__name__, function.__defaults__, function.__closure__
    )
    twin.__qualname__, twin.__doc__ = function.__qualname__, function.__doc__
    return twin
