"""Which images are held out together: sequential blocks, and a guard on both sides.

Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness": ten sequential blocks of
126 images, three images on each side left out. On N images: min(10, N // 3) blocks and round(3 N / 126) images of
guard, at least one from 12 images on.
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
    """Images held out, and those that may be fitted: all others but the guard. Indices in the order of time."""

    held_out: tuple[int, ...]
    fitted: tuple[int, ...]


def folds(images: int) -> tuple[Fold, ...]:
    """One fold a block; none where there are fewer than six images (two blocks)."""
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
