"""Segments of the PSF: their edges, their pixels, and means of kernels over them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from psfcore.psf import squared_radii
from psfcore.scatter.as_published.segments import FULL_REACH_PX, Segments, fine_shells, shells_as_published
from psfcore.scatter.power_law import scatter_kernel

Floats = NDArray[np.float64]
GRID_PX = 256


def offsets(size: int) -> tuple[Floats, Floats]:
    dy, dx = np.indices((size, size), dtype=np.float64) - size // 2
    return dx, dy


def power_law(r: Floats) -> Floats:
    return (6.15 + r) ** -2.53


def stretched(dx: Floats, dy: Floats) -> Floats:
    along, across = (dx + dy) / np.sqrt(2), (dx - dy) / np.sqrt(2)
    return power_law(np.hypot(along / 1.2, across * 1.2))


def one_sided(dx: Floats, dy: Floats) -> Floats:
    return power_law(np.hypot(dx, dy)) * (1 + 0.5 * np.cos(np.arctan2(dy, dx) - 0.3))


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


def test_fine_shells_are_a_pixel_wide_and_then_grow() -> None:
    for reach_px, growth in itertools.product((2.0, 20.4, 300.0, FULL_REACH_PX), (0.03, 0.1, 0.5)):
        edges = fine_shells(reach_px, growth)
        widths, inner = np.diff(edges), edges[:-1]
        assert (edges[0], edges[-1]) == (0.5, reach_px)
        assert (np.abs(widths[inner < 1 / growth - 1][:-1] - 1) < 0.3).all()
        assert widths[inner > 2 / growth] == pytest.approx(growth * inner[inner > 2 / growth], rel=0.15)
        grid_px = min(2048, 2 * int(reach_px) + 4)
        assert Segments(tuple(edges), reach_grid_px=grid_px).counts.min() > 0


def test_wrong_edges_and_sectors_are_refused() -> None:
    with pytest.raises(ValueError, match="above 10 px"):
        shells_as_published(10.0)
    with pytest.raises(ValueError, match="growth above 0"):
        fine_shells(growth=0.0)
    for edges in ((1.0,), (0.0, 1.0), (1.0, 1.0), (2.0, 1.0), (1.0, np.nan)):
        with pytest.raises(ValueError, match="edges that increase"):
            Segments(edges)
    with pytest.raises(ValueError, match="sector"):
        Segments((1.0, 2.0), sectors=0)
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


def test_sectors_turn_from_x_to_y_and_begin_on_the_axes() -> None:
    label = Segments((0.5, 9.0), sectors=4, reach_grid_px=16).label_map(17)
    c = 8
    assert [label[c, c + 3], label[c + 3, c], label[c, c - 3], label[c - 3, c]] == [0, 1, 2, 3]
    corners = [label[c + y, c + x] for y, x in ((2, 3), (2, -3), (-2, -3), (-2, 3))]
    assert corners == [0, 1, 2, 3]
    for sectors in (2, 12, 24):
        counts = Segments((10.0, 20.0, 60.0), sectors, GRID_PX).counts.reshape(2, sectors)
        half = sectors // 2
        np.testing.assert_array_equal(counts[:, :half], counts[:, half:])


def test_a_map_of_any_size_is_a_crop_of_the_reach_grid_and_runs_are_its_rows() -> None:
    segments = Segments(tuple(fine_shells(50.0)), 12, 64)
    for size in (1, 40, 63, 64, 65, 100):
        dx, dy = offsets(size)
        on_grid = (np.minimum(dx, dy) >= -32) & (np.maximum(dx, dy) < 32)
        r = np.hypot(dx, dy)
        shell = np.searchsorted(segments.edges_px, r, side="right") - 1
        sector = np.floor(np.degrees(np.arctan2(dy, dx)) % 360 / 30 + 1e-9).astype(int) % 12
        expected = np.where(on_grid & (r > 0) & (r < 50), shell * 12 + sector, -1)
        np.testing.assert_array_equal(segments.label_map(size), expected)
    label = segments.label_map(64)
    np.testing.assert_array_equal(np.bincount(label[label >= 0], minlength=segments.size), segments.counts)
    for of in (segments, Segments(tuple(fine_shells(60.0)), 1, 64)):
        runs, drawn = of.runs, np.full((64, 64), -1)
        for row in range(64):
            for i in range(runs.row[row], runs.row[row + 1]):
                columns = slice(runs.dx_start[i] + 32, runs.dx_stop[i] + 32)
                assert columns.start < columns.stop
                drawn[row + runs.first_dy + 32, columns] = runs.segment[i]
        np.testing.assert_array_equal(drawn, of.label_map(64))


def test_mean_of_a_kernel_is_the_mean_over_pixels() -> None:
    for edges, sectors in itertools.product((shells_as_published(170.0), fine_shells(170.0)), (1, 24)):
        segments = Segments(tuple(edges), sectors, GRID_PX)
        for kernel in (stretched, one_sided):
            expected = segments.mean_of_map(kernel(*offsets(GRID_PX)))
            np.testing.assert_allclose(segments.mean_of(kernel), expected, rtol=1e-5)
        expected = segments.mean_of_map(power_law(np.hypot(*offsets(GRID_PX))))
        np.testing.assert_allclose(segments.mean_of_radial(power_law), expected, rtol=1e-6)


def test_means_times_counts_sum_to_the_light_of_the_full_reach() -> None:
    segments = Segments(tuple(fine_shells()))
    kernel = scatter_kernel(6.15, 2.53, 0.411, 2048)
    amplitude = kernel[1024, 1025] / power_law(np.array(1.0))
    assert segments.counts @ segments.mean_of_map(kernel) == pytest.approx(0.411, rel=1e-12)
    assert segments.counts @ segments.mean_of_radial(power_law) * amplitude == pytest.approx(0.411, rel=1e-7)
    smooth = segments.mean_of(lambda dx, dy: amplitude * power_law(np.hypot(dx, dy)))
    assert segments.counts @ smooth == pytest.approx(0.411, rel=1e-6)
    np.testing.assert_allclose(smooth, segments.mean_of_map(kernel), rtol=1e-5)
