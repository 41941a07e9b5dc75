"""Every effect of the library, one by one: its declaration, and the changes that it computes."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from psfcore.gap.effect import Effect
from psfcore.gap.evidence.unocculted_blocks import not_compared
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


def test_pixels_that_one_image_clips_flicker_in_the_images_that_show_them() -> None:
    """The change is the measured flicker; it is 0 in all other pixels, and in the image that is clipped."""
    plain = solution()
    frames = plain.transit.frames
    here = [n for n, frame in enumerate(frames) if frame.pointing == frames[0].pointing]
    far = ~np.any([not_compared(plain, n) for n in here], axis=0)
    rows, columns = np.nonzero(far)
    bright = np.zeros_like(far)
    bright[rows[:400], columns[:400]] = True
    height = {n: 300.0 * (-1) ** k for k, n in enumerate(here)}  # DN/s
    flickering = tuple(
        replace(
            frame,
            pixels=(frame.pixels + height.get(n, 0.0) * bright).astype(np.float32),
            filled=bright if n == here[0] else None,
        )
        for n, frame in enumerate(frames)
    )
    view = View(replace(plain, transit=replace(plain.transit, frames=flickering)))
    effect = next(effect for effect in LIBRARY if effect.name == "saturation_fill")
    flicker = effect.changes(view)[2]
    shown = here[1:]
    mean = np.mean([height[n] for n in shown])
    assert len(shown) >= 2 and flicker.numbers > 0
    for n in shown:
        change = flicker.change(n, view.expected)
        assert not change[~bright].any()
        # The noise of the mean of 400 pixels is a few DN/s.
        assert change[bright].mean() == pytest.approx(height[n] - mean, abs=30.0)
    assert not flicker.change(here[0], view.expected).any()
    assert not any(flicker.change(n, view.expected).any() for n in range(len(frames)) if n not in here)
