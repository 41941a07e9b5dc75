"""Numbers as text for reports. This module needs no package for drawing."""

from __future__ import annotations

import math

DASH = "\N{EN DASH}"


def with_error(value: float | None, sigma: float | None = None) -> str:
    """A number rounded to the second digit of its error, "12.34 ± 0.56". Without an error it is rounded to five digits.

    None and numbers that are not finite give a dash.
    """
    if value is None or not math.isfinite(value):
        return DASH
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return f"{value:.5g}"
    if abs(value) >= 1e6 or max(abs(value), sigma) < 1e-3:
        return f"{value:.3e} ± {sigma:.1e}"
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    rounded = round(value, digits) + 0.0  # + 0.0 turns -0.0 into 0.0
    return f"{rounded:.{digits}f} ± {sigma:.{digits}f}"
