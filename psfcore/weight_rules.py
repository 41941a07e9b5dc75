"""The conditions that the weights of a PSF must fulfil. This module imports no numerical library.

"Sum" means the sum over the central 2048 x 2048 px (the reach), or over the whole array if it is smaller.
"""

from __future__ import annotations

import math

from psfcore.errors import DataError

REACH_GRID_PX = 2048
LARGEST_SUM = 1 + 1e-3
SMALLEST_SUM = 0.05
CENTRE_TOLERANCE = (
    1e-3  # the central weight may be below the largest weight by this fraction, because of rounding
)


def check_weights(smallest: float, largest: float, total: float) -> None:
    """Raise DataError "psf-negative" if a weight is negative, and "psf-sum" if the sum is outside the allowed range."""
    if smallest < -1e-12 * max(largest, 0.0):
        raise DataError("psf-negative", f"expected weights >= 0; the smallest is {smallest:.3g}")
    if not SMALLEST_SUM < total <= LARGEST_SUM:
        wanted = f"weights that sum to 1 over the full reach, or to less if cropped ({SMALLEST_SUM} to {LARGEST_SUM})"
        raise DataError(
            "psf-sum", f"expected {wanted}; got {total:.6g}. Divide the weights by their sum first"
        )


LARGEST_OFFSET_PX = 0.05  # a PSF moves every image by the offset of its core


def core_offset_px(before: float, centre: float, after: float) -> float:
    """The offset of the core from the central pixel along one axis, px, from the sums of three lines of 3 weights.

    A Gaussian through the three sums has its peak at this offset; a core without light beside the central pixel has the
    offset of its centroid.
    """
    if min(before, after) <= 0 or centre <= 0:
        total = before + centre + after
        return (after - before) / total if total > 0 else 0.0
    curvature = 2 * math.log(centre) - math.log(before) - math.log(after)
    slope = math.log(after) - math.log(before)
    return (
        0.0
        if slope == 0
        else 0.5 * slope / curvature
        if curvature > abs(slope)
        else math.copysign(0.5, slope)
    )


def check_core(offset_x_px: float, offset_y_px: float) -> None:
    """Raise DataError "psf-off-centre" if the core of a PSF is beside the central pixel."""
    if max(abs(offset_x_px), abs(offset_y_px)) > LARGEST_OFFSET_PX:
        raise DataError(
            "psf-off-centre",
            f"expected the core of the PSF at the centre of the pixel [ny // 2, nx // 2], within {LARGEST_OFFSET_PX:g} px; got "
            f"it at x {offset_x_px:+.2f}, y {offset_y_px:+.2f} px from there, which would move every image by as much: "
            "shift the PSF by whole and part pixels, for example with scipy.ndimage.shift",
        )


def is_peak(centre: float, largest: float) -> bool:
    """Whether the central pixel has the largest weight, up to CENTRE_TOLERANCE. Other PSFs would shift every image."""
    return centre >= largest * (1 - CENTRE_TOLERANCE)
