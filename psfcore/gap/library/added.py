"""Effects that somebody adds to the library: a Python file, or a module, that defines EFFECTS.

Its code is run. A name of one comes from who runs the diagnosis, never with the data. What that code does wrong, when it
is read or when it is asked for a change, is said to its author with the line where it happened.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np

from psfcore.errors import DataError
from psfcore.gap.effect import Change, Effect
from psfcore.gap.effect_sources import is_file, sha256_of_source
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.view import Field, View

NAME = "EFFECTS"


@dataclass(frozen=True)
class Added:
    """Effects of one file or module, and the hash of the text that defines them."""

    source: str
    sha256: str
    effects: tuple[Effect, ...]


def added_effects(sources: Sequence[str]) -> tuple[Added, ...]:
    """What some files, whose paths end in .py, or modules add to the library. Raises DataError "bad-effects"."""
    found = tuple(_added(source) for source in sources)
    taken = {effect.name for effect in LIBRARY}
    for one in found:
        for effect in one.effects:
            if effect.name in taken:
                raise _bad(one.source, f"expected names that nothing else has; got {effect.name!r:.60} twice")
            taken.add(effect.name)
    return found


def library_with(added: Sequence[Added]) -> tuple[Effect, ...]:
    """The library, and what was added to it."""
    return (*LIBRARY, *(effect for one in added for effect in one.effects))


def _added(source: str) -> Added:
    sha256 = sha256_of_source(source)
    with _theirs(source):
        module = _of_file(Path(source)) if is_file(source) else _of_name(source)
    found = getattr(module, NAME, None)
    if not isinstance(found, (tuple, list)) or not found or not all(isinstance(e, Effect) for e in found):
        raise _bad(source, f"expected {NAME}, a tuple of Effect; got {_words(found)}")
    for effect in found:
        _check(effect, source)
    return Added(source, sha256, tuple(_guarded(e, source) for e in found))


def _of_name(name: str) -> ModuleType:
    """The module of a name, read anew: a worker that imported it before would run what it was then."""
    before = sys.modules.get(name)
    return importlib.import_module(name) if before is None else importlib.reload(before)


def _of_file(path: Path) -> ModuleType:
    """The module that a file is, read anew; under a name of its own, so that no other's is taken."""
    name = "heliopsf_effects_" + hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module


def _check(effect: Effect, source: str) -> None:
    if not effect.name.isidentifier():
        raise _bad(source, f"expected a name of letters, digits and _; got {effect.name!r:.60}")
    if not effect.parameters:
        raise _bad(source, f"expected a parameter of {effect.name}; got none")


# --- code of somebody else --------------------------------------------------------------------------------


@contextmanager
def _theirs(source: str) -> Iterator[None]:
    """Whatever the code of a source raises, as one DataError with the line that did it."""
    try:
        yield
    except DataError:
        raise
    # Not ours: of what kind its errors are nobody knows, and a traceback would tell of this software.
    except Exception as error:
        raise _bad(source, f"{type(error).__name__}: {error}{_line(error, source)}") from error


def _line(error: Exception, source: str) -> str:
    """Where in the source's file an error arose, in words; nothing where that is not known."""
    if isinstance(error, SyntaxError):
        return ""  # says so itself
    name = Path(source).name if is_file(source) else f"{source.rpartition('.')[2]}.py"
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).name == name]
    return f" (line {lines[-1]})" if lines else ""


def _guarded(effect: Effect, source: str) -> Effect:
    """The effect, what it answers being checked: a change for each parameter, finite and as large as an image."""

    def changes(view: View) -> list[Change]:
        with _theirs(source):
            made = list(effect.changes(view))
        wanted = len(effect.parameters)
        if len(made) != wanted or not all(isinstance(change, Change) for change in made):
            kinds = ", ".join(sorted({type(change).__name__ for change in made}))
            raise _bad(
                source,
                f"{effect.name}: expected {wanted} of Change, one a parameter; got {len(made)} of {kinds}",
            )
        shape = view.solution.transit.shape
        return [
            replace(change, change=_checked(change.change, shape, effect.name, source)) for change in made
        ]

    def why_not(view: View) -> str | None:
        with _theirs(source):
            return effect.why_not(view)

    return replace(effect, changes=changes, why_not=why_not, held=_held(effect, source))


def _held(effect: Effect, source: str) -> Callable[[View], Effect] | None:
    if effect.held is None:
        return None
    hold = effect.held

    def held(view: View) -> Effect:
        with _theirs(source):
            return _guarded(hold(view), source)

    return held


def _checked(
    change: Callable[[int, Sequence[Field]], Field], shape: tuple[int, int], name: str, source: str
) -> Callable[[int, Sequence[Field]], Field]:
    def checked(n: int, images: Sequence[Field]) -> Field:
        with _theirs(source):
            field = np.asarray(change(n, images))
        if field.shape != shape or not np.isfinite(field).all():
            got = "one with NaN or infinite values" if field.shape == shape else f"one of {field.shape}"
            raise _bad(source, f"{name}: expected an image of {shape} [y, x]; got {got}")
        return field

    return checked


def _bad(source: str, what: str) -> DataError:
    return DataError("bad-effects", f"effects of {source}: {what}")


def _words(found: object) -> str:
    if found is None:
        return "nothing of that name"
    if isinstance(found, (tuple, list)):
        kinds = sorted({type(one).__name__ for one in found})
        return f"one of {', '.join(kinds)}" if kinds else "an empty one"
    return type(found).__name__
