"""Cells and sensitivities, compared with the estimate computed forwards."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.gap.evidence.cells import cells_of, disc_cells, sensitivities
from psfcore.gap.view import View
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.total_psf import pick, put


def left_in_disc(solution: Solution, n: int, image: np.ndarray) -> np.ndarray:
    """r of Eq. (1) of cells, computed forwards."""
    optics, dark = solution.optics, solution.sky.dark[n]
    lanes = optics.lanes(np.ascontiguousarray(image, dtype=np.float32))
    scene = optics.invert(lanes, optics.invert_once(lanes), steps=1)
    put(scene, dark, 0.0)
    return pick(lanes, dark) - pick(optics.convolve(scene), dark)


def test_every_dark_pixel_belongs_to_one_cell(solution: Solution) -> None:
    n = solution.part[3]
    place = solution.sky.found[n].place
    cells = cells_of(solution.sky.dark[n], place.x_px, place.y_px)
    assert cells.pixels.sum() == solution.sky.dark[n][0].size
    assert np.allclose(cells.weights.sum(axis=1), 1.0)
    assert cells.pixels.size == 13 and cells.radius.max() < 1.0


def test_a_sensitivity_is_the_adjoint_of_the_whole_estimate(solution: Solution) -> None:
    n = solution.part[3]
    place = solution.sky.found[n].place
    cells = cells_of(solution.sky.dark[n], place.x_px, place.y_px)
    planes = sensitivities(solution.optics, solution.sky.dark[n], cells.weights)
    image = np.random.default_rng(1).normal(size=solution.transit.shape).astype(np.float32)
    forwards = cells.weights @ left_in_disc(solution, n, image)
    backwards = np.einsum("cyx,yx->c", planes, image)
    assert backwards == pytest.approx(forwards, abs=1e-4)


def test_sensitivities_predict_the_effect_of_an_added_error(solution: Solution) -> None:
    n = solution.part[3]
    found, planes = disc_cells(solution, n)
    error = np.full(solution.transit.shape, 5.0, np.float32)
    place = solution.sky.found[n].place
    weights = cells_of(solution.sky.dark[n], place.x_px, place.y_px).weights
    optics, dark = solution.optics, solution.sky.dark[n]
    lanes = optics.lanes(solution.transit.frames[n].pixels + error)
    scene = optics.invert(lanes, steps=8)
    put(scene, dark, 0.0)
    after = weights @ (pick(lanes, dark) - pick(optics.convolve(scene), dark))
    expected = np.einsum("cyx,yx->c", planes, error)
    assert np.abs(expected).max() > 0.5
    assert after - found.residual == pytest.approx(expected, abs=0.05 * float(np.abs(expected).max()))


def test_a_disc_does_not_show_a_global_gain(solution: Solution) -> None:
    view = View(solution)
    n = solution.part[2]
    found, planes = disc_cells(solution, n)
    moved = np.einsum("cyx,yx->c", planes, view.expected[n])
    assert np.abs(moved).max() < 0.01 * float(found.expected.mean())
