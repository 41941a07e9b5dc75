"""Shapes compared by their held-out errors: a real stretch is visible, and no false one appears."""

from __future__ import annotations

import dataclasses
import json
from functools import cache

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.evaluation.evaluation import evaluate
from psfcore.evaluation.shapes import (
    FIGURES,
    FREE_SHELLS,
    STRETCHED,
    ShapesByErrors,
    _figures,
    compare_shapes_by_errors,
)
from psfcore.scatter.inversion import invert
from psfcore.scatter.shapes import SHAPES
from psfcore.simulate.scatter_truth import ScatterTruth
from tests.psfcore.small_transits import BRIGHT, IMAGES, observed, sky, solved


@cache
def compared() -> ShapesByErrors:
    return compare_shapes_by_errors(solved())


@cache
def compared_stretched() -> ShapesByErrors:
    """A bright sky with strongly stretched scatter."""
    much = ScatterTruth(6.15, 2.53, 0.411, stretch=0.4, angle_deg=-15.0)
    return compare_shapes_by_errors(invert(observed(sky(much, brightness=BRIGHT)).transit))


@pytest.mark.slow
def test_all_shapes_are_compared_on_the_same_images() -> None:
    found = compared()
    assert [s.name for s in found.shapes] == ["softened-power-law", *STRETCHED, FREE_SHELLS]
    assert found.images == IMAGES and found.folds == 4
    for shape in found.shapes:
        assert set(shape.figures) == set(FIGURES) == set(shape.minus_first)
        assert shape.figures["mape_mean_pct"][0] > shape.figures["mpe_rms_pct"][0] > 0
    assert all(value == (0.0, 0.0) for value in found.shapes[0].minus_first.values())
    first, second = found.shapes[:2]
    for name in FIGURES:
        difference = second.figures[name][0] - first.figures[name][0]
        assert second.minus_first[name][0] == pytest.approx(difference, abs=1e-9)


@pytest.mark.slow
def test_shapes_do_not_differ_where_the_truth_is_isotropic() -> None:
    for shape in compared().shapes[1:]:
        for name in ("mpe_rms_pct", "mape_mean_pct"):
            value, sigma = shape.minus_first[name]
            assert abs(value) < 4 * sigma
            assert sigma < shape.figures[name][1]  # the same images: better known than the figures themselves


@pytest.mark.slow
def test_a_real_stretch_is_visible_in_held_out_errors() -> None:
    shapes = {shape.name: shape for shape in compared_stretched().shapes}
    value, sigma = shapes["stretched"].minus_first["mpe_rms_pct"]
    assert value < -3 * sigma
    assert value < shapes[FREE_SHELLS].minus_first["mpe_rms_pct"][0]


def test_figures_are_those_of_the_evaluation() -> None:
    """With each image once, the figures agree with the superposed maps."""
    kernel = solved().total.kernel(solved().inversion.coordinates)
    looked = evaluate(solved().transit, lambda _n: kernel, noise_realisations=0)
    mean, rms, mpe, mape = _figures(list(looked.frames), np.ones((1, len(looked.frames))))[:, 0]
    residual = np.array([frame.residual_pct for frame in looked.frames])
    assert mean == pytest.approx(residual.mean()) and rms == pytest.approx(np.sqrt((residual**2).mean()))
    assert mpe == pytest.approx(looked.superposed.mpe_rms_pct)
    assert mape == pytest.approx(looked.superposed.mape_mean_pct)


def test_it_is_written_as_json_and_as_a_table() -> None:
    said = json.loads(json.dumps(compared().to_json(), allow_nan=False))
    assert said["shapes"][2]["parameters"]["stretch_q"]["sigma"] > 0
    assert len(compared().lines()) == 2 + 4 + 3
    assert f"{compared().shapes[0].figures['mpe_rms_pct'][0]:.2f}" in compared().lines()[1]


def test_other_shapes_and_few_images_are_refused() -> None:
    knee = dataclasses.replace(solved().inversion, shape=SHAPES["knee"])
    with pytest.raises(DataError, match=r"unknown-shape.*softened-power-law.*knee"):
        compare_shapes_by_errors(dataclasses.replace(solved(), inversion=knee))
    few = dataclasses.replace(solved().transit, frames=solved().transit.frames[:5])
    with pytest.raises(DataError, match=r"too-few-images.*got 5"):
        compare_shapes_by_errors(dataclasses.replace(solved(), transit=few))
