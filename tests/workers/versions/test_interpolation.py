"""Times are rounded to steps of at most a day, and never beyond the two PSFs."""

from __future__ import annotations

import numpy as np

from workers.versions.interpolation import FEWEST_STEPS, LONGEST_STEP_S, rounded
from workers.versions.validity import seconds

DAY = 86_400.0


def test_the_nearest_of_enough_steps() -> None:
    start = seconds("2022-03-01T06:30:00.25")
    for days in (0.01, 0.5, 7.0, 63.9, 64.0, 365.25, 3000.0):
        end = start + days * DAY
        times = np.linspace(start, end, 4001)
        found = np.array([rounded(start, end, float(at)) for at in times])
        step = min(LONGEST_STEP_S, days * DAY / FEWEST_STEPS)
        assert np.abs(found - times).max() <= 0.5 * step + 0.5 + 1e-6, "nearest step, to a whole second"
        assert found.min() >= start and found.max() <= end and (np.diff(found) >= 0).all(), days
        assert len(set(found)) <= max(FEWEST_STEPS, np.ceil(days)) + 1, days
        assert rounded(start, end, start) == start and rounded(start, end, end) == end


def test_the_images_of_a_day_share_a_time() -> None:
    start, end = seconds("2022-03-01"), seconds("2023-03-01")
    noon, evening = seconds("2022-06-01T11:00:00"), seconds("2022-05-31T13:00:00")
    assert rounded(start, end, noon) == rounded(start, end, evening) == seconds("2022-06-01")
