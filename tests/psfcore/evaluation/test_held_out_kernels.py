"""Held-out evaluation: every image gets a PSF that was fitted without it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.evaluation.evaluation import evaluate
from psfcore.evaluation.report import report
from psfcore.evaluation.shapes import held_out_kernels
from psfcore.evaluation.summary_lines import summary_lines
from psfcore.scatter.inversion import invert
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.blocks import folds
from studies.transits import diffraction, drawn_truth
from tests.psfcore.evaluation.small_evaluations import rms
from tests.psfcore.small_transits import IMAGES, noise_free, observed, sky, solved


def test_every_image_has_the_psf_of_the_fold_that_holds_it_out() -> None:
    kernels = held_out_kernels(solved())
    parts = folds(IMAGES)
    assert len(parts) == 4
    of_fold = [kernels(fold.held_out[0]) for fold in parts]
    assert len({id(kernel) for kernel in of_fold}) == 4
    for fold, kernel in zip(parts, of_fold, strict=True):
        assert all(kernels(n) is kernel for n in fold.held_out)
    found = evaluate(observed(sky()).transit, kernels)
    against = [f.residual_against_pct(sky().noise_free[f.index]) for f in found.frames]
    assert 0.2 < rms(against) < 2.5


def test_too_few_images_are_refused() -> None:
    transit = noise_free(sky())
    few = dataclasses.replace(solved(), transit=dataclasses.replace(transit, frames=transit.frames[:5]))
    with pytest.raises(DataError, match=r"too-few-images.*at least 6 images.*got 5"):
        held_out_kernels(few)


@pytest.mark.slow
def test_held_out_discs_of_clean_transits_are_predicted() -> None:
    """Relative to simulated discs without noise: mean within 1 % and rms within 2 % at every pointing.

    Noise in the fitted images changes the mean of a limb pointing by 0.6 to 0.7 %, one standard error. The mean of a
    single transit may therefore slightly exceed 1 %, but not the mean of three.
    """
    off: dict[int, list[float]] = {1: [], 2: [], 3: []}
    for seed in (0, 1, 2):
        made = simulate(default_plan(30, 512), drawn_truth(seed), diffraction(1024), seed)
        found = evaluate(made.transit, held_out_kernels(invert(made.transit)))
        print("\n".join(["", f"seed {seed}", *summary_lines(report(found))]))
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
