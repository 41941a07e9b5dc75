"""The library: all effects that a diagnosis tests. A new effect goes into EFFECTS in the file of its stage.

A Python file, or a module, that defines EFFECTS adds effects to the library. This module runs its code. The name of the
file comes from the person or service that runs the diagnosis, never with the data. The code may fail during the import or
when it computes a change. The error then names the file and the line, for the author of the code.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from psfcore.gap.effect import Change, Effect
from psfcore.gap.effect_sources import bad_effects, sha256_of_source
from psfcore.gap.evidence.tree import FAMILIES
from psfcore.gap.library import detector, optics, scene
from psfcore.gap.view import Field, View
from psfcore.user_code import is_file, module_in_file, named_errors

Result = TypeVar("Result")

LIBRARY: tuple[Effect, ...] = (*detector.EFFECTS, *optics.EFFECTS, *scene.EFFECTS)
NAME = "EFFECTS"


@dataclass(frozen=True)
class Added:
    """The effects of one file or module. sha256: hash of the source text that defines them."""

    source: str
    sha256: str
    effects: tuple[Effect, ...]


def added_effects(sources: Sequence[str]) -> tuple[Added, ...]:
    """The effects that files (their paths end in .py) and modules add to the library. Raises DataError
    "bad-effects".
    """
    added = tuple(_added(source) for source in sources)
    names = {effect.name for effect in LIBRARY}
    for source, effect in ((one.source, effect) for one in added for effect in one.effects):
        if effect.name in names:
            raise bad_effects(
                source, f"expected unique effect names; got {effect.name!r:.60} twice: rename this effect"
            )
        names.add(effect.name)
    return added


def library_with(added: Sequence[Added]) -> tuple[Effect, ...]:
    """The library, followed by the added effects."""
    return (*LIBRARY, *(effect for one in added for effect in one.effects))


def _added(source: str) -> Added:
    sha256 = sha256_of_source(source)
    with named_errors(source, bad_effects):
        module = module_in_file(Path(source), "heliopsf_effects_") if is_file(source) else _of_name(source)
    effects = getattr(module, NAME, None)
    if (
        not isinstance(effects, (tuple, list))
        or not effects
        or not all(isinstance(e, Effect) for e in effects)
    ):
        raise bad_effects(source, f"expected {NAME} to be a tuple of Effect; got {_words(effects)}")
    for effect in effects:
        if not effect.name.isidentifier():
            raise bad_effects(
                source, f"expected an effect name of letters, digits and _; got {effect.name!r:.60}"
            )
        if effect.family and effect.family not in FAMILIES:
            raise bad_effects(
                source,
                f"{effect.name}: expected a family of {', '.join(FAMILIES)}; got {effect.family!r:.60}",
            )
        if not effect.parameters:
            raise bad_effects(source, f"{effect.name}: expected at least one parameter; got none")
    return Added(source, sha256, tuple(_checked(e, source) for e in effects))


def _of_name(name: str) -> ModuleType:
    """The module of this name, reloaded. Otherwise a worker that imported the module before would run an old version."""
    before = sys.modules.get(name)
    return importlib.import_module(name) if before is None else importlib.reload(before)


def _words(effects: object) -> str:
    if effects is None:
        return "no variable of this name"
    if isinstance(effects, (tuple, list)):
        kinds = sorted({type(one).__name__ for one in effects})
        return f"a tuple or list of {', '.join(kinds)}" if kinds else "an empty tuple or list"
    return type(effects).__name__


def _checked(effect: Effect, source: str) -> Effect:
    """The effect with checks: it must return one Change for each parameter, and finite images of the right shape.

    An error of its functions names the source.
    """
    hold = effect.held

    def run(function: Callable[[], Result]) -> Result:
        with named_errors(source, bad_effects):
            return function()

    def changes(view: View) -> list[Change]:
        some = run(lambda: list(effect.changes(view)))
        count = len(effect.parameters)
        if len(some) != count or not all(isinstance(change, Change) for change in some):
            kinds = ", ".join(sorted({type(change).__name__ for change in some}))
            raise bad_effects(
                source,
                f"{effect.name}: expected {count} Change, one per parameter; got {len(some)} of type {kinds}",
            )
        shape = view.solution.transit.shape
        return [replace(change, change=partial(image, change, shape)) for change in some]

    def image(change: Change, shape: tuple[int, int], n: int, images: Sequence[Field]) -> Field:
        field: Any = run(lambda: np.asarray(change.change(n, images)))
        if field.shape != shape or not np.isfinite(field).all():
            same = field.shape == shape
            got = "an image with NaN or infinite values" if same else f"an array of shape {field.shape}"
            raise bad_effects(source, f"{effect.name}: expected an image of shape {shape} [y, x]; got {got}")
        return np.asarray(field)

    return replace(
        effect,
        changes=changes,
        why_not=lambda view: run(lambda: effect.why_not(view)),
        held=hold and (lambda view: _checked(run(lambda: hold(view)), source)),
    )
