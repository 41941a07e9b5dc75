"""Folds of a cross-validation: sequential blocks of held-out images, with a guard on both sides.

Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness": 126 images are divided into
ten sequential blocks. Three images on each side of a block are not used. Here N images give min(10, N // 3) blocks
and a guard of round(3 N / 126) images on each side; if N >= 12, the guard has at least one image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MOST_BLOCKS = 10
IMAGES_A_BLOCK = 3
GUARD_SHARE = 3 / 126
GUARD_FROM = 12


@dataclass(frozen=True)
class Fold:
    """The held-out images of a block, and the images to fit: all other images except the guard. Indices in time order."""

    held_out: tuple[int, ...]
    fitted: tuple[int, ...]


def folds(images: int) -> tuple[Fold, ...]:
    """One fold per block; empty if there are fewer than six images (two blocks)."""
    count = min(MOST_BLOCKS, images // IMAGES_A_BLOCK)
    if count < 2:
        return ()
    guard = max(round(GUARD_SHARE * images), 1 if images >= GUARD_FROM else 0)
    out = []
    for block in np.array_split(np.arange(images), count):
        first, last = int(block[0]), int(block[-1])
        fitted = [k for k in range(images) if k < first - guard or k > last + guard]
        out.append(Fold(tuple(int(k) for k in block), tuple(fitted)))
    return tuple(out)
