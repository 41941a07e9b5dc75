"""The p-value of a gap: the probability of residuals at least as large as these if there is no gap.

The fit of the PSF alone is tested with four values of chi2: of the patterns that a gap of any cause produces
(`patterns`), of the means of the discs, of all cells, and of the blocks of the unocculted field. The result is the
smallest p-value of these tests, times the number of tests.
"""

from __future__ import annotations

from scipy.special import chdtrc

from psfcore.gap.evidence.linear_model import LinearModel

# Chi2 of the unocculted field may exceed its degrees of freedom by this fraction without a gap: the Sun always changes a little.
UNOCCULTED_WIDTH = 0.03


def p_value_of_gap(model: LinearModel) -> float:
    """The p-value of the gap of a linear model."""
    left = model.left(model.base)
    cells = sum(float(one @ one) for one in left)
    blocks = model.left_unocculted(model.base) / (1 + UNOCCULTED_WIDTH)
    tests = (
        model.gain_of_patterns(model.base, model.patterns, left),
        model.gain_of_patterns(model.base, model.means, left),
        (cells, max(sum(one.size for one in left) - len(model.base.columns), 1)),
        (max(blocks, 0.0), max(model.evidence.steady_unocculted.freedom, 1)),
    )
    return min(1.0, len(tests) * min(float(chdtrc(freedom, chi2)) for chi2, freedom in tests))
