"""Linear models with given residuals, for tests of evidence and verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from psfcore.gap.effect import Effect
from psfcore.gap.evidence import closed_form
from psfcore.gap.evidence.cells import DiscCells
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.responses import Evidence
from psfcore.gap.evidence.tree import SUN, Field
from psfcore.gap.library.registry import LIBRARY

FEW = tuple(effect for effect in LIBRARY if effect.name in ("dark_offset", "column_smear"))


LIGHT = Field("light_place", "light", "place", 0.8)


def use_fields(patched: pytest.MonkeyPatch, *fields: Field) -> None:
    """Weigh the effects beside these fields alone, which is quicker; by default beside one."""
    patched.setattr(closed_form, "fields_of", lambda pointings, **how: list(fields or [LIGHT]))


def with_sun(evidence: Evidence) -> Evidence:
    """The evidence, with a changing Sun among its effects."""
    (sun,) = (effect for effect in LIBRARY if effect.name == SUN)
    return replace(evidence, effects=(*evidence.effects, sun), columns=evidence.columns | {SUN: ()})


def discs_only(evidence: Evidence) -> Evidence:
    """The evidence without the unocculted field."""
    nothing = np.zeros(len(evidence.image_info), dtype=bool)
    return replace(evidence, unocculted=replace(evidence.unocculted, part=nothing))


def with_left(model: LinearModel, residual: Callable[[DiscCells], np.ndarray]) -> LinearModel:
    """The model whose discs have these residuals, DN/s."""
    discs = tuple(replace(disc, residual=residual(disc)) for disc in model.evidence.discs)
    return replace(model, evidence=replace(model.evidence, discs=discs))


def with_residuals(evidence: Evidence, values: dict[str, float], noise: float = 0.0) -> LinearModel:
    """A model whose discs show these effects and noise times this factor; the unocculted field is not used."""
    rng = np.random.default_rng(4)
    theta = np.zeros(evidence.size)
    for name, value in values.items():
        theta[evidence.columns[name][0]] = value

    def residual(disc: DiscCells) -> np.ndarray:
        return np.asarray(disc.jacobian.T @ theta + noise * noise_of(disc, rng))

    return with_left(LinearModel(discs_only(evidence), FLOOR), residual)


def noise_of(disc: DiscCells, rng: np.random.Generator) -> np.ndarray:
    """Noise of the cells of a disc, DN/s."""
    return rng.multivariate_normal(0 * disc.expected, disc.covariance, check_valid="ignore")


def effect_of(evidence: Evidence, name: str) -> Effect:
    return next(effect for effect in evidence.effects if effect.name == name)


def sigma_of(evidence: Evidence, name: str) -> float:
    """The error of the first parameter of an effect."""
    plain = with_residuals(evidence, {})
    return float(np.sqrt(plain.fit([evidence.columns[name][0]]).covariance[-1, -1]))


def dense(model: LinearModel) -> tuple[np.ndarray, np.ndarray]:
    """The Jacobian (cells, columns) and the residuals (cells,) of all discs, in units of the noise."""
    jacobians, residuals = [], []
    for disc in model.evidence.discs:
        covariance = disc.covariance + model.floor**2 * np.outer(disc.expected, disc.expected)
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        jacobians.append(white @ disc.jacobian.T)
        residuals.append(white @ disc.residual)
    return np.concatenate(jacobians), np.concatenate(residuals)


def drawn(model: LinearModel, values: dict[tuple[str, int], float], seed: int) -> LinearModel:
    """The model with data drawn from it: noise, and the change by these parameters.

    values: by effect and number of the parameter.
    """
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
