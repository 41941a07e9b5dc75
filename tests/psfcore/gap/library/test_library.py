"""Every effect of the library, one by one: its declaration, and the changes that it computes."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from psfcore.gap.effect import Effect
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.view import View
from tests.psfcore.gap.small_transits import solution

TEXT = (Path(__file__).parents[4] / "docs" / "gap.md").read_text("utf-8")
# The list in the documentation: "The axes along which an effect can vary are ...".
AXES = set(re.findall(r"`(\w+)`", TEXT.split("The axes along which")[1].split("\n- ")[0]))


@cache
def view() -> View:
    return View(solution())


def test_names_are_unique() -> None:
    assert len({effect.name for effect in LIBRARY}) == len(LIBRARY)


@pytest.mark.parametrize("effect", LIBRARY, ids=lambda effect: effect.name)
def test_an_effect_declares_what_the_report_needs(effect: Effect) -> None:
    assert effect.name.isidentifier() and effect.cause and effect.axes and effect.settled_by
    assert effect.name not in ("none", "unknown")  # hypotheses of the posterior have these names
    assert set(effect.axes) <= AXES
    assert effect.parameters and all(parameter.likely > 0 for parameter in effect.parameters)
    assert len({parameter.name for parameter in effect.parameters}) == len(effect.parameters)


@pytest.mark.parametrize("effect", LIBRARY, ids=lambda effect: effect.name)
def test_its_changes_are_finite_images_that_are_not_all_zero(effect: Effect) -> None:
    if (why := effect.why_not(view())) is not None:
        assert why[0].islower() and not why.endswith(".")
        return
    changes = effect.changes(view())
    assert changes
    images = view().expected
    for change in changes:
        fields = [change.change(n, images) for n in (0, len(images) // 2, len(images) - 1)]
        assert all(field.shape == images[0].shape and np.isfinite(field).all() for field in fields)
    assert any(np.any(change.change(n, images)) for change in changes for n in range(0, len(images), 4))
