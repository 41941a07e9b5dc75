"""The discrepancy: a gap without a cause in the library is found along what it varies with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psfcore.gap.evidence.discrepancy import ALTERNATIVES, COUNTS, EACH_READOUT, OF_BLOCKS, discrepancy
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.likelihood import Likelihood
from psfcore.gap.evidence.linear_model import LinearModel
from tests.psfcore.gap.linear_models import with_residuals


def likeliest(model: LinearModel) -> tuple[str, ...]:
    """The alternative with the largest evidence."""
    further = discrepancy(model.evidence)
    likelihood = Likelihood(model, further.directions)
    found = {
        orders: likelihood.weigh([columns], exact=True).log_evidence
        for orders in ALTERNATIVES
        if (columns := further.columns(orders, model.evidence.size))
    }
    return max(found, key=lambda orders: found[orders])


def with_share(evidence: Evidence, share: dict[int, float]) -> LinearModel:
    """Discs that differ from the model by a share of their light, by image."""
    model = with_residuals(evidence, {}, noise=0.5)
    discs = tuple(
        replace(disc, residual=disc.residual + share[disc.index] * disc.expected)
        for disc in model.evidence.discs
    )
    return replace(model, evidence=replace(model.evidence, discs=discs))


def test_every_order_has_columns_that_change_the_data(evidence: Evidence) -> None:
    found = discrepancy(evidence)
    columns = [column for some in found.orders.values() for column in some]
    assert sorted(columns) == list(range(found.directions.discs.shape[2]))
    assert set(found.orders) == {order for orders in ALTERNATIVES for order in orders}
    for order, some in found.orders.items():
        planes = (
            found.directions.unocculted
            if order in (*OF_BLOCKS, COUNTS[1], EACH_READOUT)
            else np.moveaxis(found.directions.discs, 2, 0)
        )
        assert all(planes[column].any() for column in some)


def test_a_gap_that_differs_between_pointings_is_found_there(evidence: Evidence) -> None:
    by_pointing = {1: 0.2, 2: -0.2, 3: 0.2}
    infos = evidence.image_info
    share = {n: by_pointing.get(info.pointing, 0.0) for n, info in enumerate(infos)}
    assert "pointing" in likeliest(with_share(evidence, share))


def test_a_gap_that_depends_on_the_counts_is_found_there(evidence: Evidence) -> None:
    """Neither the intensity nor the exposure alone describes a loss of a detector that depends on the counts."""
    counts = {d.index: d.mean_expected * evidence.image_info[d.index].exposure_s for d in evidence.discs}
    usual = float(np.median(list(counts.values())))
    assert likeliest(with_share(evidence, {n: -0.5 / (1 + c / usual) for n, c in counts.items()})) == COUNTS


def test_a_gap_across_the_disc_is_found_along_the_azimuth(evidence: Evidence) -> None:
    model = with_residuals(evidence, {}, noise=0.5)
    discs = tuple(
        replace(disc, residual=disc.residual + 0.3 * disc.expected * disc.radius * np.cos(disc.azimuth))
        for disc in model.evidence.discs
    )
    model = replace(model, evidence=replace(model.evidence, discs=discs))
    assert likeliest(model) == ("azimuth",)
