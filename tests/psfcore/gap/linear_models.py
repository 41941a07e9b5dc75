"""Linear models with given residuals, for tests of evidence and verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.library.detector import EFFECTS

FEW = tuple(effect for effect in EFFECTS if effect.name in ("dark_offset", "column_smear"))


def with_residuals(evidence: Evidence, values: dict[str, float], noise: float = 0.0) -> LinearModel:
    """A model whose discs show these effects and noise times this factor; the unocculted field is not used."""
    rng = np.random.default_rng(4)
    theta = np.zeros(evidence.size)
    for name, value in values.items():
        theta[evidence.columns[name][0]] = value
    discs = tuple(
        replace(
            disc,
            residual=disc.jacobian.T @ theta
            + noise
            * rng.multivariate_normal(np.zeros(disc.expected.size), disc.covariance, check_valid="ignore"),
        )
        for disc in evidence.discs
    )
    unocculted = replace(evidence.unocculted, part=np.zeros(len(evidence.image_info), dtype=bool))
    return LinearModel(replace(evidence, discs=discs, unocculted=unocculted), FLOOR)


def about_fit_with(name: str, model: LinearModel, *, left: float) -> LinearModel:
    """The model of a full refit with an effect: this fraction of the residuals is left, and the effect changes them no more."""
    evidence = model.evidence
    first = len(evidence.base)
    here = [*evidence.base, *evidence.columns[name]]
    discs = tuple(
        replace(
            disc,
            residual=disc.residual * left,
            jacobian=disc.jacobian[here] * (np.arange(len(here)) < first)[:, None],
        )
        for disc in evidence.discs
    )
    unocculted = replace(evidence.unocculted, errors=evidence.unocculted.errors[here])
    effects = tuple(effect for effect in evidence.effects if effect.name == name)
    columns = {name: tuple(range(first, len(here)))}
    return replace(
        model,
        evidence=replace(evidence, discs=discs, unocculted=unocculted, effects=effects, columns=columns),
    )
