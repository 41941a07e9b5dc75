"""A row of the table of a blind set, and its interval.

The interval of a fraction p of n cases is the Wilson interval:

    (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)                             Eq. (1)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from psfcore.blind.scoring import Judged

Z95 = 1.959963984540054


@dataclass(frozen=True)
class Row:
    """A row of the table.

    interval95: Eq. (1), if the value is a fraction of cases; otherwise None. met: whether the value reaches the goal; None if
    there is no goal or no case.
    """

    figure: str
    cases: int
    value: float | None
    interval95: tuple[float, float] | None
    goal: str
    met: bool | None

    def to_json(self) -> dict[str, Any]:
        """The row as JSON."""
        return {
            "figure": self.figure,
            "n": self.cases,
            "value": self.value,
            "wilson95": None if self.interval95 is None else list(self.interval95),
            "goal": self.goal,
            "met": self.met,
        }


def wilson(hits: float, cases: int, z: float = Z95) -> tuple[float, float]:
    """Eq. (1) for hits / cases; (0, 1) if there is no case."""
    if cases == 0:
        return 0.0, 1.0
    p, spread = hits / cases, z**2 / cases
    middle = (p + spread / 2) / (1 + spread)
    half = z * math.sqrt(p * (1 - p) / cases + spread / (4 * cases)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def share(
    figure: str,
    cases: Sequence[Judged],
    holds: Callable[[Judged], float],
    goal: str = "",
    met: Callable[[float], bool] | None = None,
) -> Row:
    """The row of a fraction: the mean of ``holds`` over the cases.

    holds: 1 if a case meets the condition, 0 if not; 0.5 counts as half a case.
    """
    hits = float(sum(holds(case) for case in cases))
    found = hits / len(cases) if cases else None
    return Row(
        figure,
        len(cases),
        found,
        wilson(hits, len(cases)) if cases else None,
        goal,
        None if met is None or found is None else met(found),
    )


def share_of_expected(
    figure: str,
    cases: Sequence[Judged],
    holds: Callable[[Judged], bool],
    expected: Callable[[Judged], float],
    goal: str = "",
    met: Callable[[float], bool] | None = None,
) -> Row:
    """The row of a ratio: the number of cases for which ``holds`` is true, divided by the sum of ``expected``.

    holds: whether a case meets the condition. expected: the probability that an ideal observer meets it. The interval
    is Eq. (1) for the fraction of cases, divided by the mean of ``expected``. This mean is treated as exact.
    """
    most = math.fsum(expected(case) for case in cases)
    if most <= 0:
        return Row(figure, len(cases), None, None, goal, None)
    hits = sum(holds(case) for case in cases)
    low, high = wilson(hits, len(cases))
    scale = len(cases) / most
    found = hits / most
    return Row(
        figure, len(cases), found, (low * scale, high * scale), goal, None if met is None else met(found)
    )


def of_values(
    figure: str,
    values: Sequence[float],
    of: Callable[[Sequence[float]], float],
    goal: str = "",
    met: Callable[[float], bool] | None = None,
) -> Row:
    """The row of one number. of: the function that computes this number from the values, for example their mean."""
    found = float(of(values)) if values else None
    return Row(figure, len(values), found, None, goal, None if met is None or found is None else met(found))
