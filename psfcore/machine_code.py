"""Run the machine code of a kernel (`psfcore.compiled`) without importing numba, whose import takes longer than that of
any other library.

numba compiles for each kernel a wrapper that takes Python's objects and returns one. The wrapper calls functions of
three extension modules of numba: they convert arrays, raise exceptions and manage memory. They import the rest of numba
only if a kernel returns an array or raises an exception. This module loads them as numba does, tells LLVM the addresses
of their functions, and lets LLVM link the object code. Each kernel is linked by itself, so that symbols of two kernels
cannot be confused.
"""

from __future__ import annotations

import builtins
import ctypes
import importlib.util
import os
import platform
import sys
from collections.abc import Callable, Sequence
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

# The parts of numba that machine code calls, with the beginnings of the names by which it calls their functions.
_PARTS = {"_helperlib": "numba_", "_dynfunc": "numba_", "core.runtime._nrt_python": "NRT_"}


class MachineCode(NamedTuple):
    """The machine code of a kernel for one processor and these types of arguments.

    Attributes
    ----------
    code
        Object code, in the format of the operating system.
    entry
        The symbol that is called.
    environments
        Symbols that must point to an environment, and the types of numbers that each environment holds, as numpy names
        them.
    needed
        Symbols outside the object code.
    """

    code: bytes
    entry: str
    environments: Sequence[tuple[str, list[str]]]
    needed: Sequence[str]


@cache
def processor() -> tuple[str, str, str]:
    """The processor for which numba compiles: operating system, name and features. numba's variables can name another
    one than that of this machine, such as the oldest processor that runs a container.
    """
    from llvmlite import binding  # not needed until a kernel runs

    name, features = (os.environ.get(f"NUMBA_CPU_{part}") for part in ("NAME", "FEATURES"))
    if name is None:
        name = binding.get_host_cpu_name()
    elif features is None and name.lower() == "generic":
        features = ""  # as numba has it
    if features is None:
        features = f"{binding.get_host_cpu_features().flatten()} {os.environ.get('NUMBA_ENABLE_AVX', '')}"
    return binding.get_process_triple(), name, features


class Unlinkable(Exception):
    """Machine code that needs the rest of numba here."""


class Linked:
    """Machine code that is linked into this process.

    Raises Unlinkable if it needs a symbol that only the rest of numba defines, or on other processors than x86-64.

    Attributes
    ----------
    address
        The address of its entry.
    """

    def __init__(self, machine: MachineCode) -> None:
        from llvmlite import binding

        self._parts = _parts()
        target = binding.Target.from_triple(binding.get_process_triple())
        # The options are numba's. The code is compiled already, so none of them changes it.
        options = target.create_target_machine(reloc="static", codemodel="jitdefault", jit=True)
        self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), options)
        # The first engine makes the symbols of this process known. For an unknown symbol, LLVM would end the process.
        unknown = [name for name in machine.needed if not binding.address_of_symbol(name)]
        if unknown:
            raise Unlinkable(", ".join(unknown))
        self._engine.add_object_file(binding.ObjectFileRef.from_data(machine.code))
        self._engine.finalize_object()
        self.address: int = self._engine.get_function_address(machine.entry)
        self._environments = [self._environment(*one) for one in machine.environments]

    def _environment(self, symbol: str, kinds: list[str]) -> object:
        environment = self._parts["_dynfunc"].Environment({})
        environment.consts.extend(map(np.dtype, kinds))
        place = self._engine.get_global_value_address(symbol)
        if place:
            ctypes.c_void_p.from_address(place).value = id(environment)  # as numba's own set_env does
        return environment

    def function(self, name: str) -> Callable[..., Any]:
        """The function of Python objects at the address."""
        kept = (self._engine, self._environments)  # as long as the function
        module = sys.modules[__name__]
        make: Callable[..., Callable[..., Any]] = self._parts["_dynfunc"].make_function
        return make(module, name, "", self.address, self._environments[0], kept)


@cache
def _parts() -> dict[str, ModuleType]:
    """The extension modules of numba that machine code calls; LLVM knows their functions then.

    Raises Unlinkable on other processors than x86-64, whose object code numba links in other ways, and if this version
    of numba has other parts. numba itself then runs the kernels.
    """
    if platform.machine() not in ("x86_64", "AMD64"):
        raise Unlinkable(platform.machine())
    from llvmlite import binding

    try:
        parts = {name: _extension(name) for name in _PARTS}
        helpers = {name: parts[name].c_helpers for name in _PARTS}
        parts["core.runtime._nrt_python"].memsys_use_cpython_allocator()
    except (ImportError, OSError, AttributeError) as error:  # another version of numba may have other parts
        raise Unlinkable(str(error)) from error
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    for name, beginning in _PARTS.items():
        for function, address in helpers[name].items():
            binding.add_symbol(function if function.startswith("_") else beginning + function, address)
    # Machine code contains these objects, not the variables of C that point to them.
    binding.add_symbol("_Py_NoneStruct", id(None))
    for value in vars(builtins).values():
        if isinstance(value, type) and issubclass(value, BaseException):
            binding.add_symbol(f"PyExc_{value.__name__}", id(value))
    return parts


def _extension(name: str) -> ModuleType:
    """Import an extension module of numba, but not the packages that contain it."""
    full = f"numba.{name}"
    if full in sys.modules:
        return sys.modules[full]
    root = Path(str(importlib.util.find_spec("numba").origin)).parent  # type: ignore[union-attr]  # numba is required
    path = root.joinpath(*name.split(".")).with_suffix(EXTENSION_SUFFIXES[0])
    spec = importlib.util.spec_from_file_location(full, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules.pop(full, None)  # if numba is imported later, it finds the module by itself
    return module
