"""The calibration: how probable a group of alternatives must be to contain the true cause, from simulated cases of
known cause.

For each simulated case in which the gap is detected, take the probability at which the group of alternatives of the
answer first contains a true cause: the smallest `level` of `answer.causes_of` whose causes cover it. Then

    level = the k-th smallest of these probabilities,  k = ceil((n + 1) coverage)      Eq. (1)

For a further case that is drawn like the simulated ones, the answer contains a true cause with at least this
probability (split-conformal prediction; Vovk, Gammerman & Shafer 2005). No such guarantee holds for the effects of
another author without a bound on how much they differ. The level is never below the coverage. If too many answers miss
the true cause at every level up to MOST, no level has the coverage: then the level is the coverage itself, because
larger groups only add wrong alternatives. `covered` states what the cases gave.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from psfcore.errors import DataError

COVERAGE = 0.9
MOST = 0.99
FILE = "calibration.json"
# How many causes the answers covered in a blind set whose effects another author wrote: the row "10 % left: an entry
# covers the cause" of the results in docs/gap.md, with its 95 % interval.
ANOTHER_AUTHOR: Mapping[str, object] = {"causes": 19, "left_pct": 10, "covered": 0.684, "ci95": [0.46, 0.846]}


@dataclass(frozen=True)
class Calibration:
    """The probabilities at which the answers to simulated cases first contained a true cause.

    Attributes
    ----------
    about
        How the cases were made: seed, version, command, and the data for which the coverage holds.
    """

    levels: tuple[float, ...]
    about: Mapping[str, object]

    def level(self, coverage: float = COVERAGE) -> float:
        """The level of a group of alternatives, Eq. (1). Raises DataError "bad-coverage" if there are too few cases."""
        count = len(self.levels)
        rank = math.ceil((count + 1) * coverage - 1e-9)
        if not 0 < coverage < 1 or rank > count:
            raise DataError(
                "bad-coverage",
                f"expected a coverage above 0 and at most {count / (count + 1):.3f}, for which {count} simulated "
                f"cases are enough; got {coverage:g}",
            )
        found = sorted(self.levels)[rank - 1]
        return coverage if found > MOST else max(found, coverage)

    def covered(self, level: float) -> float:
        """The fraction of the simulated cases whose answer contains a true cause at this level."""
        return sum(one <= level for one in self.levels) / len(self.levels)

    def to_json(self, level: float) -> dict[str, object]:
        """For the gap report: how many cases, what they gave at this level, how they were made, and what the effects of
        another author gave.
        """
        return {
            "cases": len(self.levels),
            "covered": self.covered(level),
            "another_author": dict(ANOTHER_AUTHOR),
            **self.about,
        }


@cache
def shipped_calibration() -> Calibration:
    """The calibration in the file that belongs to this version of the library of effects."""
    content = json.loads(files("psfcore.gap.verdict").joinpath(FILE).read_text("utf-8"))
    return Calibration(tuple(map(float, content["levels"])), content["about"])
