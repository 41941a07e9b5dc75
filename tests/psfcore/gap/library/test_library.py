"""Every effect of the library, one by one: its declaration, and the changes that it computes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from psfcore.gap.effect import Change, Effect
from psfcore.gap.evidence.tree import SUN
from psfcore.gap.library.registry import LIBRARY
from tests.psfcore.gap.small_gaps import effect, view

TEXT = (Path(__file__).parents[4] / "docs" / "gap.md").read_text("utf-8")
# The list in the documentation: "The axes along which an effect can vary are ...".
AXES = set(re.findall(r"`(\w+)`", TEXT.split("The axes along which")[1].split("\n- ")[0]))


def faults(one: Effect) -> list[str]:
    """A sentence for each thing that the declaration or the changes of an effect lack."""
    sun = one.name == SUN  # a random field without a template
    names = [parameter.name for parameter in one.parameters]
    lacks = {
        "its name is no identifier": one.name.isidentifier(),
        "reports use its name for something else": one.name not in ("none", "unknown"),
        "it has no cause": bool(one.cause),
        "it has no axes": bool(one.axes),
        f"docs/gap.md does not list its axes {sorted({*one.axes} - AXES)}": set(one.axes) <= AXES,
        "it does not say what would settle it (settled_by)": bool(one.settled_by),
        "it has no parameters": bool(names) or sun,
        "two parameters have the same name": len(set(names)) == len(names),
        "a likely size is not above 0": all(parameter.likely > 0 for parameter in one.parameters),
    }
    told = [f"{one.name}: {fault}" for fault, good in lacks.items() if not good]
    if (why := one.why_not(view())) is not None:
        plain = why[0].islower() and not why.endswith(".")
        return told if plain else [*told, f"{one.name}: its reason is no part of a sentence: {why!r}"]
    images, changes = view().expected, one.changes(view())
    if len(changes) > len(one.parameters) or (not changes and not sun):
        told.append(f"{one.name}: it has {len(changes)} changes for {len(one.parameters)} parameters")
    planes = [
        change.change(n, images)
        for change in changes
        for n in {0, *range(0, len(images), 4), len(images) - 1}
    ]
    if any(plane.shape != images[0].shape for plane in planes):
        told.append(f"{one.name}: a change has not the shape of the images, {images[0].shape}")
    if not all(np.isfinite(plane).all() for plane in planes):
        told.append(f"{one.name}: a change is not finite")
    if not any(map(np.any, planes)) and not sun:
        told.append(f"{one.name}: its changes are 0")
    return told


def test_an_effect_has_all_that_it_needs(subtests: pytest.Subtests) -> None:
    assert len({one.name for one in LIBRARY}) == len(LIBRARY)
    for one in LIBRARY:
        with subtests.test(one.name):
            assert faults(one) == []


def test_all_that_an_effect_lacks_is_told_at_once() -> None:
    wrong = Effect(
        "no name", "detector", (), "", "", ("nowhere",), lambda of: [Change(lambda n, images: images[0][1:])]
    )
    told = " ".join(faults(wrong))
    assert all(
        word in told for word in ("identifier", "cause", "nowhere", "settled_by", "parameters", "shape")
    )


def test_a_nonlinear_detector_loses_at_most_the_light() -> None:
    images = view().expected
    for change in effect("nonlinearity").changes(view()):
        lost = change.change(0, images)
        assert lost.min() < 0 and lost.max() <= 0
        assert abs(lost).max() <= images[0].max()


def test_a_ghost_moves_grows_and_turns() -> None:
    """The changes beside the copy are minus its slopes along the displacements."""
    copy, *moves = (
        change.change(3, view().expected).astype(np.float64) for change in effect("ghost").changes(view())
    )
    along_x, along_y = ((np.roll(copy, 1, axis) - np.roll(copy, -1, axis)) / 2 for axis in (1, 0))
    x, y = (place.astype(np.float64) for place in view().places)
    expected = (along_x, along_y, x * along_x + y * along_y, x * along_y - y * along_x)
    for moved, right in zip(moves, expected, strict=True):
        inside = (slice(2, -2), slice(2, -2))
        np.testing.assert_allclose(moved[inside], right[inside], atol=1e-5 * copy.max())
