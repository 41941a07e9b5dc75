"""How closely two plate scales must agree to count as the same."""

from __future__ import annotations

PLATE_SCALE_TOLERANCE = 0.01  # largest deviation from 1 of the ratio of two plate scales
