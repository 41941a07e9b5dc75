"""Real occultations: a PSF with scatter takes light out of the dark disc and leaves the ring as it is."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.venus import table


def test_scatter_leaves_the_disc_of_venus(shared: Path) -> None:
    rows = {(name, what): (core, ring) for name, what, core, ring in table(shared)}
    for name in ("XRT", "AIA 1600"):
        seen_core, seen_ring = rows[name, "as observed"]
        cores = [rows[name, f"scatter of {total} %"][0] for total in (5, 10, 20, 30)]
        assert seen_core > cores[0] > cores[1] > cores[2] > cores[3] >= 0
        assert rows[name, "scatter of 10 %"][1] == pytest.approx(seen_ring, rel=0.02)
    # The peer's own deconvolution of the XRT image takes as much out as five percent of scatter would.
    peer_core, _ = rows["XRT", "the peer's deconvolution"]
    assert rows["XRT", "scatter of 10 %"][0] < peer_core < rows["XRT", "as observed"][0]
