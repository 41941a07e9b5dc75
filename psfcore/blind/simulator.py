"""Cases from a simulator of the user: a Python file, or a module, that defines the function `make_case`.

    make_case(*, seed, number, size_px, images, transit, expected) -> truth

seed: the seed of the set. number: the number of the case. Equal seeds and numbers must give equal cases. size_px: the
width of the square images. images: the number of images. transit: an empty folder, into which the function writes the
transit (`docs/transits.md`) and nothing else, because the diagnosis sees it. expected: a folder that does not exist.
For the ideal observer, the function may write two further transits into the folders `with_effects` and
`without_effects` of `expected`. Their images contain no noise, but their `transit.json` contains the same noise figures
as the transit with noise. truth is

    {"effects": [{"name": "ghost", "strength": 0.02, "left_alone_pct": 3.1}, ...], "left_after_refit_pct": 3.1}

effects: at most two; none in a clean case. Effects of the gap library have the names of the library; an effect with another name
is not in the library. All other keys are optional. left_alone_pct: the residual that this effect alone leaves in the
discs after a refit, percent, rms over images. left_after_refit_pct: the residual that all effects together leave; if it
is missing, the score uses the value of the ideal observer. Further keys are kept. The truth gets a "kind" and is sealed
like the truth of a drawn case.

The code of the simulator is executed. Only the person who runs the command can name this code. If the code raises an
error, the error becomes a DataError that names the line of the code.
"""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from psfcore.blind.cases import CLEAN, FOREIGN, MIXED, PAIR, SINGLE, SetPlan
from psfcore.blind.effects.registry import KNOWN
from psfcore.blind.make_case import WITH_EFFECTS, WITHOUT_EFFECTS
from psfcore.errors import DataError
from psfcore.transit.manifest import MANIFEST_NAME, read_manifest
from psfcore.user_code import is_file, module_in_file, named_errors, sha256_of_source

FUNCTION = "make_case"
MOST_EFFECTS = 2
_NO_NAMES = {CLEAN, PAIR, MIXED, FOREIGN, "none"}  # no effect may have these names: the score uses them
_RESIDUALS = ("left_before_refit_pct", "left_after_refit_pct")


def source_sha256(source: str) -> str:
    """SHA-256 (hex) of the source text of a simulator. Raises DataError "bad-simulator".

    The hash does not cover other files that the text imports.
    """
    return sha256_of_source(source, _bad)


def simulator_of(source: str) -> Callable[..., Any]:
    """The function `make_case` of a file (path ending in .py) or module. Raises DataError "bad-simulator"."""
    source_sha256(source)
    with named_errors(source, _bad):
        module = (
            module_in_file(Path(source), "heliopsf_simulator_")
            if is_file(source)
            else importlib.import_module(source)
        )
    found = getattr(module, FUNCTION, None)
    if not callable(found):
        raise _bad(source, f"expected a function {FUNCTION}; got {type(found).__name__}")
    return found


def simulate_case(plan: SetPlan, number: int, transit: Path, expected: Path) -> dict[str, Any]:
    """Let the simulator of a plan write a case. Returns the truth of the case. The module docstring explains the arguments.

    Raises DataError "bad-simulator", and the errors of `psfcore.transit.manifest.read_manifest`.
    """
    source, seed = plan.simulator, plan.seed
    function = simulator_of(source)
    transit.mkdir(parents=True)
    arguments = {"seed": seed, "number": number, "size_px": plan.size_px, "images": plan.images}
    with named_errors(source, _bad):
        truth = function(**arguments, transit=transit, expected=expected)
    _check_transit(source, transit)
    if expected.exists():
        names = sorted(path.name for path in expected.iterdir())
        if names != [WITH_EFFECTS, WITHOUT_EFFECTS]:
            raise _bad(
                source,
                f"expected the folders {WITH_EFFECTS} and {WITHOUT_EFFECTS} in `expected`; got {', '.join(names) or 'nothing'}",
            )
    return checked_truth(source, truth) | {"number": number, "seed": seed}


def _check_transit(source: str, folder: Path) -> None:
    wanted = {MANIFEST_NAME, *read_manifest(folder).files}
    found = {path.name for path in folder.iterdir()}
    if missing := sorted(wanted - found):
        raise _bad(source, f"expected all files that {MANIFEST_NAME} names; missing: {missing[0]}")
    if more := sorted(found - wanted):
        raise _bad(
            source,
            f"expected only {MANIFEST_NAME} and the files that it names in `transit`, because the diagnosis sees this folder; "
            f"got also {more[0]}",
        )


def checked_truth(source: str, truth: Any) -> dict[str, Any]:
    """A truth that a simulator returned, with its kind. Raises DataError "bad-simulator"."""
    try:
        copied = json.loads(json.dumps(truth, allow_nan=False))
        names = [effect["name"] for effect in copied["effects"]]
    except (TypeError, ValueError, KeyError) as error:
        raise _bad(
            source, f'expected a truth as JSON with "effects", a list of objects with a "name"; got {error}'
        ) from error
    if not all(isinstance(name, str) and name for name in names) or len(set(names)) < len(names):
        raise _bad(source, f"expected effects with different names; got {names!r:.100}")
    if taken := sorted(_NO_NAMES & set(names)):
        raise _bad(
            source,
            f"expected names of effects; got {taken[0]!r}, which has another meaning in the score: choose another name",
        )
    if len(names) > MOST_EFFECTS:
        raise _bad(source, f"expected at most {MOST_EFFECTS} effects; got {len(names)}")
    numbers = [copied.get(key) for key in _RESIDUALS]
    alone = ("left_alone_pct", "left_alone_chi2")
    numbers += [effect.get(key, 0.0) for effect in copied["effects"] for key in alone]
    if not all(number is None or _is_share(number) for number in numbers):
        raise _bad(source, f"expected residuals in percent and chi2, at least 0; got {numbers!r:.100}")
    kind = _kind_of(names)
    nothing_left = {"left_before_refit_pct": 0.0, "left_after_refit_pct": 0.0} if kind == CLEAN else {}
    return {**nothing_left, **copied, "kind": kind}


def _is_share(number: object) -> bool:
    whole = isinstance(number, (int, float)) and not isinstance(number, bool)
    return whole and math.isfinite(number) and number >= 0  # type: ignore[arg-type, operator]


def _kind_of(names: list[str]) -> str:
    withheld = len(set(names) - set(KNOWN))
    if withheld:
        return FOREIGN if withheld == len(names) else MIXED
    return (CLEAN, SINGLE, PAIR)[len(names)]


def _bad(source: str, what: str) -> DataError:
    return DataError("bad-simulator", f"simulator {source}: {what}")
