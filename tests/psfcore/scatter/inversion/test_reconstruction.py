"""The dark pixels of a reconstruction, their weights and their Jacobian."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.scatter.inversion import Solution, dark_pixels
from psfcore.scatter.optics import Blur, Optics, pick, put
from psfcore.transit.occulter import FoundPlace, fully_dark
from psfcore.transit.transit import Frame, Place
from tests.psfcore.small_transits import solved, solved_noise_free


def test_eq_4_is_what_a_change_of_the_psf_does() -> None:
    """Compared with finite differences of Eq. (1), with the scene reconstructed for each PSF."""
    solution = solved_noise_free()
    at, slopes = solution.inversion.coordinates, solution.total.slopes(solution.inversion.coordinates)
    for n, k in itertools.product((0, 5), range(at.size)):
        step = 0.02 * np.eye(at.size)[k]
        ahead, behind = (expected_with(solution, n, at + side * step) for side in (1, -1))
        found = solution.jacobian(n, Blur(slopes[k], solution.transit.shape))
        expected = (ahead - behind) / 0.04
        assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)


def expected_with(solution: Solution, n: int, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Expected intensity of the dark pixels of a frame for the PSF at these coordinates."""
    optics, dark = Optics(solution.total.kernel(at), solution.transit.shape), solution.sky.dark[n]
    scene = optics.invert(solution.sky.observed[n], steps=10)
    put(scene, dark, 0.0)
    return pick(optics.convolve(scene), dark)


def test_the_scene_matters_to_eq_4() -> None:
    """Without the response of the scene to the PSF, the derivative is different."""
    solution = solved_noise_free()
    slope = Blur(solution.total.slope(solution.inversion.coordinates, 2), solution.transit.shape)
    direct = pick(slope.convolve(solution.blanked_scene(5)), solution.sky.dark[5])
    assert np.linalg.norm(solution.jacobian(5, slope) - direct) > 0.1 * np.linalg.norm(direct)


def test_a_pixel_weighs_by_the_noise_of_its_exposure() -> None:
    solution = solved()
    exposures = [frame.exposure_s for frame in solution.transit.frames]
    assert len(set(exposures)) == 3
    for n, exposure_s in enumerate(exposures):
        level = np.array([30.0, 40.0])
        variance = (6.0 * level * exposure_s + 2.0**2) / exposure_s**2
        np.testing.assert_allclose(solution.weight(n, level), 1 / variance)
    # The variance of a very faint pixel is computed at a fifth of the disc's mean.
    assert solution.weight(0, np.array([0.0, 100.0]))[0] == pytest.approx(
        solution.weight(0, np.array([10.0, 10.0]))[0]
    )


def found_at(x_px: float, y_px: float, sigma_px: float = 0.01) -> FoundPlace:
    return FoundPlace(Place(x_px, y_px, 10.75), sigma_px, sigma_px / 2, 1.0, 4, 3, True)


def frame_with(filled: NDArray[np.bool_] | None = None) -> Frame:
    return Frame("a", np.ones((60, 70), np.float32), 1, Place(30, 30, 10.75), 1.0, 0.0, filled=filled)


def test_dark_pixels_are_certainly_dark_and_not_filled() -> None:
    rows, columns = dark_pixels(frame_with(), found_at(40.2, 29.7))
    sure = np.zeros((60, 70), bool)
    sure[rows, columns] = True
    np.testing.assert_array_equal(sure, fully_dark((60, 70), Place(40.2, 29.7, 10.75), 0.05 + 1.5 * 0.01))
    filled = np.zeros((60, 70), bool)
    filled[28:33, 40] = filled[0, 0] = True
    fewer = set(zip(*dark_pixels(frame_with(filled), found_at(40.2, 29.7)), strict=True))
    assert fewer == set(zip(rows, columns, strict=True)) - {(y, 40) for y in range(28, 33)}


def test_an_uncertain_position_leaves_fewer_dark_pixels_and_a_centre_outside_none() -> None:
    sizes = [dark_pixels(frame_with(), found_at(40, 30, sigma))[0].size for sigma in (0.01, 0.3, 1.0, 10.0)]
    assert sizes[0] > sizes[1] > sizes[2] >= sizes[3] > 150
    assert sizes[1] == fully_dark((60, 70), Place(40, 30, 10.75), 0.5).sum()
    for x_px, y_px, some in ((69.0, 30.0, True), (70.5, 30.0, False), (30.0, -1.0, False)):
        assert bool(dark_pixels(frame_with(), found_at(x_px, y_px))[0].size) is some
