"""The small diagnosis with another posterior: one for each verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from psfcore.gap.diagnose import Diagnosis, Shrinking, linear_fits
from psfcore.gap.verdict.calibration import Calibration
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Names
from psfcore.gap.verdict.refits import Refits
from psfcore.gap.verdict.unknown import unknown_fields
from psfcore.gap.verdict.verdict import verdict_of
from psfcore.gap.view import View
from tests.psfcore.gap.posteriors import of_weights
from tests.psfcore.gap.small_gaps import found

OFFSET, GAIN, BLUR = ("dark_offset",), ("gain_mismatch",), ("core_blur",)
# The pairs have the order of the library.
OFFSET_BLUR, OFFSET_GAIN = ("dark_offset", "core_blur"), ("dark_offset", "gain_mismatch")
SHARES: dict[str, dict[Names, float]] = {
    "none": {NONE: 0.7, OFFSET: 0.15, UNKNOWN: 0.08, GAIN: 0.07},
    "attributed": {OFFSET: 0.93, UNKNOWN: 0.04, NONE: 0.03},
    "tie": {OFFSET: 0.5, GAIN: 0.45, UNKNOWN: 0.03, NONE: 0.02},
    "unknown": {UNKNOWN: 0.95, OFFSET: 0.03, NONE: 0.02},
    "inconclusive": {OFFSET: 0.5, UNKNOWN: 0.3, NONE: 0.12, GAIN: 0.08},
}
LEAST = 0.06  # the probability that a hypothesis of the answer set needs
HOLDS_FOR = "The coverage holds for transits like these."
ABOUT = {"seed": 5, "version": "1.2.3", "command": "python -m made", "holds_for": HOLDS_FOR}


def with_shares(shares: Mapping[Names, float], images: int = 12) -> Diagnosis:
    """The diagnosis as if these were the probabilities of the hypotheses."""
    logs = {names: math.log(share) for names, share in shares.items()}
    calibration = Calibration(1.0, (LEAST,) * 19, ABOUT)
    judgement = verdict_of(of_weights(logs), calibration, images=images)
    model = found().model
    refits = Refits(View(found().solution), model)
    told = unknown_fields(model, refits.columns, judgement.posterior) if UNKNOWN in judgement.members else ()
    fits = linear_fits(refits, model, judgement, told)
    shrinking = {form: found().shrinking.get(form, Shrinking(None, None, None)) for form in fits}
    changed = replace(found(), judgement=judgement, calibration=calibration)
    changed = replace(changed, fits=fits, shrinking=shrinking, unknown=told)
    answered = judgement.verdict in ("attributed", "tie")
    return changed if answered else replace(changed, corrected=(), residual_after=None)


def judged(verdict: str) -> Diagnosis:
    """The diagnosis with this verdict."""
    changed = with_shares(SHARES[verdict])
    assert changed.judgement.verdict == verdict
    return changed
