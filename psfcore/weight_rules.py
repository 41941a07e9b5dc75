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


def check_finite(total: float) -> None:
    """Raise DataError "psf-nonfinite" if a sum of weights is not finite."""
    if not math.isfinite(total):
        raise DataError("psf-nonfinite", "expected finite weights; got weights that are NaN or infinite")


def is_peak(centre: float, largest: float) -> bool:
    """Whether the central pixel has the largest weight, up to CENTRE_TOLERANCE. Other PSFs would shift every image."""
    return centre >= largest * (1 - CENTRE_TOLERANCE)
