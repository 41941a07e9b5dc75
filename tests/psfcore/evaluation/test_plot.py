"""The plot of an evaluation."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from matplotlib.image import imread

from psfcore.evaluation.evaluation import evaluate
from psfcore.evaluation.plot import evaluation_png
from tests.psfcore.evaluation.small_evaluations import kernel_with, noisy, offsets
from tests.psfcore.small_transits import (
    noise_free,
    sky,
)


def test_a_picture_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "e.png"
    evaluation_png(noisy(11), path, title="a PSF", study=offsets())
    picture = imread(path)
    assert picture.shape[:2] == (1570, 1600)
    for band in np.array_split(picture[:, :, :3], 4):
        assert band.std() > 0.1


def test_a_picture_of_one_pointing_is_drawn(tmp_path: Path) -> None:
    transit = noise_free(sky())
    alone = dataclasses.replace(transit, frames=transit.frames[4:6])
    evaluation_png(evaluate(alone, lambda _: kernel_with()), tmp_path / "e.png", title="two images")
    assert imread(tmp_path / "e.png").shape[:2] == (1200, 1600)
