"""Comparison of other shapes with a fit: real deviations are found, and no false ones."""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.scatter.inversion import invert
from psfcore.scatter.optics import Blur
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.shapes import SHAPES
from psfcore.scatter.total_psf import TotalPsf
from psfcore.scatter.validation import shape_comparison
from psfcore.scatter.validation.shape_comparison import ComparedShape, compare_shapes
from psfcore.transit.transit import folds
from tests.psfcore.small_transits import STRETCHED, observed, sky, solved


@cache
def compared_stretched() -> dict[str, ComparedShape]:
    return by_name(compare_shapes(invert(observed(sky(STRETCHED)).transit)))


def by_name(compared: tuple[ComparedShape, ...]) -> dict[str, ComparedShape]:
    return {shape.name: shape for shape in compared}


def test_a_simulated_stretch_is_found() -> None:
    """To first order, near the best fit without a stretch."""
    log, turn = math.log(1.15), math.radians(2 * -15.0)
    found = compared_stretched()["stretched"].added
    for name, true in (("stretch_p", log * math.cos(turn)), ("stretch_q", log * math.sin(turn))):
        value, sigma = found[name]
        assert abs(value - true) < 3 * sigma
        assert abs(value) > 8 * sigma


def test_the_simulated_shape_gains_most() -> None:
    compared = compared_stretched()
    by_gain = sorted(compared, key=lambda name: -compared[name].gain)
    held_out = {name: shape.held_out_gain or 0.0 for name, shape in compared.items()}
    assert by_gain[0] == "stretched" == max(held_out, key=lambda name: held_out[name])
    assert compared["stretched"].gain > compared["stretched-along-x"].gain > 100


def test_gains_agree_with_the_residuals() -> None:
    """Steps of each fold, and chi2 of the held-out images before and after, computed from pixels."""
    solution = solved()
    with patch.object(shape_comparison, "SHAPES", {"knee": SHAPES["knee"]}):  # quicker than all shapes
        (found,) = compare_shapes(solution)
    slopes = [*solution.total.slopes(solution.inversion.coordinates), bend_slope(solution)]
    blurs = [Blur(slope, solution.transit.shape) for slope in slopes]
    frames = []
    for n in solution.part:
        residual, expected = solution.residual(n)
        jacobian = np.array([solution.jacobian(n, blur) for blur in blurs])
        frames.append((residual, jacobian, solution.weight(n, expected)))

    def step(of: list[int], size: int) -> np.ndarray:
        lines = np.concatenate([(frames[n][1][:size] * np.sqrt(frames[n][2])).T for n in of])
        target = np.concatenate([frames[n][0] * np.sqrt(frames[n][2]) for n in of])
        return np.linalg.lstsq(lines, target, rcond=None)[0]

    def chi2(of: list[int], moved: np.ndarray) -> float:
        return sum(
            float(np.sum(frames[n][2] * (frames[n][0] - moved @ frames[n][1][: moved.size]) ** 2)) for n in of
        )

    everything = list(range(len(frames)))
    whole, alone = step(everything, 4), step(everything, 3)
    assert found.added["bend"][0] == pytest.approx(whole[3], rel=1e-3)
    assert found.gain == pytest.approx(chi2(everything, alone) - chi2(everything, whole), abs=0.01)
    gained = 0.0
    for fold in folds(len(frames)):
        fitted_frames, held = list(fold.fitted), list(fold.held_out)
        gained += chi2(held, step(fitted_frames, 3)) - chi2(held, step(fitted_frames, 4))
    assert found.held_out_gain == pytest.approx(gained, rel=0.01, abs=0.05)


def bend_slope(solution: Solution) -> np.ndarray:
    shape = SHAPES["knee"]
    total = TotalPsf(solution.transit.diffraction, shape, solution.transit.shape)
    return total.slope(shape.coordinates(solution.inversion.values), 3)


def test_few_images_have_no_held_out_gain_and_other_shapes_are_refused() -> None:
    few = dataclasses.replace(solved(), part=solved().part[3:8])
    inversion = dataclasses.replace(solved().inversion, shape=SHAPES["knee"])
    with patch.object(shape_comparison, "SHAPES", {"knee": SHAPES["knee"]}):
        assert all(shape.held_out_gain is None for shape in compare_shapes(few))
    with pytest.raises(DataError, match=r"unknown-shape.*softened-power-law.*knee"):
        compare_shapes(dataclasses.replace(solved(), inversion=inversion))
