"""Every effect of the library, one by one: its declaration, and the changes that it computes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from psfcore.gap.evidence.tree import SUN
from psfcore.gap.library.registry import LIBRARY
from tests.psfcore.gap.small_gaps import effect, view

TEXT = (Path(__file__).parents[4] / "docs" / "gap.md").read_text("utf-8")
# The list in the documentation: "The axes along which an effect can vary are ...".
AXES = set(re.findall(r"`(\w+)`", TEXT.split("The axes along which")[1].split("\n- ")[0]))


def test_an_effect_declares_itself_and_its_changes_are_finite() -> None:
    assert len({one.name for one in LIBRARY}) == len(LIBRARY)
    for one in LIBRARY:
        name = one.name
        assert name.isidentifier() and one.cause and one.axes and one.settled_by, name
        assert name not in ("none", "unknown")  # reports use these words
        assert set(one.axes) <= AXES, name
        assert bool(one.parameters) is (name != SUN), name  # the Sun is a random field without a template
        assert all(parameter.likely > 0 for parameter in one.parameters), name
        assert len({parameter.name for parameter in one.parameters}) == len(one.parameters), name
    images = view().expected
    for one in LIBRARY:
        name = one.name
        if (why := one.why_not(view())) is not None:
            assert why[0].islower() and not why.endswith("."), name
            continue
        changes = one.changes(view())
        assert bool(changes) is (name != SUN) and len(changes) <= len(one.parameters), name
        for change in changes:
            fields = [change.change(n, images) for n in (0, len(images) // 2, len(images) - 1)]
            assert all(field.shape == images[0].shape and np.isfinite(field).all() for field in fields), name
        some = [change.change(n, images) for change in changes for n in range(0, len(images), 4)]
        assert any(map(np.any, some)) or name == SUN, name
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
