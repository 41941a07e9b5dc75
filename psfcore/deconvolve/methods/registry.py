"""Find methods by name: the file `richardson_lucy.py` holds the method "richardson-lucy"."""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Callable
from importlib import import_module
from typing import Any

import psfcore.deconvolve.methods
from psfcore.deconvolve.conditions import Deconvolved
from psfcore.deconvolve.edges import Edges
from psfcore.errors import DataError

Method = Callable[..., Deconvolved]


def method_named(name: str) -> Method:
    """The function `deconvolve(image, psf, conditions, **parameters)` of a method.

    Raises DataError "unknown-method", whose message lists the known methods.
    """
    file = name.replace("-", "_")
    if not re.fullmatch(r"[a-z_]+", file) or file not in _files() or _name_of(file) != name:
        raise DataError(
            "unknown-method", f"expected one of the methods {', '.join(method_names())}; got {name!r}"
        )
    method: Method = _module(file).deconvolve
    return method


def method_names() -> list[str]:
    """Names of all methods: the constants METHOD of the files in this package."""
    return sorted(name for name in map(_name_of, _files()) if name is not None)


def may_be_negative(name: str) -> bool:
    """Whether results of a method may be negative: its module then has the constant MAY_BE_NEGATIVE = True."""
    return getattr(_module(name.replace("-", "_")), "MAY_BE_NEGATIVE", False)


def keeps_flux(name: str) -> bool:
    """Whether the steps of a method conserve the flux of the plane, and so compensate for light that leaves it: its
    module then has the constant KEEPS_FLUX = True."""
    return getattr(_module(name.replace("-", "_")), "KEEPS_FLUX", False)


def defaults_of(name: str) -> tuple[Edges, float]:
    """The constants EDGES and MARGIN_SHARE of a method. Raises DataError "unknown-method"."""
    method_named(name)
    module = _module(name.replace("-", "_"))
    return module.EDGES, module.MARGIN_SHARE


def _files() -> list[str]:
    return [module.name for module in pkgutil.iter_modules(psfcore.deconvolve.methods.__path__)]


def _name_of(file: str) -> str | None:
    return getattr(_module(file), "METHOD", None)


def _module(file: str) -> Any:
    return import_module(f"psfcore.deconvolve.methods.{file}")
