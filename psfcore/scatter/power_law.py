"""Diffuse scatter as a softened power law, as a sum of several, or as a table.

Hofmeister et al., The point-spread function of HRI_EUV, section "The diffuse scattered light":

    s(r) = a / (b + r)^c  for r > 0,   s(0) = 1 - total,   total = sum over r > 0 on the full reach    Eq. (1)

A sum of laws gives each its share of `total`. A table gives s(r) at some radii, up to a factor. Between them, log s is
linear in log r; s is constant within the first radius and 0 beyond the last.

The amplitude a follows from `total`, which is summed over the grid of 2048 x 2048 px. This grid reaches to 1448 px.

| symbol | name | unit |
|---|---|---|
| a | amplitude | px^c |
| b | b_px | px |
| c | c | - |
| r | radius from pixel centre to pixel centre | px |
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from psfcore.instruments.model import Scatter
from psfcore.psf import REACH_GRID_PX, squared_radii


def amplitude_for_total(b_px: float, c: float, total: float, *, reach_grid_px: int = REACH_GRID_PX) -> float:
    """The amplitude a of Eq. (1) for which the weights at r > 0 sum to `total` on a square of reach_grid_px pixels."""
    shape = _falloff(b_px, c, reach_grid_px)
    centre = reach_grid_px // 2
    return float(total / (shape.sum() - shape[centre, centre]))


def scatter_kernel(b_px: float, c: float, total: float, size: int) -> NDArray[np.float64]:
    """The kernel of Eq. (1) on (size, size). The central pixel [size // 2, size // 2] is 1 - total.

    The kernel sums to 1 for size 2048, and to less on a smaller array.
    """
    kernel = amplitude_for_total(b_px, c, total) * _falloff(b_px, c, size)  # Eq. (1)
    kernel[size // 2, size // 2] = 1 - total
    return kernel


def described_kernel(scatter: Scatter, size: int) -> NDArray[np.float64]:
    """The kernel of the table [scatter] of an instrument file, shape (size, size); the sum is that of
    `scatter_kernel`.
    """
    if scatter.table:
        kernel = _tabulated(scatter.table, size)
        whole, middle = _tabulated(scatter.table, REACH_GRID_PX), REACH_GRID_PX // 2
        kernel *= scatter.total / (whole.sum() - whole[middle, middle])
    else:
        one, *others = (
            scatter_kernel(law.b_px, law.c, law.share * scatter.total, size) for law in scatter.power_laws
        )
        kernel = sum(others, one)
    kernel[size // 2, size // 2] = 1 - scatter.total
    return kernel


def _tabulated(table: Sequence[tuple[float, float]], size: int) -> NDArray[np.float64]:
    """The weights of a table of (radius in px, weight), interpolated on (size, size), without a factor."""
    radii, weights = np.log(np.array(table)).T
    r = np.sqrt(squared_radii((size, size)))
    inside = r <= table[-1][0]
    return np.where(inside, np.exp(np.interp(np.log(np.maximum(r, table[0][0])), radii, weights)), 0.0)


def _falloff(b_px: float, c: float, size: int) -> NDArray[np.float64]:
    return np.asarray((b_px + np.sqrt(squared_radii((size, size)))) ** -c)
