"""The instructions on lanes do what numpy does, with vectors of sixteen and of eight numbers."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError
from numpy.typing import NDArray

from psfcore.convolution import lanes
from psfcore.convolution.lengths import LANES

Single = NDArray[np.float32]


@pytest.fixture(params=[8, 16])
def numbers(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Single:
    """Numbers for a kernel that is compiled in the test, with vectors of this width."""
    monkeypatch.setattr(lanes, "width", lambda: request.param)
    return np.random.default_rng(request.param).standard_normal(4 * LANES * LANES).astype(np.float32)


def test_a_square_is_transposed(numbers: Single) -> None:
    @njit
    def run(source, target):  # type: ignore[no-untyped-def]
        lanes.transpose(source, target, 3, 20, 5, 24)

    target = np.zeros_like(numbers)
    run(numbers, target)
    lane = np.arange(LANES)
    square = numbers[3 + 20 * lane[:, None] + lane]
    assert (target[5 + 24 * lane[:, None] + lane] == square.T).all()
    assert np.count_nonzero(target) == LANES**2, "nothing else is written"


def test_two_real_transforms_are_separated_and_joined(numbers: Single) -> None:
    """The transform of a + i b holds the transforms of a and b at the frequencies k and -k."""

    @njit
    def run(z, corner, back):  # type: ignore[no-untyped-def]
        lanes.split(z, corner, 32, 96, 64)
        lanes.join(corner, back, 64, 32, 96)

    a, b = numbers.reshape(2, -1, LANES)[:, :8]
    both = np.fft.fft(a + 1j * b, axis=0)
    z = np.stack([both.real, both.imag], axis=1).astype(np.float32)
    corner, back = np.zeros((4, 4, LANES), np.float32), np.zeros_like(z)
    run(z.reshape(-1), corner.reshape(-1), back.reshape(-1))
    # z[1] begins at 32, and z[3] at 96; a transform of length 4 would have them as the frequencies 1 and -1.
    p, q = z[1, 0] + 1j * z[1, 1], z[3, 0] + 1j * z[3, 1]
    expected = (p + q.conj()) / 2, (p - q.conj()) / 2j
    found = corner[1, 0] + 1j * corner[1, 1], corner[1, 2] + 1j * corner[1, 3]
    assert np.allclose(found, expected, rtol=1e-6, atol=1e-6)
    assert np.allclose(back[[1, 3]], z[[1, 3]], rtol=1e-6, atol=1e-6)
    assert not back[[0, 2]].any()


def test_complex_numbers_are_multiplied(numbers: Single) -> None:
    @njit
    def run(z, factors):  # type: ignore[no-untyped-def]
        lanes.scale(z, factors, 0, 7)
        lanes.turn(z, factors, 32, 9)
        lanes.turn_back(z, factors, 64, 9)

    z, factors = numbers[:96].copy(), numbers[200:]
    run(z, factors)
    before, after = numbers[:96].reshape(3, 2, LANES), z.reshape(3, 2, LANES)
    turned = factors[9 : 9 + LANES] + 1j * factors[9 + LANES : 9 + 2 * LANES]
    of = (factors[7 : 7 + LANES], turned, turned.conj())
    expected = [(one[0] + 1j * one[1]) * factor for one, factor in zip(before, of, strict=True)]
    assert np.allclose(after[:, 0] + 1j * after[:, 1], expected, rtol=1e-6, atol=1e-6)


def test_an_array_that_is_not_contiguous_is_refused(numbers: Single) -> None:
    @njit
    def run(z, factors):  # type: ignore[no-untyped-def]
        lanes.scale(z, factors, 0, 0)

    with pytest.raises(TypingError, match="expected a contiguous array of float32"):
        run(numbers[::2], numbers)


SHORT_VECTORS = """
import numpy as np
from psfcore.convolution import lanes
lanes.width = lambda: 8
from psfcore.convolution.fft_kernels import forward, inverse, make_plan

x = np.random.default_rng(0).standard_normal((1152, 2, 16)).astype(np.float32)
plan = make_plan(1152)  # radices 3, 3, 2, 8, 8
buffer = x.ravel().copy()
forward(buffer, plan)
found = buffer.reshape(x.shape)
expected = np.fft.fft(x[:, 0] + 1j * x[:, 1], axis=0)[np.argsort(plan.place)]
assert np.abs(found[:, 0] + 1j * found[:, 1] - expected).max() < 1e-6 * np.abs(expected).max()
inverse(buffer, plan)
assert np.abs(buffer.reshape(x.shape) / 1152 - x).max() < 2e-6
print("equal")
"""


def test_transforms_on_a_processor_with_shorter_vectors(tmp_path: Path) -> None:
    """The kernels of this test are kept apart, because a kernel on disk is not named by the width of its vectors."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", SHORT_VECTORS], env=environment, check=True, capture_output=True, text=True
    )
    assert done.stdout == "equal\n"
