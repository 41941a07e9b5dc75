"""Held-out evaluation: every image gets a PSF that was fitted without it. Shapes are compared by these errors."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.evaluation import shapes
from psfcore.evaluation.evaluation import evaluate
from psfcore.evaluation.shapes import (
    FIGURES,
    FREE_SHELLS,
    STRETCHED,
    ShapesByErrors,
    compare_shapes_by_errors,
    held_out_kernels,
)
from psfcore.scatter.inversion import invert
from psfcore.scatter.shapes import SHAPES
from psfcore.scatter.validation.cross_validation import FoldSample, shared_step
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import folds
from tests.psfcore.evaluation.small_evaluations import residual_against_pct, rms
from tests.psfcore.small_transits import BRIGHT, IMAGES, observed, sky, solved
from tests.transit_files import drawn_truth, hri_diffraction


@cache
def compared() -> ShapesByErrors:
    """Compared with the knee, which is fitted much more quickly than the stretched shapes."""
    with patch.object(shapes, "STRETCHED", ("knee",)):
        return compare_shapes_by_errors(solved())


def test_all_shapes_are_compared_on_the_same_images() -> None:
    found = compared()
    said = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert said["shapes"][1]["parameters"]["bend"]["sigma"] > 0
    assert [s.name for s in found.shapes] == ["softened-power-law", "knee", FREE_SHELLS]
    assert found.images == IMAGES and found.folds == 4
    for shape in found.shapes:
        assert set(shape.figures) == set(FIGURES) == set(shape.minus_first)
        assert shape.figures["mape_mean_pct"][0] > shape.figures["mpe_rms_pct"][0] > 0
    assert all(value == (0.0, 0.0) for value in found.shapes[0].minus_first.values())
    first, second = found.shapes[:2]
    for name in FIGURES:
        difference = second.figures[name][0] - first.figures[name][0]
        assert second.minus_first[name][0] == pytest.approx(difference, abs=1e-9)
    # Those of the power law agree with the superposed maps of its held-out PSFs.
    looked = evaluate(solved().transit, held_out_kernels(solved()), noise_realisations=0)
    figures = compared().shapes[0].figures
    residual = np.array([frame.residual_pct for frame in looked.frames])
    assert figures["residual_mean_pct"][0] == pytest.approx(residual.mean())
    assert figures["residual_rms_pct"][0] == pytest.approx(np.sqrt((residual**2).mean()))
    assert figures["mpe_rms_pct"][0] == pytest.approx(looked.superposed.mpe_rms_pct)
    assert figures["mape_mean_pct"][0] == pytest.approx(looked.superposed.mape_mean_pct)


@pytest.mark.slow
def test_a_real_stretch_is_visible_in_held_out_errors() -> None:
    much = ScatterTruth(6.15, 2.53, 0.411, stretch=0.4, angle_deg=-15.0)
    found = compare_shapes_by_errors(invert(observed(sky(much, brightness=BRIGHT)).transit))
    by_name = {shape.name: shape for shape in found.shapes}
    value, sigma = by_name["stretched"].minus_first["mpe_rms_pct"]
    assert value < -3 * sigma
    assert value < by_name[FREE_SHELLS].minus_first["mpe_rms_pct"][0]


@pytest.mark.slow
def test_shapes_do_not_differ_where_the_truth_is_isotropic() -> None:
    found = compare_shapes_by_errors(solved())
    assert [s.name for s in found.shapes[1:]] == [*STRETCHED, FREE_SHELLS]
    for shape in found.shapes[1:]:
        for name in ("mpe_rms_pct", "mape_mean_pct"):
            value, sigma = shape.minus_first[name]
            assert abs(value) < 4 * sigma
            assert sigma < shape.figures[name][1]  # the same images: better known than the figures themselves


def test_other_shapes_and_few_images_are_refused() -> None:
    knee = dataclasses.replace(solved().inversion, shape=SHAPES["knee"])
    with pytest.raises(DataError, match=r"unknown-shape.*softened-power-law.*knee"):
        compare_shapes_by_errors(dataclasses.replace(solved(), inversion=knee))
    few = dataclasses.replace(solved().transit, frames=solved().transit.frames[:5])
    for function in (compare_shapes_by_errors, held_out_kernels):
        with pytest.raises(DataError, match=r"too-few-images.*got 5"):
            function(dataclasses.replace(solved(), transit=few))


def test_every_image_has_the_psf_of_the_fold_that_holds_it_out() -> None:
    kernels = held_out_kernels(solved())
    parts = folds(IMAGES)
    assert len(parts) == 4
    of_fold = [kernels(fold.held_out[0]) for fold in parts]
    assert len({id(kernel) for kernel in of_fold}) == 4
    counts = tuple(int(n in parts[1].fitted) for n in range(IMAGES))
    step = shared_step(solved(), FoldSample(0, 1, counts, parts[1].held_out))
    expected = solved().total.kernel(solved().inversion.coordinates + step)
    np.testing.assert_array_equal(of_fold[1], expected)
    for fold, kernel in zip(parts, of_fold, strict=True):
        assert all(kernels(n) is kernel for n in fold.held_out)
    found = evaluate(observed(sky()).transit, kernels)
    against = [residual_against_pct(f, sky().expected(f.index)) for f in found.frames]
    assert 0.2 < rms(against) < 2.5


@pytest.mark.slow
def test_held_out_discs_of_clean_transits_are_predicted() -> None:
    """Relative to simulated discs without noise: mean within 1 % and rms within 2 % at every pointing.

    Noise in the fitted images changes the mean of a limb pointing by 0.6 to 0.7 %, one standard error. The mean of a
    single transit may therefore slightly exceed 1 %, but not the mean of three.
    """
    off: dict[int, list[float]] = {1: [], 2: [], 3: []}
    for seed in (0, 1, 2):
        made = simulate(default_plan(30, 512), drawn_truth(seed), hri_diffraction(1024), seed)
        found = evaluate(made.transit, held_out_kernels(invert(made.transit)))
        for fov in off:
            planes = [made.sky.expected(n) for n in range(len(made.plan.shots))]
            here = [residual_against_pct(f, planes[f.index]) for f in found.frames if f.pointing == fov]
            assert abs(np.mean(here)) < 1.5 and rms(here) < 2
            off[fov] += here
        maps = found.superposed
        assert maps.mape_mean_pct == pytest.approx(maps.mape_noise_mean_pct, rel=0.05)
        assert maps.mpe_rms_pct == pytest.approx(maps.mpe_noise_rms_pct, rel=0.15)
    for values in off.values():
        assert abs(np.mean(values)) < 1 and rms(values) < 2
