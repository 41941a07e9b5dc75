"""The convolution agrees with a sum term by term and with the padding of the paper, and keeps sums and centres."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.fft
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.errors import DataError
from tests.psfcore.conftest import delta, gaussian

SIDES = st.integers(1, 23)


def direct(x: NDArray[np.float64], kernel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Eq. (1) of psfcore.convolution.convolver, term by term."""
    out = np.zeros_like(x)
    ny, nx = x.shape
    for (ky, kx), weight in np.ndenumerate(kernel):
        oy, ox = ky - kernel.shape[0] // 2, kx - kernel.shape[1] // 2
        for j in range(max(0, oy), min(ny, ny + oy)):
            for i in range(max(0, ox), min(nx, nx + ox)):
                out[j, i] += weight * x[j - oy, i - ox]
    return out


def padded_by_half_on_all_sides(x: NDArray[np.float64], kernel: NDArray[np.float64]) -> NDArray[np.float64]:
    """The method of the paper: image and PSF of one size, both padded to twice the edge."""
    ny, nx = x.shape
    py, px = ny - ny // 2, nx - nx // 2
    pad = ((py, ny - py), (px, nx - px))
    image = np.pad(x, pad)
    shape = image.shape
    psf = np.zeros(shape)
    top, left = shape[0] // 2 - kernel.shape[0] // 2, shape[1] // 2 - kernel.shape[1] // 2
    psf[top : top + kernel.shape[0], left : left + kernel.shape[1]] = kernel
    product = scipy.fft.fft2(image) * scipy.fft.fft2(scipy.fft.ifftshift(psf))
    return np.asarray(scipy.fft.ifft2(product).real[py : py + ny, px : px + nx])


@settings(max_examples=60, deadline=None)
@given(SIDES, SIDES, SIDES, SIDES, st.integers(0, 2**32 - 1))
def test_equals_the_sum_and_its_adjoint_for_any_shapes(ny: int, nx: int, ky: int, kx: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, kernel = rng.standard_normal((ny, nx)), rng.standard_normal((ny, nx)), rng.random((ky, kx))
    convolver = Convolver(kernel, (ny, nx), dtype=np.float64)
    np.testing.assert_allclose(convolver.apply(x), direct(x, kernel), atol=1e-11)
    seen, sent = np.vdot(convolver.apply(x), y), np.vdot(x, convolver.adjoint(y))
    scale = np.linalg.norm(x) * np.linalg.norm(y) * kernel.sum()
    assert abs(seen - sent) <= 1e-12 * scale


def test_equals_padding_by_half_an_edge_on_all_sides() -> None:
    rng = np.random.default_rng(5)
    for shape in ((64, 64), (65, 65), (64, 81), (51, 40)):
        x, kernel = rng.random(shape), rng.random(shape)
        kernel /= kernel.sum()
        expected = padded_by_half_on_all_sides(x, kernel)
        np.testing.assert_allclose(Convolver(kernel, shape, dtype=np.float64).apply(x), expected, atol=1e-13)


def test_a_delta_shifts_towards_its_offset_and_adjoint_shifts_back() -> None:
    x = np.zeros((20, 20))
    x[10, 10] = 1
    kernel = np.zeros((9, 9))
    kernel[4 + 1, 4 + 3] = 1
    convolver = Convolver(kernel, x.shape, dtype=np.float64)
    assert np.unravel_index(convolver.apply(x).argmax(), x.shape) == (11, 13)
    assert np.unravel_index(convolver.adjoint(x).argmax(), x.shape) == (9, 7)


def test_convolving_kernels_keeps_their_sum_and_centre() -> None:
    both = linear_convolve(gaussian(60, 3.0), gaussian(51, 4.0), (101, 90))
    np.testing.assert_allclose(both.sum(), 1.0, atol=1e-12)
    assert np.unravel_index(both.argmax(), both.shape) == (50, 45)
    y = np.arange(101) - 50
    np.testing.assert_allclose((both.sum(axis=1) * y**2).sum(), 25.0, rtol=1e-6)


def test_single_precision_stays_single_and_close() -> None:
    rng = np.random.default_rng(2)
    x, kernel = rng.random((64, 64)), gaussian(64, 5.0)
    single = Convolver(kernel, x.shape, dtype=np.float32, threads=2).apply(x.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, Convolver(kernel, x.shape, dtype=np.float64).apply(x), atol=1e-6)


def test_the_transform_of_a_full_image_is_shorter_than_twice_its_edge() -> None:
    assert Convolver(delta(2048), (2048, 2048)).length == (3072, 3072)


def test_another_shape_is_refused() -> None:
    with pytest.raises(DataError, match=r"expected a field of \(20, 20\); got \(20, 21\)"):
        Convolver(delta(5), (20, 20)).apply(np.zeros((20, 21)))
