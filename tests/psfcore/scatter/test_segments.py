"""Segments of the PSF: edges, pixels, means of kernels; sums over them equal plain sums for any image and threads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.scatter.power_law import scatter_kernel
from psfcore.scatter.segments import Segments, segment_sums, shells_as_published

PUBLISHED = shells_as_published(90.0)
PIXEL_WIDE = tuple(np.arange(0.5, 91.0))


def segment_sums_plain(
    image: NDArray[np.floating], targets: NDArray[np.integer], segments: Segments
) -> NDArray[np.float64]:
    """Eq. (3) of psfcore.scatter.segments, (n, segments), by the label map."""
    ny, nx = image.shape
    # Targets lie on the image, so every offset is shorter than the longer side of the image.
    size = 2 * max(ny, nx) + 1
    label, middle = segments.label_map(size) + 1, size // 2
    weights = np.asarray(image, dtype=np.float64)[::-1, ::-1].ravel()
    out = np.empty((len(targets), segments.size))
    for n, (y, x) in enumerate(targets):
        # Labels of the offsets (y, x) - source, for sources from the last to the first.
        seen = label[middle + y - ny + 1 : middle + y + 1, middle + x - nx + 1 : middle + x + 1]
        out[n] = np.bincount(seen.ravel(), weights=weights, minlength=segments.size + 1)[1:]
    return out


def scene(shape: tuple[int, int], seed: int = 0) -> NDArray[np.float64]:
    """An image whose right side is a hundred times fainter than its left side."""
    falling = np.geomspace(1.0, 0.01, shape[1])
    return np.random.default_rng(seed).gamma(2.0, 100.0, shape) * falling


def some_targets(shape: tuple[int, int], n: int, seed: int = 0) -> NDArray[np.int64]:
    """The pixels of a disc, random pixels, the corners, and one pixel twice."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(shape)
    disc = np.argwhere((y - shape[0] // 3) ** 2 + (x - shape[1] // 2) ** 2 <= 30)
    anywhere = np.column_stack([rng.integers(0, side, n) for side in shape])
    corners = [(0, 0), (0, shape[1] - 1), (shape[0] - 1, 0), (shape[0] - 1, shape[1] - 1)]
    chosen = np.concatenate((disc, anywhere, corners, anywhere[:1]))
    return rng.permutation(chosen)


SIDES = st.integers(1, 90)


@settings(max_examples=60, deadline=None)
@given(SIDES, SIDES, st.integers(1, 80), st.integers(0, 2**32 - 1))
def test_equals_the_plain_sum_for_any_shape_and_reach(ny: int, nx: int, grid_px: int, seed: int) -> None:
    image, targets = scene((ny, nx), seed), some_targets((ny, nx), 9, seed)
    segments = Segments(PIXEL_WIDE, grid_px)
    expected = segment_sums_plain(image, targets, segments)
    np.testing.assert_allclose(segment_sums(image, targets, segments), expected, rtol=1e-9, atol=1e-9)


def test_sums_of_any_kind_of_image_are_the_plain_sums() -> None:
    """Also over the published shells of a large image."""
    targets = some_targets((101, 140), 30)
    corners = np.array([[0, 0], [500, 700], [500, 701], [1023, 1023]])
    cases = [(scene((101, 140)).astype(t), targets, PUBLISHED, 128) for t in (np.float32, ">f4", np.uint16)]
    cases.append((scene((1024, 1024)).astype(np.float32), corners, shells_as_published(), 2048))
    for image, where, edges, grid_px in cases:
        segments = Segments(edges, grid_px)
        expected = segment_sums_plain(image, where, segments)
        sums = segment_sums(image, where, segments)
        np.testing.assert_allclose(sums, expected, rtol=1e-9, atol=1e-6, err_msg=f"{image.dtype}")


def test_sums_weighted_by_segment_are_the_convolution_for_any_number_of_threads() -> None:
    """sum over S of psf_S A_S is the image convolved with the kernel that is psf_S on S."""
    image, targets = scene((64, 80)), some_targets((64, 80), 30)
    segments = Segments(PIXEL_WIDE, 128)
    weights = np.random.default_rng(1).random(segments.size)
    kernel = np.append(weights, 0.0)[segments.label_map(128)]
    convolved = Convolver(kernel, image.shape, dtype=np.float64).apply(image)
    np.testing.assert_allclose(
        segment_sums(image, targets, segments) @ weights, convolved[tuple(targets.T)], rtol=1e-9
    )
    image, targets = scene((101, 340)), some_targets((101, 340), 400)
    targets = targets[targets[:, 1] > 160]  # running sums begin within the image
    segments = Segments(PIXEL_WIDE, 128)
    alone = segment_sums(image, targets, segments)
    for threads in (2, 3, 16):
        np.testing.assert_array_equal(segment_sums(image, targets, segments, threads=threads), alone)


def test_dark_segments_of_a_bright_image_are_exactly_dark() -> None:
    image = scene((100, 100))
    y, x = np.indices(image.shape)
    image[(y - 50) ** 2 + (x - 50) ** 2 < 20**2] = 0.0
    sums = segment_sums(image, np.array([[50, 50]]), Segments((0.5, 10.0, 20.0, 30.0)))
    assert sums[0, 0] == sums[0, 1] == 0.0
    assert sums[0, 2] > 0.0


def test_what_cannot_be_summed_is_refused_and_nothing_gives_nothing() -> None:
    for value in (np.nan, np.inf):
        image = scene((60, 60))
        image[50, 10] = value
        with pytest.raises(DataError, match=r"image-nonfinite: .* got 1"):
            segment_sums(image, np.array([[2, 40]]), Segments((0.5, 5.0)))
    for targets in ([[20, 1]], [[1, -1]]):
        with pytest.raises(ValueError, match="outside it"):
            segment_sums(np.zeros((20, 20)), np.array(targets), Segments(PUBLISHED))
    image = scene((20, 20))
    assert segment_sums(image, np.empty((0, 2), int), Segments(PUBLISHED)).shape == (0, 50)
    far = Segments((200.0, 300.0), reach_grid_px=64)
    np.testing.assert_array_equal(segment_sums(image, np.array([[3, 4]]), far), [[0.0]])


def test_published_shells_hold_the_light_of_the_full_reach() -> None:
    edges = shells_as_published()
    assert len(edges) == 51 and (edges[10], edges[15]) == (5.0, 10.0)
    widths = np.diff(edges[15:])
    np.testing.assert_allclose(widths[1:] / widths[:-1], widths[1] / widths[0])
    counts = Segments(edges).counts
    assert counts.min() > 0
    assert counts.sum() == 2048**2 - 1
    segments = Segments(shells_as_published())
    kernel = scatter_kernel(6.15, 2.53, 0.411, 2048)
    assert segments.counts @ segments.mean_of_map(kernel) == pytest.approx(0.411, rel=1e-12)


def test_a_map_of_any_size_is_a_crop_of_the_reach_grid_and_runs_are_its_rows() -> None:
    segments = Segments(shells_as_published(50.0), 64)
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
