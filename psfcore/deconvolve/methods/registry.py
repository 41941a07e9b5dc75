"""Find methods by name: each file of this package with a constant METHOD and a function `deconvolve` is a method.

This module loads no numerical library; a method loads its iteration when it runs.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import psfcore.deconvolve.methods
from psfcore.deconvolve.declaration import Method
from psfcore.errors import DataError

if TYPE_CHECKING:
    from psfcore.deconvolve.conditions import Conditions, Deconvolved
    from psfcore.image import Image
    from psfcore.psf import Psf

DEFAULT = "richardson-lucy"


def method_named(name: str) -> Callable[..., Deconvolved]:
    """The function `deconvolve(image, psf, conditions, *, stop="fixed", **parameters)` of a method.

    Raises DataError "unknown-method", whose message lists the known methods.
    """
    method = properties_of(name)

    def deconvolve(
        image: Image, psf: Psf, conditions: Conditions, *, stop: str = "fixed", **parameters: Any
    ) -> Deconvolved:
        from psfcore.deconvolve.problem import pose

        values = method.complete(parameters)
        problem = pose(method, image, psf, conditions, steps=values.pop("steps"), stop=stop)
        return cast("Deconvolved", _modules()[name].deconvolve(problem, **values))

    return deconvolve


def properties_of(name: str) -> Method:
    """The properties of a method. Raises DataError "unknown-method"."""
    if name not in _modules():
        raise DataError(
            "unknown-method", f"expected one of the methods {', '.join(sorted(_modules()))}; got {name!r}"
        )
    return cast("Method", _modules()[name].METHOD)


def method_names() -> list[str]:
    """The names of all methods, those of the family of the default method first."""
    return sorted(_modules(), key=lambda name: (not name.startswith(DEFAULT), name))


@cache
def _modules() -> dict[str, ModuleType]:
    package = psfcore.deconvolve.methods
    files = [
        import_module(f"{package.__name__}.{one.name}") for one in pkgutil.iter_modules(package.__path__)
    ]
    return {file.METHOD.name: file for file in files if hasattr(file, "METHOD")}
