"""How closely two plate scales must agree to count as the same."""

from __future__ import annotations

PLATE_SCALE_TOLERANCE = (
    0.01  # two plate scales count as the same if their ratio differs from 1 by at most this
)
