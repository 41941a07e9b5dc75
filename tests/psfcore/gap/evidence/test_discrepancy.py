"""The discrepancy: a gap without a cause in the library is found along what it varies with."""

from __future__ import annotations

import numpy as np

from psfcore.gap.evidence.discrepancy import ALTERNATIVES, COUNTS, EACH_READOUT, OF_BLOCKS, discrepancy
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.likelihood import Likelihood
from psfcore.gap.evidence.linear_model import LinearModel
from tests.psfcore.gap.linear_models import with_left, with_residuals


def likeliest(model: LinearModel) -> tuple[str, ...]:
    """The alternative with the largest evidence."""
    further = discrepancy(model.evidence)
    likelihood = Likelihood(model).with_further(further.directions)
    evidence = {
        orders: likelihood.weigh([columns]).log_evidence
        for orders in ALTERNATIVES
        if (columns := further.columns(orders, model.evidence.size))
    }
    return max(evidence, key=lambda orders: evidence[orders])


def test_every_order_has_columns_that_change_the_data(evidence: Evidence) -> None:
    found = discrepancy(evidence)
    columns = [column for some in found.orders.values() for column in some]
    assert sorted(columns) == list(range(found.directions.discs.shape[2]))
    assert set(found.orders) == {order for orders in ALTERNATIVES for order in orders}
    of_discs = np.moveaxis(found.directions.discs, 2, 0)
    for order, some in found.orders.items():
        in_blocks = order in (*OF_BLOCKS, COUNTS[1], EACH_READOUT)
        planes = found.directions.unocculted if in_blocks else of_discs
        assert all(planes[column].any() for column in some), order


def test_a_gap_is_found_along_what_it_varies_with(evidence: Evidence) -> None:
    """With the pointing; with the counts, which neither intensity nor exposure alone describes; across the disc."""
    infos, plain = evidence.image_info, with_residuals(evidence, {}, noise=0.5)
    by_pointing = {1: 0.2, 2: -0.2, 3: 0.2}
    counts = {d.index: d.mean_expected * infos[d.index].exposure_s for d in evidence.discs}
    usual = float(np.median(list(counts.values())))

    def with_share(share: dict[int, float]) -> tuple[str, ...]:
        return likeliest(with_left(plain, lambda disc: disc.residual + share[disc.index] * disc.expected))

    assert "pointing" in with_share({n: by_pointing.get(info.pointing, 0.0) for n, info in enumerate(infos)})
    assert with_share({n: -0.5 / (1 + c / usual) for n, c in counts.items()}) == COUNTS
    across = with_left(plain, lambda d: d.residual + 0.3 * d.expected * d.radius * np.cos(d.azimuth))
    assert likeliest(across) == ("azimuth",)
