"""Effects that are added to the library by a Python file, or a module, that defines EFFECTS.

This module runs the code of that file. The name of the file comes from the person or service that runs the diagnosis,
never with the data. The code may fail during the import or when it computes a change. The error then names the file and
the line, for the author of the code.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np

from psfcore.extensions.user_code import is_file, module_in_file, named_errors
from psfcore.gap.effect import Change, Effect
from psfcore.gap.effect_sources import bad_effects, sha256_of_source
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.view import Field, View

NAME = "EFFECTS"


@dataclass(frozen=True)
class Added:
    """The effects of one file or module. sha256: hash of the source text that defines them."""

    source: str
    sha256: str
    effects: tuple[Effect, ...]


def added_effects(sources: Sequence[str]) -> tuple[Added, ...]:
    """The effects that files (their paths end in .py) and modules add to the library. Raises DataError
    "bad-effects"."""
    found = tuple(_added(source) for source in sources)
    taken = {effect.name for effect in LIBRARY}
    for one in found:
        for effect in one.effects:
            if effect.name in taken:
                raise bad_effects(
                    one.source,
                    f"expected unique effect names; got {effect.name!r:.60} twice: rename this effect",
                )
            taken.add(effect.name)
    return found


def library_with(added: Sequence[Added]) -> tuple[Effect, ...]:
    """The library, followed by the added effects."""
    return (*LIBRARY, *(effect for one in added for effect in one.effects))


def _added(source: str) -> Added:
    sha256 = sha256_of_source(source)
    with named_errors(source, bad_effects):
        module = module_in_file(Path(source), "heliopsf_effects_") if is_file(source) else _of_name(source)
    found = getattr(module, NAME, None)
    if not isinstance(found, (tuple, list)) or not found or not all(isinstance(e, Effect) for e in found):
        raise bad_effects(source, f"expected {NAME} to be a tuple of Effect; got {_words(found)}")
    for effect in found:
        _check(effect, source)
    return Added(source, sha256, tuple(_guarded(e, source) for e in found))


def _of_name(name: str) -> ModuleType:
    """The module of this name, reloaded. Otherwise a worker that imported the module before would run an old version."""
    before = sys.modules.get(name)
    return importlib.import_module(name) if before is None else importlib.reload(before)


def _check(effect: Effect, source: str) -> None:
    if not effect.name.isidentifier():
        raise bad_effects(
            source, f"expected an effect name of letters, digits and _; got {effect.name!r:.60}"
        )
    if not effect.parameters:
        raise bad_effects(source, f"{effect.name}: expected at least one parameter; got none")


# --- errors of added code ----------------------------------------------------------------------------------


def _guarded(effect: Effect, source: str) -> Effect:
    """The effect with checks: it must return one Change for each parameter, and finite images of the right shape."""

    def changes(view: View) -> list[Change]:
        with named_errors(source, bad_effects):
            made = list(effect.changes(view))
        wanted = len(effect.parameters)
        if len(made) != wanted or not all(isinstance(change, Change) for change in made):
            kinds = ", ".join(sorted({type(change).__name__ for change in made}))
            raise bad_effects(
                source,
                f"{effect.name}: expected {wanted} Change, one per parameter; got {len(made)} of type {kinds}",
            )
        shape = view.solution.transit.shape
        return [
            replace(change, change=_checked(change.change, shape, effect.name, source)) for change in made
        ]

    def why_not(view: View) -> str | None:
        with named_errors(source, bad_effects):
            return effect.why_not(view)

    return replace(effect, changes=changes, why_not=why_not, held=_held(effect, source))


def _held(effect: Effect, source: str) -> Callable[[View], Effect] | None:
    if effect.held is None:
        return None
    hold = effect.held

    def held(view: View) -> Effect:
        with named_errors(source, bad_effects):
            return _guarded(hold(view), source)

    return held


def _checked(
    change: Callable[[int, Sequence[Field]], Field], shape: tuple[int, int], name: str, source: str
) -> Callable[[int, Sequence[Field]], Field]:
    def checked(n: int, images: Sequence[Field]) -> Field:
        with named_errors(source, bad_effects):
            field = np.asarray(change(n, images))
        if field.shape != shape or not np.isfinite(field).all():
            got = (
                "an image with NaN or infinite values"
                if field.shape == shape
                else f"an array of shape {field.shape}"
            )
            raise bad_effects(source, f"{name}: expected an image of shape {shape} [y, x]; got {got}")
        return field

    return checked


def _words(found: object) -> str:
    if found is None:
        return "no variable of this name"
    if isinstance(found, (tuple, list)):
        kinds = sorted({type(one).__name__ for one in found})
        return f"a tuple or list of {', '.join(kinds)}" if kinds else "an empty tuple or list"
    return type(found).__name__
