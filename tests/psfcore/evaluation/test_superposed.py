"""Superposed maps of errors show noise alone for a correct PSF, and more for a wrong one."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.evaluation.evaluation import evaluate
from psfcore.evaluation.superposed import Superposition
from psfcore.transit.transit import Place
from tests.psfcore.evaluation.small_evaluations import SEEDS, kernel_with, noisy
from tests.psfcore.small_transits import (
    SCATTER,
    observed,
    sky,
)


def test_maps_for_the_true_psf_are_those_of_noise_alone() -> None:
    maps = [noisy(seed).superposed for seed in SEEDS]
    ratio = [m.mape_mean_pct / m.mape_noise_mean_pct for m in maps]
    assert np.abs(np.subtract(ratio, 1)).max() < 0.1
    assert np.mean(ratio) == pytest.approx(1, abs=0.03)
    assert np.mean([m.mpe_rms_pct / m.mpe_noise_rms_pct for m in maps]) == pytest.approx(1, abs=0.08)
    # By hand: E|N(0, s)| = s sqrt(2 / pi), s of a pixel's own photons and readout.
    noise = sky().plan.noise
    by_hand = [
        100 * np.sqrt(2 / np.pi * noise.variance(f.simulated, t.exposure_s)).mean() / f.observed_dn_s
        for f, t in zip(noisy(11).frames, noisy(11).transit.frames, strict=True)
    ]
    assert maps[0].mape_noise_mean_pct == pytest.approx(np.mean(by_hand), rel=0.08)


def test_maps_for_a_wrong_psf_exceed_noise() -> None:
    wrong = evaluate(observed(sky(), 11).transit, lambda _: kernel_with(1.25 * SCATTER.total)).superposed
    assert wrong.mape_mean_pct > 1.15 * wrong.mape_noise_mean_pct
    assert wrong.mpe_rms_pct > 1.5 * wrong.mpe_noise_rms_pct


def test_errors_are_mapped_to_the_nearest_pixel_and_averaged_where_discs_are_dark() -> None:
    laid = Superposition(3.0, 1)
    rows, columns = np.array([20, 21, 20]), np.array([30, 30, 33])
    laid.add(Place(30.4, 19.6, 3.0), (rows, columns), np.array([1.0, 2.0, 3.0]), [np.array([4.0, -4.0, 0.0])])
    laid.add(Place(29.6, 20.4, 3.0), (rows[:2], columns[:2]), np.array([-3.0, 4.0]), [np.array([-2.0, 2.0])])
    maps = laid.superposed()
    assert maps.images == 2 and maps.half_px == 4 and maps.count.shape == (9, 9)
    assert maps.count[4, 4] == 2 and maps.count[4, 7] == 1 and maps.count.sum() == 5
    assert (maps.mpe_pct[4, 4], maps.mape_pct[4, 4]) == (-1.0, 2.0)
    assert (maps.mpe_pct[5, 4], maps.mape_pct[5, 4]) == (3.0, 3.0)
    assert (maps.noise_mpe_pct[4, 4], maps.noise_mape_pct[4, 4]) == (1.0, 3.0)
    assert np.isnan(maps.mpe_pct).sum() == 81 - 3
    assert (maps.mape_mean_pct, maps.mape_largest_pct) == (8 / 3, 3.0)
    assert maps.mpe_rms_pct == pytest.approx(np.sqrt(19 / 3))
    for _ in range(3):  # the map omits a position that fewer than half of the images show
        laid.add(Place(30.0, 20.0, 3.0), (rows[:1], columns[:1]), np.array([0.0]), [np.array([0.0])])
    assert np.isfinite(laid.superposed().mpe_pct).sum() == 1
