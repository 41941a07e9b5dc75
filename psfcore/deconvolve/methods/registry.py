"""Find methods by name: each file of this package that has a constant METHOD holds a method."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

import psfcore.deconvolve.methods
from psfcore.deconvolve.conditions import Deconvolved
from psfcore.deconvolve.problem import Method
from psfcore.errors import DataError


def method_named(name: str) -> Callable[..., Deconvolved]:
    """The function `deconvolve(image, psf, conditions, **parameters)` of a method.

    Raises DataError "unknown-method", whose message lists the known methods.
    """
    deconvolve: Callable[..., Deconvolved] = _module_of(name).deconvolve
    return deconvolve


def properties_of(name: str) -> Method:
    """The properties of a method. Raises DataError "unknown-method"."""
    properties: Method = _module_of(name).METHOD
    return properties


def method_names() -> list[str]:
    """The names of all methods."""
    return sorted(_modules())


def _module_of(name: str) -> Any:
    if name not in _modules():
        raise DataError(
            "unknown-method", f"expected one of the methods {', '.join(method_names())}; got {name!r}"
        )
    return _modules()[name]


@cache
def _modules() -> dict[str, Any]:
    package = psfcore.deconvolve.methods
    files = [
        import_module(f"{package.__name__}.{one.name}") for one in pkgutil.iter_modules(package.__path__)
    ]
    return {file.METHOD.name: file for file in files if hasattr(file, "METHOD")}
