"""Every effect of the library, one by one: its declaration, and the changes that it computes."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from psfcore.gap.evidence.unocculted_blocks import spread_blocks, unocculted_blocks
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.view import View
from tests.psfcore.gap.small_gaps import effect, solution, view

TEXT = (Path(__file__).parents[4] / "docs" / "gap.md").read_text("utf-8")
# The list in the documentation: "The axes along which an effect can vary are ...".
AXES = set(re.findall(r"`(\w+)`", TEXT.split("The axes along which")[1].split("\n- ")[0]))


def test_an_effect_declares_itself_and_its_changes_are_finite() -> None:
    assert len({one.name for one in LIBRARY}) == len(LIBRARY)
    for one in LIBRARY:
        name = one.name
        assert name.isidentifier() and one.cause and one.axes and one.settled_by, name
        assert name not in ("none", "unknown")  # hypotheses of the posterior have these names
        assert set(one.axes) <= AXES, name
        assert one.parameters and all(parameter.likely > 0 for parameter in one.parameters), name
        assert len({parameter.name for parameter in one.parameters}) == len(one.parameters), name
    images = view().expected
    for one in LIBRARY:
        name = one.name
        if (why := one.why_not(view())) is not None:
            assert why[0].islower() and not why.endswith("."), name
            continue
        changes = one.changes(view())
        assert 0 < len(changes) <= len(one.parameters), name
        for change in changes:
            fields = [change.change(n, images) for n in (0, len(images) // 2, len(images) - 1)]
            assert all(field.shape == images[0].shape and np.isfinite(field).all() for field in fields), name
        assert any(
            np.any(change.change(n, images)) for change in changes for n in range(0, len(images), 4)
        ), name
    for change in effect("nonlinearity").changes(view()):
        lost = change.change(0, images)
        assert lost.min() < 0 and lost.max() <= 0
        assert abs(lost).max() <= images[0].max()


def test_a_flickering_block_changes_as_measured_if_some_pixels_are_clipped() -> None:
    """The change is the measured flicker; it is 0 in the other blocks and pointings, and in images that do not show the block."""
    plain = solution()
    frames = plain.transit.frames
    here = [n for n, frame in enumerate(frames) if frame.pointing == frames[0].pointing]
    still = unocculted_blocks(View(plain), 0, lambda stage, step, steps: None)
    # Two blocks flicker in opposite directions, so that the brightness of the images stays the same.
    level = np.where(still.free[here].all(axis=0), still.means[here[0]], 0.0)
    signs = np.zeros(level.size)
    signs[np.argsort(level)[-2:]] = 1.0, -1.0
    sign = spread_blocks(signs, plain.transit.shape)
    bright = sign > 0
    height = {n: 300.0 * (-1) ** k for k, n in enumerate(here)}  # DN/s
    clipped = np.zeros_like(bright)
    clipped[np.nonzero(bright)[0][0], np.nonzero(bright)[1][0]] = True
    flickering = tuple(
        replace(
            frame,
            pixels=(frame.pixels + height.get(n, 0.0) * sign).astype(np.float32),
            filled=clipped if n == here[0] else None,
        )
        for n, frame in enumerate(frames)
    )
    seen = View(replace(plain, transit=replace(plain.transit, frames=flickering)))
    flicker = effect("saturation_fill").changes(seen)[2]
    shown = here[1:]
    mean = np.mean([height[n] for n in shown])
    assert len(shown) >= 2 and flicker.numbers >= len(shown) - 1
    for n in shown:
        change = flicker.change(n, seen.expected)
        assert change[bright] == pytest.approx(height[n] - mean, rel=0.1)
        assert np.abs(change[sign == 0]).max() < 0.1 * np.abs(change[bright]).max()
    assert not flicker.change(here[0], seen.expected)[bright].any()
    assert not any(
        flicker.change(n, seen.expected)[bright].any() for n in range(len(frames)) if n not in here
    )
