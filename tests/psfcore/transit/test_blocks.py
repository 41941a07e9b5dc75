"""Held-out blocks and their guard agree with the definitions."""

from __future__ import annotations

import pytest

from psfcore.transit.blocks import folds


@pytest.mark.parametrize(
    "images, blocks, guard",
    [(126, 10, 3), (84, 10, 2), (30, 10, 1), (12, 4, 1), (11, 3, 0), (6, 2, 0), (250, 10, 6)],
)
def test_blocks_and_guard(images: int, blocks: int, guard: int) -> None:
    found = folds(images)
    assert len(found) == blocks
    assert [k for fold in found for k in fold.held_out] == list(range(images))  # each once, in order
    sizes = [len(fold.held_out) for fold in found]
    assert max(sizes) - min(sizes) <= 1 and min(sizes) >= 3
    for fold in found:
        first, last = fold.held_out[0], fold.held_out[-1]
        assert fold.held_out == tuple(range(first, last + 1))
        around = range(max(0, first - guard), min(images, last + guard + 1))
        assert fold.fitted == tuple(k for k in range(images) if k not in around)


@pytest.mark.parametrize("images", range(6))
def test_too_few_images_for_two_blocks_give_no_fold(images: int) -> None:
    assert folds(images) == ()
