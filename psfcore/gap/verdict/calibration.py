"""The calibration: the threshold of the answer, from simulated cases of known cause.

The answer of a posterior is the set of the hypotheses whose probability is at least a threshold. The threshold is such that,
among n simulated cases, the true cause is below it in a fraction of at most 1 - coverage:

    threshold = the k-th smallest probability of the true cause,  k = floor((n + 1) (1 - coverage))      Eq. (1)

For a further case that is drawn like the simulated ones, the answer then contains the true cause with at least this
probability, whatever the error of the model (split-conformal prediction; Vovk, Gammerman & Shafer 2005).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from psfcore.errors import DataError
from psfcore.gap.verdict.posterior import Names

COVERAGE = 0.9


@dataclass(frozen=True)
class Calibration:
    """The probabilities that the posterior gave to the true causes of simulated cases."""

    true_shares: tuple[float, ...]

    def threshold(self, coverage: float) -> float:
        """Eq. (1). Raises DataError "bad-coverage" if there are too few cases for this coverage."""
        count = len(self.true_shares)
        rank = int((count + 1) * (1 - coverage) + 1e-9)
        if not 0 < coverage < 1 or rank < 1:
            raise DataError(
                "bad-coverage",
                f"expected a coverage above 0 and at most {count / (count + 1):.3f}, for which {count} simulated cases are "
                f"enough; got {coverage:g}",
            )
        return sorted(self.true_shares)[rank - 1]

    def answer(self, shares: Mapping[Names, float], coverage: float = COVERAGE) -> tuple[Names, ...]:
        """The hypotheses of the answer, the most probable first; at least the most probable one.

        shares: the probability of each hypothesis. Raises DataError "bad-coverage".
        """
        least = self.threshold(coverage)
        ordered = sorted(shares, key=lambda names: -shares[names])
        return tuple(names for names in ordered if shares[names] >= least) or (ordered[0],)


def true_share(shares: Mapping[Names, float], true: Sequence[str]) -> float:
    """The largest probability of a hypothesis that contains all these effects; 0 if no hypothesis does."""
    return max((share for names, share in shares.items() if set(true) <= set(names)), default=0.0)
