"""The calibration: which hypotheses belong to the answer set, from simulated cases of known cause.

The answer set contains the hypotheses whose probability is at least a threshold. The threshold follows from n simulated
cases, whose true causes are known. For each case, take the probability that the posterior gave to the true cause. Then

    threshold = the k-th smallest of these probabilities,  k = floor((n + 1) (1 - coverage))      Eq. (1)

For a further case that is drawn like the simulated ones, the set contains the true cause with at least this
probability, whatever the error of the model (split-conformal prediction; Vovk, Gammerman & Shafer 2005).

The temperature divides the logarithms of the weights of the hypotheses. It is the value for which the mean logarithm of the
probability of the true cause is largest.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from psfcore.errors import DataError
from psfcore.gap.verdict.posterior import Names

COVERAGE = 0.9
FILE = "calibration.json"


@dataclass(frozen=True)
class Calibration:
    """The probabilities that the posterior gave to the true causes of simulated cases.

    about: how the cases were made: seed, version, command, and the data for which the coverage holds.
    """

    temperature: float
    true_shares: tuple[float, ...]
    about: Mapping[str, Any]

    def threshold(self, coverage: float = COVERAGE) -> float:
        """The probability from which a hypothesis belongs to the answer set, Eq. (1).

        Raises DataError "bad-coverage" if there are too few cases for this coverage.
        """
        count = len(self.true_shares)
        rank = min(int((count + 1) * (1 - coverage) + 1e-9), count)
        if not 0 < coverage < 1 or rank < 1:
            raise DataError(
                "bad-coverage",
                f"expected a coverage above 0 and at most {count / (count + 1):.3f}, for which {count} simulated cases are "
                f"enough; got {coverage:g}",
            )
        return sorted(self.true_shares)[rank - 1]

    def answer(self, shares: Mapping[Names, float], coverage: float = COVERAGE) -> tuple[Names, ...]:
        """The hypotheses of the answer set, the most probable first; at least the most probable one.

        shares: the probability of each hypothesis. Raises DataError "bad-coverage".
        """
        least = self.threshold(coverage)
        ordered = sorted(shares, key=lambda names: -shares[names])
        return tuple(names for names in ordered if shares[names] >= least) or (ordered[0],)

    def to_json(self) -> dict[str, Any]:
        """For the gap report: how many cases, how they were made, and for which data the coverage holds."""
        return {"cases": len(self.true_shares), "temperature": self.temperature, **self.about}


@cache
def shipped_calibration() -> Calibration:
    """The calibration in the file that belongs to this version of the library of effects."""
    kept = json.loads(files("psfcore.gap.verdict").joinpath(FILE).read_text("utf-8"))
    return Calibration(float(kept["temperature"]), tuple(map(float, kept["true_shares"])), kept["about"])


def true_share(shares: Mapping[Names, float], true: Sequence[str]) -> float:
    """The largest probability of a hypothesis that contains all these effects; 0 if no hypothesis does."""
    return max((share for names, share in shares.items() if set(true) <= set(names)), default=0.0)
