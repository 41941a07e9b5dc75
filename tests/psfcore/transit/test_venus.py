"""Real occultations: deconvolution with scatter removes light from the dark disc and does not change the ring."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.venus_gap import explained, read
from tests.venus import table


def test_deconvolution_removes_scatter_from_the_disc_of_venus(shared: Path) -> None:
    rows = {(name, what): (core, ring) for name, what, core, ring in table(shared)}
    for name in ("XRT", "AIA 1600"):
        seen_core, seen_ring = rows[name, "as observed"]
        cores = [rows[name, f"scatter of {total} %"][0] for total in (5, 10, 20, 30)]
        assert seen_core > cores[0] > cores[1] > cores[2] > cores[3] >= 0
        assert rows[name, "scatter of 10 %"][1] == pytest.approx(seen_ring, rel=0.02)
    # The peer's own deconvolution of the XRT image takes as much out as five percent of scatter would.
    peer_core, _ = rows["XRT", "published deconvolution"]
    assert rows["XRT", "scatter of 10 %"][0] < peer_core < rows["XRT", "as observed"][0]


def test_without_long_range_scatter_the_gap_is_a_constant_plus_a_share_of_the_ring(
    shared: Path,
) -> None:
    core, terms = read(shared)
    level = explained(core, terms, ["level"])
    both = explained(core, terms, ["level", "ring"])
    weight, sigma = both.weights["ring"]
    assert weight > 4 * sigma and both.held_out_rms < level.held_out_rms
    # A constant and a share of the full disk, whose light hardly changes, cannot be told apart.
    other = explained(core, terms, ["full disk", "ring"])
    assert abs(other.bic - both.bic) < 6
    # Two ways of taking images differ by more than their light does: no scatter does that.
    weight, sigma = explained(core, terms, ["level", "ring", "kind of image"]).weights["kind of image"]
    assert weight > 3 * sigma and weight / core.mean() > 0.15
