"""Posteriors made by hand."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from psfcore.gap.evidence.fields import Field
from psfcore.gap.evidence.likelihood import Weighed
from psfcore.gap.verdict.posterior import Form, Names, Posterior, known_effects

FIELD = Field("detector", "light", 0.2)  # the form of an unknown cause


def weighed(log_evidence: float, visible_error: float = 0.0) -> Weighed:
    return Weighed(log_evidence, (), np.zeros(0), visible_error)


def form_of(names: Names) -> Form:
    """The form of a hypothesis with the effects of the library, and FIELD for an unknown cause."""
    return Form(known_effects(names), FIELD if "unknown" in names else None)


def of_evidence(logs: Mapping[Names, float], visible: float = 0.0) -> Posterior:
    """A posterior from ln of the evidence of each hypothesis. visible: the visible error of all but "no gap"."""
    order = tuple(dict.fromkeys(name for names in logs for name in known_effects(names)))
    return Posterior({form_of(n): weighed(log, visible if n else 0.0) for n, log in logs.items()}, order)


def of_weights(logs: Mapping[Names, float]) -> Posterior:
    """A posterior with these ln of the weights."""
    prior = of_evidence(dict.fromkeys(logs, 0.0)).log_weights
    return of_evidence({names: log - prior[names] for names, log in logs.items()})
