"""Folds: every image gets a PSF that was fitted without it."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.evaluation.evaluation import evaluate
from psfcore.evaluation.report import lines
from psfcore.scatter.inversion import invert
from psfcore.scatter.validation.fold_fits import FoldKernels, fit_fold, fold_kernels
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.blocks import folds
from studies.transits import diffraction, drawn_truth
from tests.psfcore.evaluation.small_evaluations import rms
from tests.psfcore.small_transits import (
    IMAGES,
    noise_free,
    observed,
    sky,
    solved,
    with_pixels,
)


@cache
def held_out() -> FoldKernels:
    return fold_kernels(observed(sky()).transit, start=solved().inversion.coordinates)


def test_the_psf_of_a_fold_does_not_depend_on_held_out_images() -> None:
    transit, fold = observed(sky()).transit, folds(IMAGES)[3]
    start = solved().inversion.coordinates
    hidden = set(range(IMAGES)) - set(fold.fitted)
    assert len(hidden) > len(fold.held_out)
    spoilt = [np.zeros_like(f.pixels) if n in hidden else f.pixels for n, f in enumerate(transit.frames)]
    once = fit_fold(transit, fold, start=start)
    np.testing.assert_array_equal(
        fit_fold(with_pixels(transit, spoilt), fold, start=start).kernel, once.kernel
    )
    assert len(once.inversion.frames) == len(fold.fitted)
    moved = np.abs(once.inversion.coordinates - start) / np.sqrt(np.diag(once.inversion.covariance))
    assert 0.02 < moved.max() < 4


def test_every_image_has_the_psf_of_the_fold_that_holds_it_out() -> None:
    kernels = held_out()
    assert len(kernels.fits) == len(folds(IMAGES)) == 4
    for fit in kernels.fits:
        for n in fit.fold.held_out:
            assert kernels(n) is fit.kernel
    assert len({id(kernels(n)) for n in range(IMAGES)}) == 4
    found = evaluate(observed(sky()).transit, kernels)
    against = [f.residual_against_pct(sky().noise_free[f.index]) for f in found.frames]
    assert 0.2 < rms(against) < 2.5


def test_too_few_images_are_refused_and_the_error_names_the_fold() -> None:
    transit = noise_free(sky())
    with pytest.raises(DataError, match=r"too-few-frames.*at least 6 images.*got 5"):
        fold_kernels(dataclasses.replace(transit, frames=transit.frames[:5]))
    emptied = [f.pixels if n < 4 else np.full_like(f.pixels, 7.0) for n, f in enumerate(transit.frames)]
    with pytest.raises(DataError, match=r"too-few-frames: without 000\.fits to 002\.fits: expected"):
        fold_kernels(with_pixels(transit, emptied), start=solved().inversion.coordinates)


@pytest.mark.slow
def test_held_out_discs_of_clean_transits_are_predicted() -> None:
    """Relative to simulated discs without noise: mean within 1 % and rms within 2 % at every pointing.

    Noise in the fitted images changes the mean of a limb pointing by 0.6 to 0.7 %, one standard error. The mean of a
    single transit may therefore slightly exceed 1 %, but not the mean of three.
    """
    off: dict[int, list[float]] = {1: [], 2: [], 3: []}
    for seed in (0, 1, 2):
        made = simulate(default_plan(30, 512), drawn_truth(seed), diffraction(1024), seed)
        start = invert(made.transit).inversion.coordinates
        found = evaluate(made.transit, fold_kernels(made.transit, start=start))
        print("\n".join(["", f"seed {seed}", *lines(found)]))
        for fov in off:
            planes = made.noise_free
            here = [f.residual_against_pct(planes[f.index]) for f in found.frames if f.pointing == fov]
            print(f"pointing {fov}, discs without noise: mean {np.mean(here):+.2f} %, rms {rms(here):.2f} %")
            assert abs(np.mean(here)) < 1.5 and rms(here) < 2
            off[fov] += here
        maps = found.superposed
        assert maps.mape_mean_pct == pytest.approx(maps.mape_noise_mean_pct, rel=0.05)
        assert maps.mpe_rms_pct == pytest.approx(maps.mpe_noise_rms_pct, rel=0.15)
    for fov, values in off.items():
        print(f"pointing {fov} of three transits: mean {np.mean(values):+.2f} %, rms {rms(values):.2f} %")
        assert abs(np.mean(values)) < 1 and rms(values) < 2
