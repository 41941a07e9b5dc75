"""Windows and blocks of a decoded plane, compared with loops over the blocks."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.fits.viewing.planes import Decoded, Plane
from psfcore.fits.viewing.windows import Window, pixels, window_of


def plane_of(path: Path, content: np.ndarray) -> Plane:
    path.write_bytes(content.astype("<f4").tobytes())
    return Plane(path, Decoded(content.shape, None))  # type: ignore[arg-type]


def got(plane: Plane, window: Window, *, bits: bool = False) -> np.ndarray:
    content = b"".join(pixels(plane, window, bits=bits))
    assert len(content) == window.length
    return np.frombuffer(content, "<f4").reshape(window.shape)


def block_by_block(content: np.ndarray, window: Window, *, bits: bool) -> np.ndarray:
    cut = content[window.y : window.y + window.height, window.x : window.x + window.width]
    ny, nx = window.shape
    result = np.full((ny, nx), np.nan)
    for j in range(ny):
        for i in range(nx):
            block = cut[j * window.step : (j + 1) * window.step, i * window.step : (i + 1) * window.step]
            if bits:
                result[j, i] = np.bitwise_or.reduce(block.astype(int), axis=None)
            elif np.isfinite(block).any():
                result[j, i] = block[np.isfinite(block)].astype(float).mean()
    return result


WINDOWS = [{}, {"x": 5, "y": 11, "width": 40, "height": 23}, {"x": 60, "y": 52}]


def test_means_of_blocks(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    content = rng.normal(0, 1000, (53, 61)).astype("f4")
    content[rng.random(content.shape) < 0.3] = np.nan
    content[20:40, 10:30] = np.nan  # whole blocks without a value
    content[0, 0], content[50, 3] = np.inf, -np.inf
    plane = plane_of(tmp_path / "p", content)
    for window in WINDOWS:
        whole = window_of(plane.shape, **window)
        cut = content[whole.y : whole.y + whole.height, whole.x : whole.x + whole.width]
        np.testing.assert_array_equal(got(plane, whole), cut)  # also infinities
        for step in (2, 3, 7, 50, 1000):
            part = window_of(plane.shape, **window, step=step)
            expected = block_by_block(content, part, bits=False)
            # Sums in float64 of another order: equal to a rounding of the float32 answer.
            np.testing.assert_allclose(got(plane, part), expected, rtol=2**-23, atol=1e-9)


def test_unions_of_bits(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    content = 2 ** rng.integers(0, 16, (53, 61)) * (rng.random((53, 61)) < 0.2)
    plane = plane_of(tmp_path / "p", content)
    for step in (1, 2, 7, 1000):
        part = window_of(plane.shape, x=3, step=step)
        np.testing.assert_array_equal(got(plane, part, bits=True), block_by_block(content, part, bits=True))


def test_a_plane_that_is_read_two_rows_at_a_time(tmp_path: Path) -> None:
    """A read takes a mebibyte, which is two rows of this plane; steps are smaller and larger than two."""
    content = np.zeros((23, 120_000), "f4")
    content[:, 500:530] = np.random.default_rng(3).integers(0, 256, (23, 30))
    plane = plane_of(tmp_path / "p", content)
    for step, bits in product((1, 2, 3, 7), (False, True)):
        part = window_of(plane.shape, x=500, width=30, y=1, step=step)
        expected = block_by_block(content, part, bits=bits)
        np.testing.assert_allclose(got(plane, part, bits=bits), expected, rtol=2**-23)


def test_a_window_outside_the_plane_is_refused() -> None:
    for window in ({"x": 4}, {"y": 3}, {"width": 5}, {"x": 2, "width": 3}, {"y": 1, "height": 3}):
        with pytest.raises(DataError, match=r"^window-outside: .*plane of 4 x 3 px"):
            window_of((3, 4), **window)


def test_the_largest_numbers_do_not_overflow(tmp_path: Path) -> None:
    content = np.full((4, 4), np.finfo("f4").max, "f4")
    plane = plane_of(tmp_path / "p", content)
    np.testing.assert_array_equal(got(plane, window_of(plane.shape, step=4)), content[:1, :1])
