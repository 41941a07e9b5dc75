"""Held-out blocks and their guard agree with the definitions."""

from __future__ import annotations

from psfcore.transit.transit import folds


def test_blocks_and_guard() -> None:
    for images, blocks, guard in (
        (126, 10, 3), (84, 10, 2), (30, 10, 1), (12, 4, 1), (11, 3, 0), (6, 2, 0), (250, 10, 6)
    ):  # fmt: skip
        found = folds(images)
        assert len(found) == blocks
        assert [k for fold in found for k in fold.held_out] == list(range(images))  # each once, in order
        sizes = [len(fold.held_out) for fold in found]
        assert max(sizes) - min(sizes) <= 1 and min(sizes) >= 3
        for fold in found:
            first, last = fold.held_out[0], fold.held_out[-1]
            around = range(max(0, first - guard), min(images, last + guard + 1))
            assert fold.held_out == tuple(range(first, last + 1))
            assert fold.fitted == tuple(k for k in range(images) if k not in around)
    assert [folds(images) for images in range(6)] == [()] * 6, "too few images for two blocks"
