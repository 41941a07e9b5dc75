"""A deconvolution in a few lines: what they say of artefacts, and when."""

from __future__ import annotations

import pytest

from psfcore.deconvolve.summary import LOOK_FROM, artefact_doubt, summary_lines


@pytest.mark.parametrize(
    ("score", "doubtful"), [(0.0, False), (0.99, False), (LOOK_FROM, True), (13.8, True)]
)
def test_a_high_artefact_score_is_told(score: float, doubtful: bool) -> None:
    details = {
        "image": "AIA_3",
        "psf": {"name": "aia_171", "version": "1.0.0", "status": "certified", "assumed": []},
        "changes": {"artefacts": {"score": score}},
        "noise": None,
        "region": None,
        "stopped_because": "all 20 steps done",
        "steps_done": 20,
        "flux_change_pct": 0.0,
        "bright_change_pct": 1.0,
        "dark_change_pct": None,
    }
    assert (artefact_doubt(details) is not None) == doubtful
    assert any("artefact" in line and f"{score:.3g}" in line for line in summary_lines(details)) == doubtful
