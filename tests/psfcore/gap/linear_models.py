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


def drawn(model: LinearModel, values: dict[tuple[str, int], float], seed: int) -> LinearModel:
    """The model with data drawn from it: noise, and the change by these parameters. values: by effect and number of the parameter."""
    evidence, rng = model.evidence, np.random.default_rng(seed)
    theta = np.zeros(evidence.size)
    for (name, k), value in values.items():
        theta[evidence.columns[name][k]] = value
    discs = []
    for disc in evidence.discs:
        covariance = disc.covariance * model.disc_scale + model.floor**2 * np.outer(
            disc.expected, disc.expected
        )
        noise = rng.multivariate_normal(0 * disc.expected, covariance, check_valid="ignore")
        discs.append(replace(disc, residual=disc.jacobian.T @ theta + noise))
    blocks = evidence.unocculted
    levels = blocks.means + np.tensordot(theta, blocks.errors, axes=1)
    levels += rng.normal(size=levels.shape) * np.sqrt(blocks.variance * model.unocculted_scale)
    levels += blocks.means * blocks.gain_width * rng.normal(size=(levels.shape[0], 1))
    changed = replace(evidence, discs=tuple(discs), unocculted=replace(blocks, levels=levels))
    changed.unocculted.__dict__["gain_width"] = blocks.gain_width  # known, as the prior of the model has it
    return replace(model, evidence=changed)
