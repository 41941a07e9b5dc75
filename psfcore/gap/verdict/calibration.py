"""The calibration: how probable a group of alternatives must be to contain the true cause, from simulated cases of known cause.

For each simulated case in which the gap is detected, take the probability at which the group of alternatives of the answer first
contains a true cause: the smallest `level` of `answer.causes_of` whose causes cover it. Then

    level = the k-th smallest of these probabilities,  k = ceil((n + 1) coverage)      Eq. (1)

For a further case that is drawn like the simulated ones, the answer contains a true cause with at least this probability
(split-conformal prediction; Vovk, Gammerman & Shafer 2005). No such guarantee holds for the effects of another author without a
bound on how much they differ. The level is never below the coverage, and at most MOST, because a group at a level of 1 is endless.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from psfcore.errors import DataError

COVERAGE = 0.9
MOST = 0.99
FILE = "calibration.json"


@dataclass(frozen=True)
class Calibration:
    """The probabilities at which the answers to simulated cases first contained a true cause.

    about: how the cases were made: seed, version, command, and the data for which the coverage holds.
    """

    levels: tuple[float, ...]
    about: Mapping[str, Any]

    def level(self, coverage: float = COVERAGE) -> float:
        """The level of a group of alternatives, Eq. (1). Raises DataError "bad-coverage" if there are too few cases."""
        count = len(self.levels)
        rank = math.ceil((count + 1) * coverage - 1e-9)
        if not 0 < coverage < 1 or rank > count:
            raise DataError(
                "bad-coverage",
                f"expected a coverage above 0 and at most {count / (count + 1):.3f}, for which {count} simulated cases are "
                f"enough; got {coverage:g}",
            )
        return min(max(sorted(self.levels)[rank - 1], coverage), max(MOST, coverage))

    def to_json(self) -> dict[str, Any]:
        """For the gap report: how many cases, how they were made, and for which data the coverage holds."""
        return {"cases": len(self.levels), **self.about}


@cache
def shipped_calibration() -> Calibration:
    """The calibration in the file that belongs to this version of the library of effects."""
    kept = json.loads(files("psfcore.gap.verdict").joinpath(FILE).read_text("utf-8"))
    return Calibration(tuple(map(float, kept["levels"])), kept["about"])
