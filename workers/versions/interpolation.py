"""The times for which PSFs are interpolated, and the names of interpolated PSFs.

The time of an image is rounded, so that the images of a day share one PSF. The time between two PSFs is divided into equal
steps of at most a day, at least FEWEST_STEPS of them; the time is rounded to the nearest step. Rounding changes the
weights of the two PSFs by at most 1 / (2 FEWEST_STEPS), less than 0.8 %, and makes at most one PSF for each day.
"""

from __future__ import annotations

import math

from workers.versions.series import INTERPOLATED

LONGEST_STEP_S = 86_400.0
FEWEST_STEPS = 64


def name_of(instrument: str | None, identity: str) -> tuple[str, str]:
    """The name and the version of an interpolated PSF with this id."""
    return f"{instrument or 'psf'}-{INTERPOLATED}", f"0.1.0+{identity[:8]}"


def rounded(start: float, end: float, at: float) -> float:
    """The time of the step nearest to ``at``. start < end, start <= at <= end; all in seconds since 1970.

    The result is a whole second, or ``start`` or ``end`` themselves.
    """
    steps = max(FEWEST_STEPS, math.ceil((end - start) / LONGEST_STEP_S))
    step = round((at - start) / (end - start) * steps)
    if step in (0, steps):
        return end if step else start
    return min(max(float(round(start + step * (end - start) / steps)), start), end)
