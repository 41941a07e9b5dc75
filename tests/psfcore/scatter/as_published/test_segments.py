"""Segments of the PSF: their edges, their pixels, and means of kernels over them."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.psf import squared_radii
from psfcore.scatter.as_published.segments import Segments, shells_as_published
from psfcore.scatter.power_law import scatter_kernel


def test_published_shells_are_ten_five_and_thirty_five_none_empty() -> None:
    edges = shells_as_published()
    assert edges.size == 51
    assert np.flatnonzero(edges == 5.0) == 10
    assert np.flatnonzero(edges == 10.0) == 15
    widths = np.diff(edges[15:])
    np.testing.assert_allclose(widths[1:] / widths[:-1], widths[1] / widths[0])
    counts = Segments(tuple(edges)).counts
    assert counts.min() > 0
    assert counts.sum() == 2048**2 - 1


def test_wrong_edges_are_refused() -> None:
    with pytest.raises(ValueError, match="above 10 px"):
        shells_as_published(10.0)
    for edges in ((1.0,), (0.0, 1.0), (1.0, 1.0), (2.0, 1.0), (1.0, np.nan)):
        with pytest.raises(ValueError, match="edges that increase"):
            Segments(edges)
    with pytest.raises(ValueError, match=r"\(64, 64\)"):
        Segments((0.5, 9.0), reach_grid_px=64).mean_of_map(np.zeros((63, 64)))


def test_a_pixel_on_an_edge_belongs_to_the_shell_that_begins_there() -> None:
    label = Segments((1.0, 2.0, 5.0), reach_grid_px=16).label_map(13)
    r = np.sqrt(squared_radii((13, 13)))
    expected = np.full(r.shape, -1)
    expected[(r >= 1) & (r < 2)] = 0
    expected[(r >= 2) & (r < 5)] = 1
    np.testing.assert_array_equal(label, expected)
    assert label[6, 6 + 5] == label[6, 6] == -1
    assert label[6 + 3, 6 + 4] == -1


def test_a_map_of_any_size_is_a_crop_of_the_reach_grid_and_runs_are_its_rows() -> None:
    segments = Segments(tuple(shells_as_published(50.0)), 64)
    for size in (1, 40, 63, 64, 65, 100):
        dy, dx = np.indices((size, size)) - size // 2
        on_grid = (np.minimum(dx, dy) >= -32) & (np.maximum(dx, dy) < 32)
        r = np.hypot(dx, dy)
        shell = np.searchsorted(segments.edges_px, r, side="right") - 1
        expected = np.where(on_grid & (r > 0) & (r < 50), shell, -1)
        np.testing.assert_array_equal(segments.label_map(size), expected)
    label = segments.label_map(64)
    np.testing.assert_array_equal(np.bincount(label[label >= 0], minlength=segments.size), segments.counts)
    runs, drawn = segments.runs, np.full((64, 64), -1)
    for row in range(64):
        for i in range(runs.row[row], runs.row[row + 1]):
            columns = slice(runs.dx_start[i] + 32, runs.dx_stop[i] + 32)
            assert columns.start < columns.stop
            drawn[row + runs.first_dy + 32, columns] = runs.segment[i]
    np.testing.assert_array_equal(drawn, label)


def test_means_times_counts_sum_to_the_light_of_the_full_reach() -> None:
    segments = Segments(tuple(shells_as_published()))
    kernel = scatter_kernel(6.15, 2.53, 0.411, 2048)
    assert segments.counts @ segments.mean_of_map(kernel) == pytest.approx(0.411, rel=1e-12)
