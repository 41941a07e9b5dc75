"""The engine has the same operators as the convolver, for any shape and any number of threads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psfcore.convolution.convolver import Convolver
from psfcore.convolution.engine import BLOCK_ROWS, Engine, Scratch
from psfcore.convolution.fft_kernels import LANES, forward, inverse, make_plan
from psfcore.convolution.lengths import good_length
from psfcore.errors import DataError

LENGTHS = [16, 32, 48, 64, 96, 128, 144, 192, 256, 288, 384, 512, 576, 768, 1024, 1152, 2048, 3072, 4096]


def test_transforms_agree_with_numpy_and_are_inverted() -> None:
    for length in (*LENGTHS, 8192, 16384):
        rng = np.random.default_rng(length)
        signals = rng.standard_normal((length, 2, LANES)).astype(np.float32)
        expected = np.fft.fft(signals[:, 0] + 1j * signals[:, 1], axis=0)
        buffer = signals.ravel().copy()
        forward(buffer, *make_plan(length).numbers)
        found = buffer.reshape(length, 2, LANES)
        difference = found[:, 0] + 1j * found[:, 1] - expected[make_plan(length).frequency]
        assert np.abs(difference).max() < 1e-6 * np.abs(expected).max(), length
        inverse(buffer, *make_plan(length).numbers)
        assert np.abs(buffer.reshape(signals.shape) / length - signals).max() < 2e-6, length


def test_lengths_are_the_smallest_that_fit() -> None:
    assert [good_length(n) for n in (1, 16, 17, 2049, 3072, 3073, 4097, 4609)] == [
        16, 16, 32, 2304, 3072, 4096, 4608, 6144,
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


def test_every_block_is_processed_once_and_results_keep_their_order() -> None:
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


def test_another_shape_is_refused() -> None:
    with pytest.raises(DataError, match="expected a field"):
        Engine(np.ones((3, 3)) / 9, (20, 20)).apply(np.ones((20, 21)))
