"""The plot of a fit."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import matplotlib.image
import numpy as np

from psfcore.scatter.as_published.published import AS_PUBLISHED
from psfcore.scatter.fit_plot import fit_png
from tests.psfcore.scatter.test_fit import with_inversion
from tests.psfcore.small_transits import (
    fitted,
    recipe,
    solved,
)


def test_a_fit_is_drawn(tmp_path: Path) -> None:
    """A fit with all results; and one with a negative disc mean, without free shells, and with one round."""
    whole = dataclasses.replace(fitted(), published=recipe(AS_PUBLISHED)[0])
    image = solved().inversion.frames[4]
    bare = dataclasses.replace(
        fitted(),
        free=None,
        solution=with_inversion(
            solved(),
            frames=(dataclasses.replace(image, observed=-0.1 * image.observed),),
            rounds=solved().inversion.rounds[:1],
            converged=False,
        ),
    )
    pictures = []
    for name, fit in (("whole", whole), ("bare", bare)):
        fit_png(fit, tmp_path / f"{name}.png")
        pictures.append(matplotlib.image.imread(tmp_path / f"{name}.png"))
        height, width = pictures[-1].shape[:2]
        assert 1200 < width < 2000 and 700 < height < 1400
        assert 20_000 < (tmp_path / f"{name}.png").stat().st_size < 400_000
        assert 0.05 < pictures[-1][..., :3].std() < 0.4
    drawn = [
        int((np.abs(p[..., :3] - np.array([179, 38, 30]) / 255).max(axis=-1) < 0.02).sum()) for p in pictures
    ]
    assert drawn[0] > drawn[1] + 300  # the curves of the published recipe
