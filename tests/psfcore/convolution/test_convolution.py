"""The convolution agrees with a sum term by term, and the engine with the convolution."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.convolution.engine import Engine, Scratch
from psfcore.convolution.fft_kernels import forward, inverse, make_plan
from psfcore.convolution.kernels import BLOCK_ROWS
from psfcore.convolution.lengths import LANES, good_length
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


def test_convolving_kernels_keeps_their_sum_and_centre() -> None:
    for size in (60, 61):
        both = linear_convolve(gaussian(size, 3.0), gaussian(51, 4.0), (101, 90))
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


def test_another_shape_is_refused() -> None:
    with pytest.raises(DataError, match=r"expected a field of \(20, 20\); got \(20, 21\)"):
        Convolver(delta(5), (20, 20)).apply(np.zeros((20, 21)))
    with pytest.raises(DataError, match="expected a field"):
        Engine(np.ones((3, 3)) / 9, (20, 20)).apply(np.ones((20, 21)))


LENGTHS = [
    16,
    32,
    48,
    64,
    80,
    96,
    128,
    144,
    160,
    192,
    256,
    288,
    384,
    512,
    576,
    768,
    1024,
    1152,
    2048,
    3072,
    4096,
]


def test_transforms_agree_with_numpy_and_are_inverted() -> None:
    for length in (*LENGTHS, 5120, 8192, 16384):
        rng = np.random.default_rng(length)
        signals = rng.standard_normal((length, 2, LANES)).astype(np.float32)
        expected = np.fft.fft(signals[:, 0] + 1j * signals[:, 1], axis=0)
        buffer = signals.ravel().copy()
        forward(buffer, make_plan(length))
        found = buffer.reshape(length, 2, LANES)
        difference = found[:, 0] + 1j * found[:, 1] - expected[np.argsort(make_plan(length).place)]
        assert np.abs(difference).max() < 1e-6 * np.abs(expected).max(), length
        inverse(buffer, make_plan(length))
        assert np.abs(buffer.reshape(signals.shape) / length - signals).max() < 2e-6, length


def test_lengths_are_the_smallest_that_fit() -> None:
    assert Convolver(delta(2048), (2048, 2048)).length == (3072, 3072)  # shorter than twice the edge
    assert [good_length(n) for n in (1, 16, 17, 65, 2049, 3072, 3073, 4097, 4609, 5121)] == [
        16, 16, 32, 80, 2304, 3072, 4096, 4608, 5120, 6144,
    ]  # fmt: skip
    with pytest.raises(ValueError, match="at most"):
        good_length(20_000)


@settings(deadline=None, max_examples=30)
@given(
    ny=st.integers(1, 90),
    nx=st.integers(1, 90),
    ky=st.integers(1, 120),
    kx=st.integers(1, 120),
    symmetric=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_operators_are_those_of_the_plain_convolver(
    ny: int, nx: int, ky: int, kx: int, symmetric: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    kernel = rng.random((ky, kx))
    if symmetric and ky % 2 and kx % 2:
        kernel = kernel + kernel[::-1, ::-1]
    kernel /= kernel.sum()
    field = rng.random((ny, nx))
    engine, plain = Engine(kernel, (ny, nx)), Convolver(kernel, (ny, nx), dtype=np.float64)
    assert np.abs(engine.apply(field) - plain.apply(field)).max() < 2e-6
    assert np.abs(engine.adjoint(field) - plain.adjoint(field)).max() < 2e-6


def test_only_a_symmetric_psf_is_symmetric() -> None:
    y, x = np.indices((65, 65)) - 32
    round_psf = 1 / (3 + np.hypot(x, y)) ** 2.5
    assert Engine(round_psf / round_psf.sum(), (64, 64)).symmetric
    lopsided = round_psf * (1 + 0.01 * (x > 0))
    assert not Engine(lopsided / lopsided.sum(), (64, 64)).symmetric


def test_the_result_does_not_depend_on_the_threads() -> None:
    rng = np.random.default_rng(0)
    kernel = rng.random((64, 64))
    field = rng.random((300, 200))
    one, three = (Engine(kernel / kernel.sum(), field.shape, threads=n).apply(field) for n in (1, 3))
    assert np.array_equal(one, three)
    blocks = 40
    for threads in (1, 2, 3):
        engine = Engine(np.ones((3, 3)) / 9, (blocks * BLOCK_ROWS, 8), threads=threads)
        parts = engine.run(lambda start, stop, scratch: list(range(start, stop)), blocks)
        assert [block for part in parts for block in part] == list(range(blocks))


def test_an_error_in_any_thread_is_raised_and_the_engine_still_works() -> None:
    engine = Engine(np.ones((3, 3)) / 9, (8 * BLOCK_ROWS, 8), threads=2)
    for wrong in (0, 7, 7):

        def work(start: int, stop: int, scratch: Scratch, wrong: int = wrong) -> None:
            if start <= wrong < stop:
                raise ValueError("block")

        with pytest.raises(ValueError, match="block"):
            engine.run(work, 8)
    assert engine.run(lambda start, stop, scratch: stop - start, 8) == [2, 2, 2, 2]
