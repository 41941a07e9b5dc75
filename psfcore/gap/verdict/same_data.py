"""The evidence of a full refit, stated for the data from before the refit.

All hypotheses must explain the same data. A refit can lose discs, and an effect that it subtracts from the images can change
the noise of their blocks. Here the refit gets the discs and the blocks from before the refit, minus the change by the effects that
the refit subtracted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.evidence.evidence import Evidence

Vector = NDArray[np.float64]


def with_same_data(
    before: Evidence, after: Evidence, taken: Mapping[str, Sequence[float]], moved: Vector
) -> Evidence:
    """The evidence of a refit (`after`) with the discs and the blocks of the evidence `before` it.

    taken: the amounts of the parameters that the refit subtracted from the images, by effect. moved: the coordinates of
    the PSF of the refit minus those before.
    """
    return _with_blocks_of(before, _with_same_discs(before, after, taken, moved), taken)


def _with_blocks_of(before: Evidence, after: Evidence, taken: Mapping[str, Sequence[float]]) -> Evidence:
    """The evidence of a refit, with other blocks: the blocks from before the refit, minus the change by the effects.

    The change by some effects, for example a halo, is computed from each image and contains a part of its noise. If it
    is subtracted from the images, their blocks have less noise, and this would wrongly count in favour of the effect.
    """
    blocks = before.unocculted
    errors = np.zeros((after.size, *blocks.levels.shape))
    levels = blocks.levels.copy()
    for column, source, amount in _parameters_of(before, after, taken):
        errors[column] = blocks.errors[source]
        levels -= amount * errors[column]
    return replace(after, unocculted=replace(blocks, errors=errors, levels=levels))


def _with_same_discs(
    before: Evidence, after: Evidence, taken: Mapping[str, Sequence[float]], moved: Vector
) -> Evidence:
    """The evidence of a refit, with the discs of the fit before it.

    A refit can lose discs, for example if an effect that is too strong was
    subtracted from a faint image. The lost discs are taken from before the refit, and respond to PSF and effects
    linearly. Discs that only the refit can use are left out.
    """
    kept = [disc for disc in after.discs if disc.index in before.images]
    lost = [disc for disc in before.discs if disc.index not in after.images]
    columns = [
        *zip(after.base, before.base, moved.tolist(), strict=True),
        *_parameters_of(before, after, taken),
    ]
    linear = []
    for disc in lost:
        jacobian, residual = np.zeros((after.size, disc.residual.size)), disc.residual.copy()
        for column, source, amount in columns:
            jacobian[column] = disc.jacobian[source]
            residual -= amount * jacobian[column]
        linear.append(replace(disc, jacobian=jacobian, residual=residual))
    return replace(after, discs=tuple(sorted((*kept, *linear), key=lambda disc: disc.index)))


def _parameters_of(
    before: Evidence, after: Evidence, taken: Mapping[str, Sequence[float]]
) -> list[tuple[int, int, float]]:
    """For each parameter of the effects of a refit: its column at the refit, its column before, and the amount that the
    refit subtracted from the images."""
    found: list[tuple[int, int, float]] = []
    for effect in after.effects:
        columns = before.columns_of(effect.name)
        own = [p.name for p in effect.parameters]
        values = taken.get(effect.name, (0.0,) * len(own))
        found += (
            (column, columns[name], value)
            for name, column, value in zip(own, after.columns[effect.name], values, strict=False)
        )
    return found
